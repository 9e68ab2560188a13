//! `[td3]`: twin delayed deep deterministic policy gradient.

use shoal_base::section;
use shoal_base::section::{Change, EXPLORATION, OutOfRange, above, from, never};
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;
use shoal_policy::network::{Activation, Hidden, Layers, NetworkLayout};

use super::algorithm::{AlgorithmSettings, AlgorithmSpec, Experience, Learned, Shape};
use super::behaviour::Behaviour;
use super::exploration::{ExplorationConfig, Warmup};
use super::preparation::Preparation;

/// TD3.
pub(super) const SPEC: AlgorithmSpec = AlgorithmSpec {
    name: "td3",
    off_policy: true,
    experience: Experience::Minibatches,
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
            change: never("the rows in the replay have it");
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
        /// How observations and rewards are prepared. They have their own sections, `[observation]` and `[reward]`.
        #[serde(skip)]
        #[schemars(skip)]
        preparation: Preparation = Preparation::default();
    }
}

impl Td3Config {
    /// The hidden layers of actor and critics.
    pub fn hidden_layers(&self) -> Hidden {
        Hidden {
            layers: self.hidden,
            activation: self.activation,
        }
    }
}

impl AlgorithmSettings for Td3Config {
    fn check(&self, section: &str) -> Result<(), OutOfRange> {
        self.preparation.check()?;
        self.check_bounds(section)
    }

    fn gamma(&self) -> f64 {
        self.gamma
    }

    fn preparation(&self) -> Option<&Preparation> {
        Some(&self.preparation)
    }

    fn preparation_mut(&mut self) -> Option<&mut Preparation> {
        Some(&mut self.preparation)
    }

    fn behaviour(&self, name: &'static str, spec: &EnvironmentSpec, batch: usize) -> Result<Behaviour, PolicyError> {
        shoal_policy::real_observations(name, spec)?;
        let network = shoal_policy::deterministic(self.hidden_layers(), spec, batch)?;
        let network = network.normalising(self.preparation.observation.normalise);
        // With θ = 1 the noise of a step does not depend on the previous one: it is N(0, σ²).
        let noise = ExplorationConfig {
            theta: 1.0,
            sigma: self.exploration_noise,
            warmup: Warmup::Uniform,
        };
        Ok(Behaviour::Noise(network, noise))
    }

    fn exploration_state_width(&self, spec: &EnvironmentSpec) -> usize {
        spec.action.width()
    }

    fn least_capacity(&self) -> u64 {
        self.batch as u64
    }

    fn learned(&self, spec: &EnvironmentSpec) -> Learned {
        let (observation, action) = (spec.observation.width(), spec.action.width());
        let actor = NetworkLayout::policy(observation, self.hidden_layers(), action)
            .normalising(self.preparation.observation.normalise);
        let critic = Shape::Network(NetworkLayout::joined_critic(observation, self.hidden_layers(), action));
        Learned {
            policy: ("actor", Shape::Network(actor)),
            others: vec![("critic 1", critic), ("critic 2", critic)],
        }
    }
}
