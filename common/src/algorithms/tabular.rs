//! `[q-learning]` and `[sarsa]`: tabular temporal-difference control. Both have the same keys.

use shoal_base::section;
use shoal_base::section::{Change, EXPLORATION, from, never};
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;

use super::algorithm::{AlgorithmProperties, AlgorithmSettings, LearnedShapes, Shape, TransitionUse};
use super::behaviour::{Behaviour, Epsilon};

/// Q-learning.
pub(super) const Q_LEARNING: AlgorithmProperties = AlgorithmProperties {
    name: "q-learning",
    off_policy: true,
    transition_use: TransitionUse::Transitions,
    defaults: include_str!("../../../presets/method/q-learning.toml"),
};

/// SARSA.
pub(super) const SARSA: AlgorithmProperties = AlgorithmProperties {
    name: "sarsa",
    off_policy: false,
    transition_use: TransitionUse::Transitions,
    defaults: include_str!("../../../presets/method/sarsa.toml"),
};

section! {
    /// Algorithms 1 and 2 with the numbers of section 4.1.
    pub struct TabularConfig {
        /// γ, the discount of one step.
        gamma: f64 = 0.999, bounds: from(0.0, 1.0), unit: "–", source: "section 4.1",
            change: never("the rows in the replay were made with it");
        /// α, the step size.
        alpha: f64 = 0.03, bounds: from(0.0, 1.0), unit: "–", source: "section 4.1", change: Change::Learning;
        /// ε, the probability that an actor takes a random action instead of the best.
        epsilon: f64 = 0.4, bounds: from(0.0, 1.0), unit: "share of the steps", source: "section 4.1",
            change: EXPLORATION;
    }
}

impl AlgorithmSettings for TabularConfig {
    fn behaviour(&self, spec: &EnvironmentSpec, envs: usize) -> Result<Behaviour, PolicyError> {
        let values = shoal_policy::table(spec, envs)?;
        Ok(Behaviour::EpsilonGreedy(values, Epsilon::constant(self.epsilon)))
    }

    fn learned_shapes(&self, spec: &EnvironmentSpec) -> LearnedShapes {
        let (states, actions) = (spec.observation.size(), spec.action.size());
        LearnedShapes {
            policy: ("action-values", Shape::Table { states, actions }),
            others: Vec::new(),
        }
    }

    fn batch(&self) -> usize {
        1
    }
}
