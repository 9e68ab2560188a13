//! Tabular temporal-difference control: SARSA (Algorithm 1) and Q-learning (Algorithm 2), section 3.3.2.

use shoal_common::algorithms::AlgorithmSettings;
use shoal_common::config;
use shoal_common::policy::{self, PolicyError, PolicyLayout};
use shoal_common::space::EnvironmentSpec;
use shoal_common::transition::Transition;

use super::algorithm::{Algorithm, Losses, Method, Room, SavedState, Section, SectionError};
use crate::replay::{Replay, are_finite};

/// Which value of s' a step is led by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lead {
    /// max Q(s', ·): equation 3.13.
    Greatest,
    /// Q(s', a') of the action that was taken there: equation 3.12.
    Taken,
}

/// Q-learning with these settings.
#[derive(Debug)]
pub struct QLearning<'a>(pub &'a config::TabularConfig);

/// SARSA with these settings.
#[derive(Debug)]
pub struct Sarsa<'a>(pub &'a config::TabularConfig);

impl Method for QLearning<'_> {
    fn start(&self, spec: &EnvironmentSpec, _: u64, room: Room) -> Result<Box<dyn Algorithm>, PolicyError> {
        Ok(Box::new(Tabular::new(Lead::Greatest, self.0, spec, room)?))
    }

    fn weights(&self) -> &'static [&'static str] {
        &Tabular::WEIGHTS
    }

    fn state_numbers(&self, spec: &EnvironmentSpec, room: Room) -> usize {
        state_numbers(self.0, spec, room)
    }
}

impl Method for Sarsa<'_> {
    fn start(&self, spec: &EnvironmentSpec, _: u64, room: Room) -> Result<Box<dyn Algorithm>, PolicyError> {
        Ok(Box::new(Tabular::new(Lead::Taken, self.0, spec, room)?))
    }

    fn weights(&self) -> &'static [&'static str] {
        &Tabular::WEIGHTS
    }

    fn state_numbers(&self, spec: &EnvironmentSpec, room: Room) -> usize {
        state_numbers(self.0, spec, room)
    }
}

/// The table, and a pending step for each environment.
fn state_numbers(settings: &config::TabularConfig, spec: &EnvironmentSpec, room: Room) -> usize {
    settings.learned(spec).parameters() + slots(room) * PENDING
}

/// Environments of all actors.
fn slots(room: Room) -> usize {
    room.actors as usize * room.envs as usize
}

/// Action-values Q(s, a), learned from each transition once, in the order they happened.
#[derive(Clone, Debug)]
pub struct Tabular {
    lead: Lead,
    alpha: f32,
    layout: PolicyLayout,
    actions: usize,
    /// Q, state after state; 0 at first.
    q: Vec<f32>,
    /// SARSA: of each environment the step whose a' is still to come, as [`Pending`] has it.
    pending: Vec<f32>,
    room: Room,
    rows: u64,
}

/// A step s, a, r, s' in the table's terms.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Pending {
    s: usize,
    a: usize,
    r: f32,
    discount: f32,
    s_next: usize,
}

/// Numbers that a pending step takes: 1 where there is one, and its fields.
const PENDING: usize = 6;

