//! Transitions of n steps (Sutton and Barto 2018, chapter 7): from s and a, the discounted sum of the next n rewards,
//! and the observation after them. At the end of an episode they have fewer steps.

use std::collections::VecDeque;

use shoal_common::channel::transitions::Chunk;
use shoal_common::transition::{RowLayout, Transition};

/// The steps of an actor that are not part of a complete transition yet, and complete transitions that are not in a
/// chunk yet.
///
/// A step of all environments completes at most n transitions in each, and those are put into chunks before the next
/// step. So there are never more than n rows for each environment.
#[derive(Clone, Debug, PartialEq)]
pub struct NStepTransitions {
    n: usize,
    row: RowLayout,
    /// For each environment the rows of its latest steps, the oldest first; fewer than n.
    pending: Vec<VecDeque<Vec<f32>>>,
    /// Rows of n steps.
    complete: VecDeque<Vec<f32>>,
}

impl NStepTransitions {
    /// For transitions of `n` steps in `environments` environments.
    pub fn new(n: usize, environments: usize, row: RowLayout) -> Self {
        Self {
            n,
            row,
            pending: vec![VecDeque::new(); environments],
            complete: VecDeque::new(),
        }
    }

    /// Adds a step of an environment. Completes the transition that began n − 1 steps before it or, if the episode is
    /// over, all that began in it.
    pub fn add(&mut self, environment: usize, step: &Transition<'_>) {
        let mut row = vec![0.0; self.row.width()];
        self.row.write(step, &mut row);
        let steps = &mut self.pending[environment];
        steps.push_back(row);
        while steps.len() == self.n || (step.last && !steps.is_empty()) {
            self.complete.push_back(n_step_row(self.row, steps));
            steps.pop_front();
        }
    }

    /// Completes all pending transitions with the steps they have, although the episodes are not over.
    pub fn complete_all(&mut self) {
        for steps in &mut self.pending {
            while !steps.is_empty() {
                self.complete.push_back(n_step_row(self.row, steps));
                steps.pop_front();
            }
        }
    }

    /// Moves complete transitions into the chunk until it is full.
    pub fn move_into(&mut self, chunk: &mut Chunk) {
        while !chunk.is_full()
            && let Some(row) = self.complete.pop_front()
        {
            chunk.push(&self.row.read(&row));
        }
    }

    /// Drops everything, as when all episodes are given up.
    pub fn clear(&mut self) {
        self.pending.iter_mut().for_each(VecDeque::clear);
        self.complete.clear();
    }

    fn state_words(&self) -> usize {
        self.row.n_step_words(self.n, self.pending.len())
    }

    /// Everything that it holds, in [`RowLayout::n_step_words`] words.
    pub fn words(&self) -> Vec<u64> {
        let mut words = Vec::new();
        if self.n == 1 {
            return words;
        }
        words.extend(self.pending.iter().map(|steps| steps.len() as u64));
        words.push(self.complete.len() as u64);
        let rows = self.pending.iter().flatten().chain(&self.complete);
        words.extend(rows.flatten().map(|number| u64::from(number.to_bits())));
        words.resize(self.state_words(), 0);
        words
    }

    /// Restores what [`words`](Self::words) returned for the same n, environments and row. Other words are refused: it
    /// returns false and holds nothing.
    #[must_use]
    pub fn restore(&mut self, words: &[u64]) -> bool {
        self.clear();
        let restored = self.read(words);
        if restored.is_none() {
            self.clear();
        }
        restored.is_some()
    }

    fn read(&mut self, words: &[u64]) -> Option<()> {
        if words.len() != self.state_words() {
            return None;
        }
        let Some((counts, rest)) = words.split_at_checked(self.pending.len()).filter(|_| self.n > 1) else {
            return Some(());
        };
        let (complete, rest) = rest.split_first()?;
        let mut rows = rest.chunks_exact(self.row.width());
        let mut take = |count: u64| -> Option<VecDeque<Vec<f32>>> {
            let number = |word: &u64| Some(f32::from_bits(u32::try_from(*word).ok()?));
            (0..count).map(|_| rows.next()?.iter().map(number).collect()).collect()
        };
        for (steps, count) in self.pending.iter_mut().zip(counts) {
            *steps = take(*count)?;
        }
        self.complete = take(*complete)?;
        Some(())
    }
}

