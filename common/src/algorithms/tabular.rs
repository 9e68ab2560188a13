//! `[q-learning]` and `[sarsa]`: tabular temporal-difference control. Both have the same keys.

use shoal_base::section;
use shoal_base::section::{Change, EXPLORATION, OutOfRange, from, never};
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;

use super::algorithm::{AlgorithmSettings, AlgorithmSpec, Experience, Learned, Shape};
use super::behaviour::{Behaviour, Epsilon};
use super::preparation::Preparation;

/// Q-learning.
pub(super) const Q_LEARNING: AlgorithmSpec = AlgorithmSpec {
    name: "q-learning",
    off_policy: true,
    experience: Experience::Transitions,
};

/// SARSA.
pub(super) const SARSA: AlgorithmSpec = AlgorithmSpec {
    name: "sarsa",
    off_policy: false,
    experience: Experience::Transitions,
};

section! {
    /// Algorithms 1 and 2 with the numbers of section 4.1.
    pub struct TabularConfig {
        /// γ, the discount of one step.
        gamma: f64 = 0.999, bounds: from(0.0, 1.0), unit: "–", source: "section 4.1",
            change: never("the rows in the replay have it");
        /// α, the step size.
        alpha: f64 = 0.03, bounds: from(0.0, 1.0), unit: "–", source: "section 4.1", change: Change::Learning;
        /// ε, the probability that an actor takes a random action instead of the best.
        epsilon: f64 = 0.4, bounds: from(0.0, 1.0), unit: "share of the steps", source: "section 4.1",
            change: EXPLORATION;
    }
}

impl AlgorithmSettings for TabularConfig {
    fn check(&self, section: &str) -> Result<(), OutOfRange> {
        self.check_bounds(section)
    }

    fn gamma(&self) -> f64 {
        self.gamma
    }

    fn preparation(&self) -> Option<&Preparation> {
        None
    }

    fn preparation_mut(&mut self) -> Option<&mut Preparation> {
        None
    }

    fn behaviour(&self, name: &'static str, spec: &EnvironmentSpec, batch: usize) -> Result<Behaviour, PolicyError> {
        let values = shoal_policy::table(name, spec, batch)?;
        Ok(Behaviour::EpsilonGreedy(values, Epsilon::constant(self.epsilon)))
    }

    fn exploration_state_width(&self, _: &EnvironmentSpec) -> usize {
        0
    }

    fn least_capacity(&self) -> u64 {
        1
    }

    fn learned(&self, spec: &EnvironmentSpec) -> Learned {
        let (states, actions) = (spec.observation.size(), spec.action.size());
        Learned {
            policy: ("action-values", Shape::Table { states, actions }),
            others: Vec::new(),
        }
    }
}