impl Tabular {
    /// Names of the sections that hold what was learned.
    const WEIGHTS: [&'static str; 1] = ["action-values"];
    const PENDING: &'static str = "steps without successor";

    /// A table of zeros for an environment like `spec`.
    ///
    /// # Errors
    /// When states or actions cannot be counted.
    pub fn new(
        lead: Lead,
        settings: &config::TabularConfig,
        spec: &EnvironmentSpec,
        room: Room,
    ) -> Result<Self, PolicyError> {
        let name = match lead {
            Lead::Greatest => "q-learning",
            Lead::Taken => "sarsa",
        };
        let scores = policy::table(name, spec, 0)?;
        Ok(Self {
            lead,
            alpha: settings.alpha as f32,
            layout: scores.layout(),
            actions: scores.actions(),
            q: vec![0.0; scores.layout().parameters()],
            pending: vec![0.0; slots(room) * PENDING],
            room,
            rows: 0,
        })
    }

    /// Learns from one transition, of the environment in `slot`.
    fn learn(&mut self, transition: &Transition<'_>, slot: usize) -> Losses {
        let step = Pending {
            s: self.state_of(transition.s[0]),
            a: (transition.a[0] as usize).min(self.actions - 1),
            r: transition.r,
            discount: transition.discount,
            s_next: self.state_of(transition.s_next[0]),
        };
        if self.lead == Lead::Greatest {
            let values = self.values(step.s_next);
            let greatest = values[policy::highest(values)];
            return self.improve(&step, greatest);
        }
        let mut losses = Losses::default();
        // Where the last chunk of a run was cut off, and the run was given more steps, the next row is of another walk.
        let before = self.take(slot).filter(|before| before.s_next == step.s);
        if let Some(before) = before {
            let value = self.values(before.s_next)[step.a];
            losses = self.improve(&before, value);
        }
        if step.discount == 0.0 {
            losses = self.improve(&step, 0.0);
        } else if !transition.last {
            self.put(slot, &step);
        }
        // Where the time limit ended the episode no a' was chosen, and nothing is learned from that step.
        losses
    }

    /// Q(s, a) ← Q(s, a) + α [r + γ value − Q(s, a)]. Nothing is asked of a terminal s'.
    fn improve(&mut self, step: &Pending, value: f32) -> Losses {
        let q = &mut self.q[step.s * self.actions + step.a];
        let bootstrapped = if step.discount == 0.0 {
            0.0
        } else {
            step.discount * value
        };
        let delta = step.r + bootstrapped - *q;
        let losses = Losses {
            critic_loss: delta * delta,
            actor_loss: 0.0,
            q_mean: *q,
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

    /// Which environment a row is of: actors take turns with full chunks, and environments within a chunk.
    fn slot(&self, row: u64) -> usize {
        let (chunk, actors) = (self.room.chunk_rows as u64, u64::from(self.room.actors));
        let envs = u64::from(self.room.envs);
        (row / chunk % actors * envs + row % chunk % envs) as usize
    }

    fn take(&mut self, slot: usize) -> Option<Pending> {
        let slot = &mut self.pending[slot * PENDING..][..PENDING];
        let there = std::mem::take(&mut slot[0]) != 0.0;
        there.then(|| Pending {
            s: slot[1] as usize,
            a: slot[2] as usize,
            r: slot[3],
            discount: slot[4],
            s_next: slot[5] as usize,
        })
    }

    fn put(&mut self, slot: usize, step: &Pending) {
        let numbers = [
            1.0,
            step.s as f32,
            step.a as f32,
            step.r,
            step.discount,
            step.s_next as f32,
        ];
        self.pending[slot * PENDING..][..PENDING].copy_from_slice(&numbers);
    }
}

impl Algorithm for Tabular {
    fn policy(&self) -> &[f32] {
        &self.q
    }

    fn layout(&self) -> PolicyLayout {
        self.layout
    }

    fn updates(&self) -> u64 {
        self.rows
    }

    fn update(&mut self, replay: &Replay, _: u64) -> Losses {
        // After a crash of a free run the ring may have lost what came since the checkpoint.
        let row = self.rows.max(replay.rows().start);
        self.rows = row + 1;
        let slot = self.slot(row);
        let numbers = replay.row(row);
        if !are_finite(numbers) {
            // Of a learner that did not check what it committed. The step before has lost its successor.
            self.take(slot);
            return Losses::default();
        }
        self.learn(&replay.layout().row.read(numbers), slot)
    }

    fn state(&self) -> Vec<Section<'_>> {
        vec![(Self::WEIGHTS[0], &self.q), (Self::PENDING, &self.pending)]
    }

    fn restore(&mut self, updates: u64, saved: &mut SavedState) -> Result<(), SectionError> {
        self.q = saved.take(Self::WEIGHTS[0], self.q.len())?;
        self.pending = saved.take(Self::PENDING, self.pending.len())?;
        self.rows = updates;
        Ok(())
    }
}

#[cfg(test)]
mod tests;
