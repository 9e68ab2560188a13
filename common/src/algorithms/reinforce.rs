//! `[reinforce]`: REINFORCE.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::section;
use shoal_base::section::{Change, from, never};
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;
use shoal_policy::network::{Activation, Hidden, Layers, NetworkLayout};

use super::algorithm::{AlgorithmProperties, AlgorithmSettings, LearnedShapes, Shape, TransitionUse};
use super::behaviour::Behaviour;

/// REINFORCE.
pub(super) const PROPERTIES: AlgorithmProperties = AlgorithmProperties {
    name: "reinforce",
    off_policy: false,
    transition_use: TransitionUse::Episodes,
    defaults: include_str!("../../../presets/method/reinforce.toml"),
};

section! {
    /// Algorithm 3 with the numbers of section 4.2.1, and its variants of section 4.2.2.
    pub struct ReinforceConfig {
        /// Units of each of the policy's hidden layers: a list of 1 to 8 layers.
        hidden: Layers = Layers::from([10, 2]), bounds: from(1, 8_192), unit: "units", source: "section 4.2.1",
            change: Change::Shape;
        /// The activation function of the hidden layers, for policy and baseline.
        activation: Activation = Activation::Relu, unit: "–", source: "section 4.2.1", change: Change::Shape;
        /// γ, the discount of one step.
        gamma: f64 = 0.95, bounds: from(0.0, 1.0), unit: "–", source: "section 4.2.1",
            change: never("the rows in the replay were made with it");
        /// Adam's step size for the policy, α.
        learning_rate: f64 = 0.01, bounds: from(0.0, 1.0), unit: "–", source: "section 4.2.1", change: Change::Learning;
        /// What a step's ∇ ln π is multiplied by.
        weight: ReturnWeighting = ReturnWeighting::Normalised, unit: "–", source: "section 4.2.2",
            change: never("a baseline is a network of its own");
        /// Whether the product is also multiplied by γᵗ, as in line 6 of Algorithm 3.
        discount_steps: bool = false, unit: "–", source: "Algorithm 3", change: Change::Learning;
        /// Whether an episode that the time limit ended is learned from.
        learn_at_limit: bool = true, unit: "–", source: "section 4.2.2", change: Change::Learning;
        /// Units of each of the baseline's hidden layers: a list of 1 to 8 layers. Used only with `weight =
        /// "baseline"`.
        baseline_hidden: Layers = Layers::from([32, 32]), bounds: from(1, 8_192), unit: "units", source: "ours",
            change: Change::Shape;
        /// Adam's step size for the baseline.
        baseline_learning_rate: f64 = 0.01, bounds: from(0.0, 1.0), unit: "–", source: "ours", change: Change::Learning;
    }
}

/// What a step's ∇ ln π is multiplied by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ReturnWeighting {
    /// The return G.
    Return,
    /// G minus its mean over the episode, divided by its standard deviation.
    Normalised,
    /// δ = G − V(s), where V is learned together with the policy (equation 3.25).
    Baseline,
}

/// The networks of REINFORCE.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReinforceNetworks {
    /// The policy: logits of the actions.
    pub policy: NetworkLayout,
    /// V, if there is a baseline.
    pub baseline: Option<NetworkLayout>,
}

impl ReinforceConfig {
    /// Its networks in an environment like `spec`.
    pub fn networks(&self, spec: &EnvironmentSpec) -> ReinforceNetworks {
        let network = |layers, outputs| {
            let hidden = Hidden::new(layers, self.activation);
            NetworkLayout::new(spec.observation.width(), hidden, outputs)
        };
        ReinforceNetworks {
            policy: network(self.hidden, spec.action.size()),
            baseline: (self.weight == ReturnWeighting::Baseline).then(|| network(self.baseline_hidden, 1)),
        }
    }
}

impl AlgorithmSettings for ReinforceConfig {
    fn behaviour(&self, spec: &EnvironmentSpec, envs: usize) -> Result<Behaviour, PolicyError> {
        let policy = shoal_policy::softmax(self.networks(spec).policy, spec, envs)?;
        Ok(Behaviour::Softmax(policy))
    }

    fn learned_shapes(&self, spec: &EnvironmentSpec) -> LearnedShapes {
        let ReinforceNetworks { policy, baseline } = self.networks(spec);
        let baseline = baseline.map(|network| ("baseline", Shape::Network(network)));
        LearnedShapes {
            policy: ("policy", Shape::Network(policy)),
            others: baseline.into_iter().collect(),
        }
    }

    fn batch(&self) -> usize {
        1
    }

    /// Only with a baseline is there a second network.
    fn inherited_setting(&self) -> Option<(&'static str, toml::Value)> {
        (self.weight == ReturnWeighting::Baseline).then(|| ("weight", "baseline".into()))
    }
}
