//! `[ddpg]`: deep deterministic policy gradient.

use shoal_base::section;
use shoal_base::section::{Change, above, from, never};
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;
use shoal_policy::network::{Activation, Hidden, Layers, NetworkLayout};

use super::algorithm::{ActorCritic, AlgorithmProperties, AlgorithmSettings, LearnedShapes, Shape, TransitionUse};
use super::behaviour::Behaviour;
use super::exploration::ExplorationConfig;

/// DDPG.
pub(super) const PROPERTIES: AlgorithmProperties = AlgorithmProperties {
    name: "ddpg",
    off_policy: true,
    transition_use: TransitionUse::Minibatches,
    defaults: include_str!("../../../presets/method/ddpg.toml"),
};

section! {
    /// Algorithm 4 with the numbers of section 4.3.1.
    pub struct DdpgConfig {
        /// Units of each hidden layer, for actor and critic: a list of 1 to 8 layers. The action enters the critic at
        /// the second hidden layer, or at the only one.
        hidden: Layers = Layers::from([400, 300]), bounds: from(1, 8_192), unit: "units", source: "section 4.3.1",
            change: Change::Shape;
        /// The activation function of the hidden layers.
        activation: Activation = Activation::Relu, unit: "–", source: "section 4.3.1", change: Change::Shape;
        /// γ, the discount of one step.
        gamma: f64 = 0.99, bounds: from(0.0, 1.0), unit: "–", source: "section 4.3.1",
            change: never("the rows in the replay were made with it");
        /// τ, the share by which the target networks move in one gradient step (equation 3.31).
        tau: f64 = 0.001, bounds: above(0.0, 1.0), unit: "–", source: "equation 3.31, section 4.3.1",
            change: Change::Learning;
        /// Adam's step size for the actor, α_μ.
        actor_learning_rate: f64 = 1e-4, bounds: above(0.0, 1.0), unit: "–", source: "section 4.3.1",
            change: Change::Learning;
        /// Adam's step size for the critic, α_Q.
        critic_learning_rate: f64 = 1e-3, bounds: above(0.0, 1.0), unit: "–", source: "section 4.3.1",
            change: Change::Learning;
        /// N, transitions in a minibatch.
        batch: usize = 64, bounds: from(1, 65_536), unit: "transitions", source: "Algorithm 4, section 4.3.1",
            change: Change::Learning;
        /// The noise of its actors.
        exploration: ExplorationConfig = ExplorationConfig::default(), section: "exploration";
    }
}

impl DdpgConfig {
    /// Its networks in an environment like `spec`.
    pub fn networks(&self, spec: &EnvironmentSpec) -> ActorCritic {
        let (observation, action) = (spec.observation.width(), spec.action.width());
        let hidden = Hidden::new(self.hidden, self.activation);
        ActorCritic {
            actor: NetworkLayout::new(observation, hidden, action),
            critic: NetworkLayout::critic(observation, hidden, action),
        }
    }
}

impl AlgorithmSettings for DdpgConfig {
    fn behaviour(&self, spec: &EnvironmentSpec, envs: usize) -> Result<Behaviour, PolicyError> {
        let policy = shoal_policy::deterministic(self.networks(spec).actor, spec, envs)?;
        Ok(Behaviour::Noise(policy, self.exploration.clone()))
    }

    fn learned_shapes(&self, spec: &EnvironmentSpec) -> LearnedShapes {
        let ActorCritic { actor, critic } = self.networks(spec);
        LearnedShapes {
            policy: ("actor", Shape::Network(actor)),
            others: vec![("critic", Shape::Network(critic))],
        }
    }

    fn batch(&self) -> usize {
        self.batch
    }
}
