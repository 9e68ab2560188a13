//! The row of a transition in a chunk and in the replay: `s, a, r, discount, s', last`, all `f32`.

use crate::packing::NUMBERS_PER_WORD;

/// The layout of a transition's row. No other code knows where a field lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RowLayout {
    observation: usize,
    action: usize,
}

/// The layout of a chunk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChunkLayout {
    /// The fields of a row.
    pub row: RowLayout,
    /// Rows in a full chunk.
    pub rows: usize,
    /// Words (`u64`) of the actor's snapshot after the chunk, which follows the rows; 0 if chunks carry no snapshot.
    pub actor_snapshot_words: usize,
}

/// A transition that borrows its vectors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition<'a> {
    /// Observation `s` that the action was chosen for.
    pub s: &'a [f32],
    /// Action `a`, in environment units, as chosen. Servers of integer boxes round it.
    pub a: &'a [f32],
    /// Reward `r`.
    pub r: f32,
    /// Discount of the value of `s'`: γ, or γᵏ if the row has k steps, or 0 if the environment terminated. Truncation
    /// does not change it.
    pub discount: f32,
    /// Observation `s'` after the step.
    pub s_next: &'a [f32],
    /// Whether the episode ended with this step, terminated or truncated. In a row of several steps, whether it ended
    /// with the first of them.
    pub last: bool,
}

impl RowLayout {
    /// The layout for observations and actions of these widths.
    pub fn new(observation: usize, action: usize) -> Self {
        Self { observation, action }
    }

    /// Numbers in `s`.
    pub fn observation_width(&self) -> usize {
        self.observation
    }

    /// Numbers in `a`.
    pub fn action_width(&self) -> usize {
        self.action
    }

    /// Numbers in a row.
    pub fn width(&self) -> usize {
        2 * self.observation + self.action + 3
    }

    /// Words (`u64`) that an actor's snapshot has for rows that are not in a chunk yet, with `envs` environments and
    /// transitions of `n` steps: the counts of such rows, then space for `n` rows of each environment. 0 if `n` is 1.
    pub fn n_step_words(&self, n: usize, envs: usize) -> usize {
        match n {
            1 => 0,
            n => 1 + envs + envs * n * self.width(),
        }
    }

    /// Reads a row of `width()` numbers.
    #[inline]
    pub fn read<'a>(&self, row: &'a [f32]) -> Transition<'a> {
        let (s, rest) = row.split_at(self.observation);
        let (a, rest) = rest.split_at(self.action);
        Transition {
            s,
            a,
            r: rest[0],
            discount: rest[1],
            s_next: &rest[2..2 + self.observation],
            last: rest[2 + self.observation] != 0.0,
        }
    }

    /// Writes a transition into a row of `width()` numbers.
    #[inline]
    pub fn write(&self, transition: &Transition<'_>, row: &mut [f32]) {
        let (s, rest) = row.split_at_mut(self.observation);
        let (a, rest) = rest.split_at_mut(self.action);
        s.copy_from_slice(transition.s);
        a.copy_from_slice(transition.a);
        rest[0] = transition.r;
        rest[1] = transition.discount;
        rest[2..2 + self.observation].copy_from_slice(transition.s_next);
        rest[2 + self.observation] = f32::from(u8::from(transition.last));
    }
}

impl ChunkLayout {
    /// Numbers in the rows.
    pub fn rows_len(&self) -> usize {
        self.rows * self.row.width()
    }

    /// Numbers in a chunk.
    pub fn len(&self) -> usize {
        self.rows_len() + NUMBERS_PER_WORD * self.actor_snapshot_words
    }

    /// Whether a chunk holds nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_is_read_back_as_written() {
        let layout = RowLayout::new(3, 2);
        let written = Transition {
            s: &[1.0, 2.0, 3.0],
            a: &[4.0, 5.0],
            r: 6.0,
            discount: 0.99,
            s_next: &[7.0, 8.0, 9.0],
            last: true,
        };
        let mut row = vec![f32::NAN; layout.width()];
        layout.write(&written, &mut row);
        assert!(row.iter().all(|x| !x.is_nan()), "every number of the row is written");
        assert_eq!(layout.read(&row), written);
    }
}