/// The transition that begins with the first of these steps and ends with the last: r = r₁ + d₁ (r₂ + d₂ (…)), and the
/// discount d₁ d₂ …, where dᵢ is a step's own discount. `last` is taken from the first step, so that an episode has one
/// row with it.
fn n_step_row(row: RowLayout, steps: &VecDeque<Vec<f32>>) -> Vec<f32> {
    let mut numbers = vec![0.0; row.width()];
    if let (Some(first), Some(end)) = (steps.front(), steps.back()) {
        let (mut r, mut discount) = (0.0, 1.0);
        for step in steps {
            let step = row.read(step);
            r += discount * step.r;
            discount *= step.discount;
        }
        let transition = Transition {
            r,
            discount,
            s_next: row.read(end).s_next,
            ..row.read(first)
        };
        row.write(&transition, &mut numbers);
    }
    numbers
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const GAMMA: f32 = 0.9;

    fn row() -> RowLayout {
        RowLayout::new(1, 1)
    }

    /// Step number `t` of an environment, with the reward `r`: the observation is t, the next one t + 1.
    fn step(t: usize, r: f32, terminated: bool, truncated: bool) -> Vec<f32> {
        let mut numbers = vec![0.0; row().width()];
        row().write(
            &Transition {
                s: &[t as f32],
                a: &[-(t as f32)],
                r,
                discount: if terminated { 0.0 } else { GAMMA },
                s_next: &[t as f32 + 1.0],
                last: terminated || truncated,
            },
            &mut numbers,
        );
        numbers
    }

    /// What each step's row must be, computed from the whole episode: (r, discount, s').
    fn by_definition(episode: &[Vec<f32>], n: usize) -> Vec<(f64, f64, f32)> {
        (0..episode.len())
            .map(|t| {
                let steps = &episode[t..episode.len().min(t + n)];
                let rewards = steps.iter().enumerate();
                let r = rewards.map(|(k, step)| f64::from(GAMMA).powi(k as i32) * f64::from(row().read(step).r));
                let end = row().read(steps.last().unwrap());
                let discount = if end.discount == 0.0 {
                    0.0
                } else {
                    f64::from(GAMMA).powi(steps.len() as i32)
                };
                (r.sum(), discount, end.s_next[0])
            })
            .collect()
    }

    proptest! {
        #[test]
        fn rows_are_those_of_the_whole_episode(
            n in 1_usize..6,
            episodes in prop::collection::vec((1_usize..12, any::<bool>()), 1..6),
            cut in 0_usize..40,
        ) {
            let mut n_step = NStepTransitions::new(n, 1, row());
            let mut expected = Vec::new();
            let mut total = 0;
            for (length, terminated) in episodes {
                let steps: Vec<Vec<f32>> = (0..length)
                    .map(|t| {
                        let end = t + 1 == length;
                        step(t, (t as f32 * 1.7).sin(), end && terminated, end && !terminated)
                    })
                    .collect();
                for step in &steps {
                    n_step.add(0, &row().read(step));
                    total += 1;
                    if total == cut {
                        // As another process that takes over.
                        let mut successor = NStepTransitions::new(n, 1, row());
                        let kept = NStepTransitions {
                            complete: VecDeque::new(),
                            ..n_step.clone()
                        };
                        prop_assert!(successor.restore(&kept.words()));
                        prop_assert_eq!(&successor, &kept);
                        successor.complete = std::mem::take(&mut n_step.complete);
                        n_step = successor;
                    }
                }
                expected.extend(by_definition(&steps, n));
                prop_assert!(n_step.pending[0].is_empty());
            }
            prop_assert_eq!(n_step.complete.len(), expected.len());
            for (found, (r, discount, s_next)) in n_step.complete.iter().zip(expected) {
                let found = row().read(found);
                prop_assert!((f64::from(found.r) - r).abs() < 1e-5);
                prop_assert!((f64::from(found.discount) - discount).abs() < 1e-6);
                prop_assert_eq!(found.s_next[0], s_next);
            }
        }
    }

    #[test]
    fn environments_do_not_mix_and_an_episode_has_one_last_row() {
        let mut n_step = NStepTransitions::new(3, 2, row());
        for t in 0..4 {
            n_step.add(0, &row().read(&step(t, 1.0, t == 3, false)));
            n_step.add(1, &row().read(&step(10 + t, 2.0, false, false)));
        }
        let rows = || n_step.complete.iter().map(|found| row().read(found));
        let of = |environment: usize| rows().filter(move |it| (it.s[0] >= 10.0) == (environment == 1));
        assert_eq!(of(0).map(|it| it.s[0]).collect::<Vec<_>>(), [0.0, 1.0, 2.0, 3.0]);
        assert_eq!(of(0).map(|it| it.last).collect::<Vec<_>>(), [false, false, false, true]);
        assert_eq!(of(1).map(|it| it.s[0]).collect::<Vec<_>>(), [10.0, 11.0]);
        n_step.complete.clear();
        let mut ended = n_step.clone();
        ended.complete_all();
        let rows = ended.complete.iter().map(|found| row().read(found));
        let rows: Vec<_> = rows.map(|it| (it.s[0], it.r, it.s_next[0], it.last)).collect();
        assert_eq!(rows, [(12.0, 3.8, 14.0, false), (13.0, 2.0, 14.0, false)]);
        assert_eq!(n_step.words().len(), row().n_step_words(3, 2));
        n_step.clear();
        assert_eq!(n_step, NStepTransitions::new(3, 2, row()));
    }

    #[test]
    fn words_of_another_layout_are_refused() {
        let mut n_step = NStepTransitions::new(3, 2, row());
        n_step.add(0, &row().read(&step(0, 1.0, false, false)));
        let words = n_step.words();
        assert!(!NStepTransitions::new(4, 2, row()).restore(&words));
        assert!(!NStepTransitions::new(3, 1, row()).restore(&words));
        let mut many = words.clone();
        many[0] = u64::MAX;
        assert!(!NStepTransitions::new(3, 2, row()).restore(&many));
        assert!(
            NStepTransitions::new(1, 2, row()).restore(&[]) && NStepTransitions::new(1, 2, row()).words().is_empty()
        );
    }
}
