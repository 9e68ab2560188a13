//! `[sac]`: soft actor-critic.

use shoal_base::section;
use shoal_base::section::{Change, above, from, never};
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;
use shoal_policy::network::{Activation, Hidden, Layers, NetworkLayout};

use super::algorithm::{ActorCritic, AlgorithmProperties, AlgorithmSettings, LearnedShapes, TransitionUse};
use super::behaviour::Behaviour;

/// SAC.
pub(super) const PROPERTIES: AlgorithmProperties = AlgorithmProperties {
    name: "sac",
    off_policy: true,
    transition_use: TransitionUse::Minibatches,
    defaults: include_str!("../../../presets/method/sac.toml"),
};

section! {
    /// Haarnoja et al. 2018b: a squashed Gaussian policy, two critics, and a learned temperature.
    pub struct SacConfig {
        /// Units of each hidden layer, for actor and critics: a list of 1 to 8 layers.
        hidden: Layers = Layers::from([256, 256]), bounds: from(1, 8_192), unit: "units", source: "Haarnoja et al. 2018b",
            change: Change::Shape;
        /// The activation function of the hidden layers.
        activation: Activation = Activation::Relu, unit: "–", source: "Haarnoja et al. 2018b", change: Change::Shape;
        /// γ, the discount of one step.
        gamma: f64 = 0.99, bounds: from(0.0, 1.0), unit: "–", source: "Haarnoja et al. 2018b",
            change: never("the rows in the replay were made with it");
        /// τ, the share by which the critics' target networks move in one update.
        tau: f64 = 0.005, bounds: above(0.0, 1.0), unit: "–", source: "Haarnoja et al. 2018b", change: Change::Learning;
        /// Adam's step size for the actor.
        actor_learning_rate: f64 = 3e-4, bounds: above(0.0, 1.0), unit: "–", source: "Haarnoja et al. 2018b",
            change: Change::Learning;
        /// Adam's step size for the critics.
        critic_learning_rate: f64 = 3e-4, bounds: above(0.0, 1.0), unit: "–", source: "Haarnoja et al. 2018b",
            change: Change::Learning;
        /// Adam's step size for log α. With 0 the temperature stays at its initial value.
        temperature_learning_rate: f64 = 3e-4, bounds: from(0.0, 1.0), unit: "–", source: "Haarnoja et al. 2018b",
            change: Change::Learning;
        /// α, the weight of the policy's entropy, at the beginning.
        initial_temperature: f64 = 1.0, bounds: above(0.0, 1_000.0), unit: "–", source: "the authors' program",
            change: never("the temperature has been learned since");
        /// H̄, the entropy that the temperature aims at, for each element of the action.
        target_entropy_per_element: f64 = -1.0, bounds: from(-100.0, 100.0), unit: "nats per action element",
            source: "Haarnoja et al. 2018b", change: Change::Learning;
        /// N, transitions in a minibatch.
        batch: usize = 256, bounds: from(1, 65_536), unit: "transitions", source: "Haarnoja et al. 2018b",
            change: Change::Learning;
    }
}

impl SacConfig {
    /// Its networks in an environment like `spec`. Both critics have the same layout. The actor has two outputs for
    /// each element of the action: all means, then all log standard deviations.
    pub fn networks(&self, spec: &EnvironmentSpec) -> ActorCritic {
        let (observation, action) = (spec.observation.width(), spec.action.width());
        let hidden = Hidden::new(self.hidden, self.activation);
        ActorCritic {
            actor: NetworkLayout::new(observation, hidden, 2 * action),
            critic: NetworkLayout::joined_critic(observation, hidden, action),
        }
    }
}

impl AlgorithmSettings for SacConfig {
    fn behaviour(&self, spec: &EnvironmentSpec, envs: usize) -> Result<Behaviour, PolicyError> {
        let policy = shoal_policy::gaussian(self.networks(spec).actor, spec, envs)?;
        Ok(Behaviour::Gaussian(policy))
    }

    fn learned_shapes(&self, spec: &EnvironmentSpec) -> LearnedShapes {
        self.networks(spec).with_twin_critics()
    }

    fn batch(&self) -> usize {
        self.batch
    }
}
