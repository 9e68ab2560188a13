//! Tabular temporal-difference control: SARSA (Algorithm 1) and Q-learning (Algorithm 2), section 3.3.2.

use std::borrow::Cow;

use shoal_common::algorithms::AlgorithmSettings;
use shoal_common::config::{self, Config};
use shoal_common::numbers::are_finite;
use shoal_common::policy::{self, PolicyError, PolicyLayout};
use shoal_common::space::EnvironmentSpec;
use shoal_common::transition::Transition;

use super::algorithm::{Algorithm, AlgorithmDefinition, Losses, RunSizes, SavedState, StateArray, StateArrayError};
use crate::replay::Replay;

/// Which value of s' an update bootstraps from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bootstrap {
    /// max Q(s', ·), which is Q-learning: equation 3.13.
    Max,
    /// Q(s', a') with the action a' that was taken there, which is SARSA: equation 3.12.
    NextAction,
}

/// How a table learns with these settings.
#[derive(Debug)]
pub struct TabularDefinition<'a> {
    /// The algorithm.
    pub bootstrap: Bootstrap,
    /// Its settings.
    pub settings: &'a config::TabularConfig,
}

impl AlgorithmDefinition for TabularDefinition<'_> {
    fn create(&self, config: &Config) -> Result<Box<dyn Algorithm>, PolicyError> {
        let sizes = RunSizes::from(config);
        Ok(Box::new(Tabular::new(
            self.bootstrap,
            self.settings,
            &config.spec,
            sizes,
        )?))
    }

    fn weight_names(&self) -> &'static [&'static str] {
        &Tabular::WEIGHTS
    }

    /// The table, a pending step for each environment, and the two halves of a row's number.
    fn state_numbers(&self, spec: &EnvironmentSpec, sizes: RunSizes) -> usize {
        self.settings.learned_shapes(spec).parameters() + environment_count(sizes) * PENDING + 2
    }
}

/// The number of environments of all actors.
fn environment_count(sizes: RunSizes) -> usize {
    sizes.actors as usize * sizes.envs as usize
}

/// Action-values Q(s, a), learned from each transition once, in the order they happened.
#[derive(Clone, Debug)]
pub struct Tabular {
    bootstrap: Bootstrap,
    alpha: f32,
    layout: PolicyLayout,
    actions: usize,
    /// Q, one state after another; initially 0.
    q: Vec<f32>,
    /// SARSA: for each environment, the [`Pending`] step whose a' is not known yet.
    pending: Vec<f32>,
    /// The row at which the present sequence of whole rounds began: a run may end in the middle of a round and get more
    /// steps later. Stored as the two halves of a `u64`.
    rounds_begin: [f32; 2],
    sizes: RunSizes,
    rows: u64,
}

/// A step s, a, r, s' with indices into the table.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Pending {
    s: usize,
    a: usize,
    r: f32,
    discount: f32,
    s_next: usize,
}

/// Numbers stored for a pending step: 1 if there is one, and its fields.
const PENDING: usize = 6;

