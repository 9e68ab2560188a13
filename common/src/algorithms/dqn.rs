//! `[dqn]`: deep Q-network.

use shoal_base::section;
use shoal_base::section::{Change, EXPLORATION, above, from, never};
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;
use shoal_policy::network::{Activation, Hidden, Layers, NetworkLayout};

use super::algorithm::{AlgorithmProperties, AlgorithmSettings, LearnedShapes, Shape, TransitionUse};
use super::behaviour::{Behaviour, Epsilon};

/// DQN.
pub(super) const PROPERTIES: AlgorithmProperties = AlgorithmProperties {
    name: "dqn",
    off_policy: true,
    transition_use: TransitionUse::Minibatches,
    defaults: include_str!("../../../presets/method/dqn.toml"),
};

section! {
    /// Mnih et al. 2015, with the double estimate of van Hasselt et al. 2016.
    pub struct DqnConfig {
        /// Units of each hidden layer: a list of 1 to 8 layers.
        hidden: Layers = Layers::from([256, 256]), bounds: from(1, 8_192), unit: "units", source: "ours",
            change: Change::Shape;
        /// The activation function of the hidden layers.
        activation: Activation = Activation::Relu, unit: "–", source: "Mnih et al. 2015", change: Change::Shape;
        /// γ, the discount of one step.
        gamma: f64 = 0.99, bounds: from(0.0, 1.0), unit: "–", source: "Mnih et al. 2015",
            change: never("the rows in the replay were made with it");
        /// Adam's step size.
        learning_rate: f64 = 5e-4, bounds: above(0.0, 1.0), unit: "–", source: "ours", change: Change::Learning;
        /// N, transitions in a minibatch.
        batch: usize = 64, bounds: from(1, 65_536), unit: "transitions", source: "ours", change: Change::Learning;
        /// Updates from one copy of the network into the target network to the next.
        target_every: u64 = 1_000, bounds: from(1, 1_000_000_000), unit: "updates", source: "ours",
            change: Change::Learning;
        /// Whether the action in s' is chosen by the network and valued by the target network. Otherwise the target
        /// network does both.
        double: bool = true, unit: "–", source: "van Hasselt et al. 2016", change: Change::Learning;
        /// Whether the network's last layer has separate heads for the value of a state and the advantages of the
        /// actions.
        dueling: bool = false, unit: "–", source: "Wang et al. 2016", change: Change::Shape;
        /// δ: errors beyond it count linearly instead of quadratically (Huber's loss).
        huber_delta: f64 = 1.0, bounds: above(0.0, 1e6), unit: "–", source: "Mnih et al. 2015",
            change: Change::Learning;
        /// ε at the beginning: the probability that an actor takes a random action.
        epsilon_start: f64 = 1.0, bounds: from(0.0, 1.0), unit: "share of the steps", source: "Mnih et al. 2015",
            change: EXPLORATION;
        /// ε at the end.
        epsilon_end: f64 = 0.05, bounds: from(0.0, 1.0), unit: "share of the steps", source: "ours",
            change: EXPLORATION;
        /// Environment steps of all actors in which ε falls linearly from `epsilon_start` to `epsilon_end`. If it is 0
        /// when the run is created, the program sets it to a tenth of `run.steps`.
        epsilon_steps: u64 = 0, bounds: from(0, 1_000_000_000_000), unit: "environment steps", source: "ours",
            change: EXPLORATION;
    }
}

impl DqnConfig {
    /// Its network in an environment like `spec`: an output for each action, after one for the value of the state if
    /// the heads are dueling.
    pub fn network(&self, spec: &EnvironmentSpec) -> NetworkLayout {
        let outputs = spec.action.size() + usize::from(self.dueling);
        let hidden = Hidden::new(self.hidden, self.activation);
        NetworkLayout::new(spec.observation.width(), hidden, outputs)
    }
}

impl AlgorithmSettings for DqnConfig {
    fn behaviour(&self, spec: &EnvironmentSpec, envs: usize) -> Result<Behaviour, PolicyError> {
        let values = shoal_policy::action_values(self.network(spec), self.dueling, spec, envs)?;
        let epsilon = Epsilon {
            start: self.epsilon_start,
            end: self.epsilon_end,
            steps: self.epsilon_steps,
        };
        Ok(Behaviour::EpsilonGreedy(values, epsilon))
    }

    fn learned_shapes(&self, spec: &EnvironmentSpec) -> LearnedShapes {
        LearnedShapes {
            policy: ("action-values", Shape::Network(self.network(spec))),
            others: Vec::new(),
        }
    }

    fn batch(&self) -> usize {
        self.batch
    }

    /// The successor explores as this run did in the end.
    fn inherited_setting(&self) -> Option<(&'static str, toml::Value)> {
        Some(("epsilon_start", self.epsilon_end.into()))
    }

    fn set_from_length(&mut self, steps: u64) -> Option<&'static str> {
        if self.epsilon_steps != 0 {
            return None;
        }
        self.epsilon_steps = (steps / 10).max(1);
        Some("epsilon_steps")
    }
}
