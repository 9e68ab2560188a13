//! DDPG over the replay: minibatches drawn at random from the newest rows (line 11 of Algorithm 4).

use shoal_common::algorithms::AlgorithmSettings;
use shoal_common::config;
use shoal_common::policy::{PolicyError, PolicyLayout};
use shoal_common::space::EnvironmentSpec;
use shoal_common::transition::RowLayout;

use super::{Ddpg, DdpgState};
use crate::algorithms::algorithm::{Algorithm, Losses, Method, RunSizes, SavedState, Section, SectionError};
use crate::algorithms::minibatch::Minibatch;
use crate::algorithms::sampling::Sampler;
use crate::networks::threads::Threads;
use crate::replay::Replay;

/// DDPG with its sampling from the replay.
#[derive(Debug)]
pub struct ReplayedDdpg {
    /// The networks.
    pub ddpg: Ddpg,
    sampler: Sampler,
    batch: Minibatch,
    indices: Vec<u64>,
    capacity: u64,
}

impl ReplayedDdpg {
    /// New networks, drawn from `seed`, that learn from the newest `capacity` rows.
    ///
    /// # Errors
    /// When DDPG cannot control an environment like `spec`.
    pub fn new(
        spec: &EnvironmentSpec,
        settings: &config::DdpgConfig,
        seed: u64,
        capacity: u64,
    ) -> Result<Self, PolicyError> {
        let row = RowLayout::new(spec.observation.width(), spec.action.width());
        Ok(Self {
            ddpg: Ddpg::new(spec, settings, seed)?,
            sampler: Sampler::new(seed),
            batch: Minibatch::new(row, settings.batch),
            indices: vec![0; settings.batch],
            capacity,
        })
    }
}

impl Method for &config::DdpgConfig {
    fn start(&self, spec: &EnvironmentSpec, seed: u64, sizes: RunSizes) -> Result<Box<dyn Algorithm>, PolicyError> {
        Ok(Box::new(ReplayedDdpg::new(spec, self, seed, sizes.capacity)?))
    }

    fn weights(&self) -> &'static [&'static str] {
        &DdpgState::PARTS[..4]
    }

    fn state_numbers(&self, spec: &EnvironmentSpec, _: RunSizes) -> usize {
        // Each network with its target and two moments.
        4 * self.learned(spec).parameters()
    }
}

impl Algorithm for ReplayedDdpg {
    fn policy(&self) -> &[f32] {
        self.ddpg.policy()
    }

    fn layout(&self) -> PolicyLayout {
        PolicyLayout::Deterministic(*self.ddpg.policy_layout())
    }

    fn updates(&self) -> u64 {
        self.ddpg.updates()
    }

    fn update(&mut self, replay: &Replay, rows: u64) -> Losses {
        let window = replay.window(rows, self.capacity);
        self.sampler
            .indices(self.ddpg.updates(), window.clone(), &mut self.indices);
        self.batch.gather(replay, &self.indices, &window);
        self.ddpg.update(&self.batch)
    }

    fn set_threads(&mut self, threads: Threads) {
        self.ddpg.set_threads(threads);
    }

    fn state(&self) -> Vec<Section<'_>> {
        DdpgState::PARTS.into_iter().zip(self.ddpg.state().parts).collect()
    }

    fn restore(&mut self, updates: u64, saved: &mut SavedState) -> Result<(), SectionError> {
        let lengths = self.ddpg.state().parts.map(<[f32]>::len);
        let mut sections = Vec::new();
        for (name, length) in DdpgState::PARTS.into_iter().zip(lengths) {
            sections.push(saved.take(name, length)?);
        }
        let parts = std::array::from_fn(|i| sections[i].as_slice());
        self.ddpg.restore(&DdpgState { updates, parts })
    }
}
