//! Real transitions to move and to learn from: a preset's environments under random actions.

use rand::RngExt;
use shoal_common::channel::environment::{ResponseLayout, StepBlocks};
use shoal_common::config::Config;
use shoal_common::space::Space;
use shoal_common::stream::{Purpose, Stream, stream};
use shoal_common::transition::{RowLayout, Transition};
use shoal_env_server::vector::{Reset, VectorEnvironment};

/// Environments that are stepped together, and so the number of rows that each step yields.
pub(super) const ENVIRONMENTS: usize = 64;

/// A source of transitions.
pub(super) struct Rows {
    environments: VectorEnvironment,
    layout: ResponseLayout,
    row: RowLayout,
    gamma: f32,
    random: Stream,
    /// The range of each element of an action; whole numbers only if the actions are discrete.
    bounds: Vec<(f32, f32)>,
    is_discrete: bool,
    observations: Vec<f32>,
    actions: Vec<f32>,
    response: Vec<f32>,
}

impl Rows {
    pub(super) fn new(config: &Config) -> anyhow::Result<Self> {
        let (name, parameters) = (&config.environment.name, &config.environment.parameters);
        let mut environments = VectorEnvironment::new(name, parameters, ENVIRONMENTS as u32, config.run.seed, 0, 0)?;
        let row = config.row_layout();
        let mut observations = vec![0.0; ENVIRONMENTS * row.observation_width()];
        environments.reset(Reset::Next, &mut observations)?;
        let layout = ResponseLayout::new(ENVIRONMENTS, row.observation_width());
        let bounds = match &config.spec.action {
            Space::Box { low, high } => low.iter().copied().zip(high.iter().copied()).collect(),
            Space::Discrete { n, .. } => vec![(0.0, *n as f32 - 1.0)],
        };
        Ok(Self {
            environments,
            layout,
            row,
            gamma: config.algorithm.gamma() as f32,
            random: stream(config.run.seed, Purpose::Exploration, 0, 0),
            bounds,
            is_discrete: matches!(config.spec.action, Space::Discrete { .. }),
            observations,
            actions: vec![0.0; ENVIRONMENTS * row.action_width()],
            response: vec![0.0; layout.len()],
        })
    }

    /// The current observations of the environments, one after the other.
    pub(super) fn observations(&self) -> &[f32] {
        &self.observations
    }

    /// Steps every environment once and writes the `ENVIRONMENTS` rows to `out`.
    pub(super) fn fill(&mut self, out: &mut [f32]) -> anyhow::Result<()> {
        for action in self.actions.chunks_exact_mut(self.bounds.len()) {
            for (number, (low, high)) in action.iter_mut().zip(&self.bounds) {
                let drawn = low + (high - low) * self.random.random::<f32>();
                *number = if self.is_discrete { drawn.round() } else { drawn };
            }
        }
        let blocks = self.layout.split_mut(&mut self.response);
        let lent = StepBlocks {
            observations: &mut *blocks.observations,
            next_observations: &mut *blocks.next_observations,
            rewards: &mut *blocks.rewards,
            terminated: &mut *blocks.terminated,
            truncated: &mut *blocks.truncated,
        };
        self.environments.step(&self.actions, lent)?;
        let (width, action_width) = (self.row.observation_width(), self.row.action_width());
        for (e, row) in out.chunks_exact_mut(self.row.width()).enumerate() {
            let terminated = blocks.terminated[e] != 0.0;
            let transition = Transition {
                s: &self.observations[e * width..][..width],
                a: &self.actions[e * action_width..][..action_width],
                r: blocks.rewards[e],
                discount: if terminated { 0.0 } else { self.gamma },
                s_next: &blocks.next_observations[e * width..][..width],
                last: terminated || blocks.truncated[e] != 0.0,
            };
            self.row.write(&transition, row);
        }
        self.observations.copy_from_slice(blocks.observations);
        Ok(())
    }
}