impl Tabular {
    /// Names of the arrays that hold what was learned.
    const WEIGHTS: [&'static str; 1] = ["action-values"];
    const PENDING: &'static str = "steps without successor";
    const ROUNDS_BEGIN: &'static str = "first row of whole rounds";

    /// A table of zeros for an environment like `spec`.
    ///
    /// # Errors
    /// When states or actions are not discrete.
    pub fn new(
        bootstrap: Bootstrap,
        settings: &config::TabularConfig,
        spec: &EnvironmentSpec,
        sizes: RunSizes,
    ) -> Result<Self, PolicyError> {
        let scores = policy::table(spec, 0)?;
        Ok(Self {
            bootstrap,
            alpha: settings.alpha as f32,
            layout: scores.layout(),
            actions: scores.actions(),
            q: vec![0.0; scores.layout().parameters()],
            pending: vec![0.0; environment_count(sizes) * PENDING],
            rounds_begin: [0.0; 2],
            sizes,
            rows: 0,
        })
    }

    /// Learns from one transition of this environment; `None` if nothing could be learned yet.
    fn learn(&mut self, transition: &Transition<'_>, environment: usize) -> Option<Losses> {
        let step = Pending {
            s: self.state_of(transition.s[0]),
            a: (transition.a[0] as usize).min(self.actions - 1),
            r: transition.r,
            discount: transition.discount,
            s_next: self.state_of(transition.s_next[0]),
        };
        if self.bootstrap == Bootstrap::Max {
            let values = self.values(step.s_next);
            let greatest = values[policy::argmax(values)];
            return Some(self.update_value(&step, greatest));
        }
        let mut losses = None;
        // If the row in between was skipped because it was not finite, the pending step does not lead to this one.
        let before = self.take_pending(environment).filter(|before| before.s_next == step.s);
        if let Some(before) = before {
            let value = self.values(before.s_next)[step.a];
            losses = Some(self.update_value(&before, value));
        }
        if step.discount == 0.0 {
            losses = Some(self.update_value(&step, 0.0));
        } else if !transition.last {
            self.put_pending(environment, &step);
        }
        // If the time limit ended the episode, no a' was chosen, and nothing is learned from its last step.
        losses
    }

    /// Q(s, a) ← Q(s, a) + α [r + γ value − Q(s, a)]. The value of a terminal s' is not used.
    fn update_value(&mut self, step: &Pending, value: f32) -> Losses {
        let q = &mut self.q[step.s * self.actions + step.a];
        let bootstrapped = if step.discount == 0.0 {
            0.0
        } else {
            step.discount * value
        };
        let delta = step.r + bootstrapped - *q;
        let losses = Losses {
            critic_loss: delta * delta,
            q_mean: *q,
            ..Losses::default()
        };
        *q += self.alpha * delta;
        losses
    }

    fn values(&self, s: usize) -> &[f32] {
        &self.q[s * self.actions..][..self.actions]
    }

    fn state_of(&self, observation: f32) -> usize {
        (observation as usize).min(self.q.len() / self.actions - 1)
    }

    /// The environment of a row: from row `rounds_begin` on, actors take turns with full chunks, and environments take
    /// turns within a chunk.
    fn environment(&self, row: u64) -> usize {
        let row = row - self.rounds_begin();
        let (chunk, actors) = (self.sizes.chunk_rows as u64, u64::from(self.sizes.actors));
        let envs = u64::from(self.sizes.envs);
        (row / chunk % actors * envs + row % chunk % envs) as usize
    }

    fn rounds_begin(&self) -> u64 {
        bytemuck::cast(self.rounds_begin)
    }

    fn take_pending(&mut self, environment: usize) -> Option<Pending> {
        let numbers = &mut self.pending[environment * PENDING..][..PENDING];
        let exists = std::mem::take(&mut numbers[0]) != 0.0;
        exists.then(|| Pending {
            s: numbers[1] as usize,
            a: numbers[2] as usize,
            r: numbers[3],
            discount: numbers[4],
            s_next: numbers[5] as usize,
        })
    }

    fn put_pending(&mut self, environment: usize, step: &Pending) {
        let numbers = [
            1.0,
            step.s as f32,
            step.a as f32,
            step.r,
            step.discount,
            step.s_next as f32,
        ];
        self.pending[environment * PENDING..][..PENDING].copy_from_slice(&numbers);
    }
}

impl Algorithm for Tabular {
    fn policy(&self) -> Cow<'_, [f32]> {
        Cow::Borrowed(&self.q)
    }

    fn layout(&self) -> PolicyLayout {
        self.layout
    }

    fn updates(&self) -> u64 {
        self.rows
    }

    fn update(&mut self, replay: &Replay, _: u64) -> Option<Losses> {
        // After a crash of a free run the ring may have lost rows since the checkpoint.
        let row = self.rows.max(replay.rows().start);
        if row > self.rows {
            tracing::warn!(
                "rows {} to {} were overwritten before they were learned from",
                self.rows,
                row - 1
            );
        }
        self.rows = row + 1;
        let environment = self.environment(row);
        let numbers = replay.row(row);
        if !are_finite(numbers) {
            // Earlier versions did not check rows. The pending step has lost its successor.
            self.take_pending(environment);
            return None;
        }
        self.learn(&replay.layout().row.read(numbers), environment)
    }

    fn state(&self) -> Vec<StateArray<'_>> {
        vec![
            (Self::WEIGHTS[0], &self.q),
            (Self::PENDING, &self.pending),
            (Self::ROUNDS_BEGIN, &self.rounds_begin),
        ]
    }

    fn restore(&mut self, updates: u64, saved: &mut SavedState) -> Result<(), StateArrayError> {
        self.q = saved.take(Self::WEIGHTS[0], self.q.len())?;
        // Q-learning has no pending steps, and its number of actors, and so the length of this array, may have changed.
        if self.bootstrap == Bootstrap::NextAction {
            self.pending = saved.take(Self::PENDING, self.pending.len())?;
            // Earlier versions did not save it.
            if let Some([first, second]) = saved.take_if_any(Self::ROUNDS_BEGIN, 2)?.as_deref() {
                self.rounds_begin = [*first, *second];
            }
            let round = self.sizes.chunk_rows as u64 * u64::from(self.sizes.actors);
            if !updates.wrapping_sub(self.rounds_begin()).is_multiple_of(round) {
                // The last round was cut off. The next rows begin a new one, and follow none of these steps.
                self.rounds_begin = bytemuck::cast(updates);
                self.pending.fill(0.0);
            }
        }
        self.rows = updates;
        Ok(())
    }
}

#[cfg(test)]
mod tests;
