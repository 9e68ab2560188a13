//! `[td3]`: twin delayed deep deterministic policy gradient.

use shoal_base::section;
use shoal_base::section::{Change, EXPLORATION, above, from, never};
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;
use shoal_policy::network::{Activation, Hidden, Layers, NetworkLayout};

use super::algorithm::{ActorCritic, AlgorithmProperties, AlgorithmSettings, LearnedShapes, TransitionUse};
use super::behaviour::Behaviour;
use super::exploration::{ExplorationConfig, Warmup};

/// TD3.
pub(super) const PROPERTIES: AlgorithmProperties = AlgorithmProperties {
    name: "td3",
    off_policy: true,
    transition_use: TransitionUse::Minibatches,
    defaults: include_str!("../../../presets/method/td3.toml"),
};

section! {
    /// Fujimoto et al. 2018, with their numbers.
    pub struct Td3Config {
        /// Units of each hidden layer, for actor and critics: a list of 1 to 8 layers.
        hidden: Layers = Layers::from([256, 256]), bounds: from(1, 8_192), unit: "units", source: "the authors' program",
            change: Change::Shape;
        /// The activation function of the hidden layers.
        activation: Activation = Activation::Relu, unit: "–", source: "Fujimoto et al. 2018", change: Change::Shape;
        /// γ, the discount of one step.
        gamma: f64 = 0.99, bounds: from(0.0, 1.0), unit: "–", source: "Fujimoto et al. 2018",
            change: never("the rows in the replay were made with it");
        /// τ, the share by which the target networks move at each update of the policy.
        tau: f64 = 0.005, bounds: above(0.0, 1.0), unit: "–", source: "Fujimoto et al. 2018", change: Change::Learning;
        /// Adam's step size for the actor.
        actor_learning_rate: f64 = 1e-3, bounds: above(0.0, 1.0), unit: "–", source: "Fujimoto et al. 2018",
            change: Change::Learning;
        /// Adam's step size for the critics.
        critic_learning_rate: f64 = 1e-3, bounds: above(0.0, 1.0), unit: "–", source: "Fujimoto et al. 2018",
            change: Change::Learning;
        /// N, transitions in a minibatch.
        batch: usize = 256, bounds: from(1, 65_536), unit: "transitions", source: "the authors' program",
            change: Change::Learning;
        /// d: the policy and the target networks are updated at every d-th update of the critics.
        policy_delay: u64 = 2, bounds: from(1, 1_000), unit: "updates", source: "Fujimoto et al. 2018",
            change: never("the actor's optimiser counts its steps by it");
        /// σ̃, the standard deviation of the noise on the target policy's action.
        target_noise: f64 = 0.2, bounds: from(0.0, 10.0), unit: "half action ranges", source: "Fujimoto et al. 2018",
            change: Change::Learning;
        /// c: that noise is clipped to −c … c.
        target_noise_clip: f64 = 0.5, bounds: from(0.0, 10.0), unit: "half action ranges",
            source: "Fujimoto et al. 2018", change: Change::Learning;
        /// The standard deviation of the noise that actors add to their actions. Until the first update they draw
        /// actions uniformly.
        exploration_noise: f64 = 0.1, bounds: from(0.0, 10.0), unit: "half action ranges",
            source: "Fujimoto et al. 2018", change: EXPLORATION;
    }
}

impl Td3Config {
    /// Its networks in an environment like `spec`. Both critics have the same layout.
    pub fn networks(&self, spec: &EnvironmentSpec) -> ActorCritic {
        let (observation, action) = (spec.observation.width(), spec.action.width());
        let hidden = Hidden::new(self.hidden, self.activation);
        ActorCritic {
            actor: NetworkLayout::new(observation, hidden, action),
            critic: NetworkLayout::joined_critic(observation, hidden, action),
        }
    }
}

impl AlgorithmSettings for Td3Config {
    fn behaviour(&self, spec: &EnvironmentSpec, envs: usize) -> Result<Behaviour, PolicyError> {
        shoal_policy::check_real_observations(spec)?;
        let policy = shoal_policy::deterministic(self.networks(spec).actor, spec, envs)?;
        // With θ = 1 the noise of a step does not depend on the previous one: it is N(0, σ²).
        let noise = ExplorationConfig {
            theta: 1.0,
            sigma: self.exploration_noise,
            warmup: Warmup::Uniform,
        };
        Ok(Behaviour::Noise(policy, noise))
    }

    fn learned_shapes(&self, spec: &EnvironmentSpec) -> LearnedShapes {
        self.networks(spec).with_twin_critics()
    }

    fn batch(&self) -> usize {
        self.batch
    }
}
