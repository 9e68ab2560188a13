//! A transition as it stands in a chunk and in the replay: `s, a, r, discount, s', last`, all `f32`.

use crate::packing::NUMBERS_OF_A_WORD;

/// Where each field of a transition's row lies. The one statement of the layout; everyone else asks it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RowLayout {
    observation: usize,
    action: usize,
}

/// What a chunk has room for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChunkLayout {
    /// The fields of a row.
    pub row: RowLayout,
    /// Rows.
    pub rows: usize,
    /// Words (`u64`) behind the rows, which say where the actor stands after the chunk; 0 where nobody asks.
    pub actor_snapshot_words: usize,
}

/// A transition, borrowed from its row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition<'a> {
    /// Observation `s` the action was chosen on.
    pub s: &'a [f32],
    /// Action `a`, in environment units, as executed.
    pub a: &'a [f32],
    /// Reward `r`.
    pub r: f32,
    /// What the value of `s'` counts for: γⁿ, or 0 where the environment terminated. Truncation does not change it.
    pub discount: f32,
    /// Observation `s'` after the step.
    pub s_next: &'a [f32],
    /// The episode ended with this step, terminated or truncated.
    pub last: bool,
}

impl RowLayout {
    /// Rows for observations and actions of these widths.
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
    /// Numbers that the rows take.
    pub fn numbers_of_rows(&self) -> usize {
        self.rows * self.row.width()
    }

    /// Numbers in a chunk.
    pub fn len(&self) -> usize {
        self.numbers_of_rows() + NUMBERS_OF_A_WORD * self.actor_snapshot_words
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
    fn a_row_reads_back_as_written() {
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
