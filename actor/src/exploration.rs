//! How actors explore: a variant for each kind of exploration.

use rand::RngExt;
use rand_distr::StandardNormal;
use shoal_common::algorithms::{Behaviour, Epsilon, Warmup};
use shoal_common::network::{ActionRange, DeterministicPolicy, GaussianPolicy};
use shoal_common::policy::{PolicyLayout, Scores, argmax};
use shoal_common::stream::{Stream, seek};

use crate::noise::OrnsteinUhlenbeck;

/// A policy and its exploration, for all environments of an actor. A step's random numbers depend only on its number,
/// so that a repeated step gets the same ones.
#[derive(Clone, Debug)]
pub enum Exploration {
    /// DDPG and TD3: the policy's action and noise (line 8 of Algorithm 4).
    Noise(DeterministicPolicy, OrnsteinUhlenbeck),
    /// SAC: an action drawn from π(·|s).
    Gaussian(GaussianPolicy, Stream),
    /// REINFORCE: an action drawn from π(·|s), the softmax of the scores (line 3 of Algorithm 3).
    Softmax(Scores, Stream),
    /// DQN, Q-learning and SARSA: with probability ε a uniformly random action, otherwise the action with the highest
    /// value, the first among equals (section 3.3.2).
    EpsilonGreedy(Scores, Stream, Epsilon),
}

/// How far a run has come when actions are chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StepCounts {
    /// Steps that each environment has made before, since the actor's random stream began.
    pub step: u64,
    /// Environment steps of all actors that the policy was learned from.
    pub env_steps: u64,
}

impl Exploration {
    /// The exploration for `environments` environments, as many as the policy of `behaviour` was made for.
    pub fn new(behaviour: Behaviour, environments: usize, stream: Stream) -> Self {
        match behaviour {
            Behaviour::Noise(network, noise) => {
                let noise = OrnsteinUhlenbeck::new(&noise, environments, network.range().width(), stream);
                Self::Noise(network, noise)
            }
            Behaviour::Gaussian(policy) => Self::Gaussian(policy, stream),
            Behaviour::Softmax(scores) => Self::Softmax(scores, stream),
            Behaviour::EpsilonGreedy(scores, epsilon) => Self::EpsilonGreedy(scores, stream, epsilon),
        }
    }

    /// The layout of the policy's parameters.
    pub fn layout(&self) -> PolicyLayout {
        match self {
            Self::Noise(network, _) => PolicyLayout::Deterministic(*network.layout()),
            Self::Gaussian(policy, _) => PolicyLayout::Gaussian(*policy.layout()),
            Self::Softmax(scores, _) | Self::EpsilonGreedy(scores, ..) => scores.layout(),
        }
    }

    /// Chooses the actions before the policy's first update.
    pub fn warmup(&mut self, parameters: &[f32], observations: &[f32], steps: StepCounts, actions: &mut [f32]) {
        match self {
            Self::Noise(network, noise) if noise.warmup() == Warmup::Uniform => {
                draw_uniformly(noise.stream_at(steps.step), actions, network.range());
            }
            Self::Gaussian(policy, stream) => draw_uniformly(seek(stream, steps.step), actions, policy.range()),
            _ => self.act(parameters, observations, steps, actions),
        }
    }

    /// Chooses the actions, one for each observation.
    pub fn act(&mut self, parameters: &[f32], observations: &[f32], steps: StepCounts, actions: &mut [f32]) {
        let StepCounts { step, env_steps } = steps;
        match self {
            Self::Noise(network, noise) => {
                network.forward(parameters, observations, actions);
                noise.advance(step);
                noise.add_to(actions, network.range());
            }
            Self::Gaussian(policy, stream) => {
                let stream = seek(stream, step);
                policy.sample(parameters, observations, || stream.sample(StandardNormal), actions);
            }
            Self::Softmax(logits, stream) => {
                let stream = seek(stream, step);
                for (action, logits) in actions.iter_mut().zip(logits.compute(parameters, observations)) {
                    *action = draw(logits, stream.random()) as f32;
                }
            }
            Self::EpsilonGreedy(values, stream, epsilon) => {
                let stream = seek(stream, step);
                let epsilon = epsilon.after(env_steps);
                let count = values.actions();
                for (action, values) in actions.iter_mut().zip(values.compute(parameters, observations)) {
                    // Both are always drawn, so that one environment's choice does not shift the next one's random
                    // numbers.
                    let (explore, which): (f64, f64) = (stream.random(), stream.random());
                    let any = (which * count as f64) as usize;
                    *action = if explore < epsilon { any } else { argmax(values) } as f32;
                }
            }
        }
    }

    /// Begins an episode of one environment (line 5 of Algorithm 4).
    pub fn begin_episode(&mut self, environment: usize) {
        if let Self::Noise(_, noise) = self {
            noise.reset(environment);
        }
    }

    /// The state that the next step depends on besides its number, one environment after another.
    pub(crate) fn state(&self) -> &[f64] {
        match self {
            Self::Noise(_, noise) => noise.state(),
            Self::Gaussian(..) | Self::Softmax(..) | Self::EpsilonGreedy(..) => &[],
        }
    }

    /// Continues from this state, which must have the length of `state`.
    pub(crate) fn restore(&mut self, state: &[f64]) {
        if let Self::Noise(_, noise) = self {
            noise.restore(state);
        }
    }
}

/// Draws every element of the actions uniformly from its range.
fn draw_uniformly(stream: &mut Stream, actions: &mut [f32], range: &ActionRange) {
    for action in actions.chunks_exact_mut(range.width()) {
        for (element, a) in action.iter_mut().enumerate() {
            *a = range.action(element, stream.random_range(-1.0..=1.0));
        }
    }
}

/// Draws an action from the softmax of these logits by `u`, which is uniform in [0, 1).
fn draw(logits: &[f32], u: f64) -> usize {
    let greatest = f64::from(logits[argmax(logits)]);
    let weight = |logit: &f32| (f64::from(*logit) - greatest).exp();
    let mut left = u * logits.iter().map(weight).sum::<f64>();
    for (action, logit) in logits.iter().enumerate() {
        left -= weight(logit);
        if left < 0.0 {
            return action;
        }
    }
    logits.len() - 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_common::config::{
        AlgorithmConfig, DdpgConfig, DqnConfig, ReinforceConfig, SacConfig, TabularConfig, Td3Config,
    };
    use shoal_common::space::{EnvironmentSpec, Space};
    use shoal_common::stream::{Purpose, stream};

    fn at(step: u64) -> StepCounts {
        StepCounts { step, env_steps: 0 }
    }

    fn lake(epsilon: f64) -> Exploration {
        let spec = EnvironmentSpec {
            observation: Space::discrete(2),
            action: Space::discrete(4),
            time_limit: 100,
            state_width: 1,
        };
        let tabular = TabularConfig {
            epsilon,
            ..TabularConfig::default()
        };
        let stream = stream(7, Purpose::Exploration, 0, 0);
        Exploration::new(
            AlgorithmConfig::QLearning(tabular).behaviour(&spec, 1).unwrap(),
            1,
            stream,
        )
    }

    /// How often each action was chosen in 4,000 steps.
    fn counts(exploration: &mut Exploration, parameters: &[f32], observation: &[f32]) -> Vec<u32> {
        let mut counts = vec![0; 4];
        let mut action = [f32::NAN];
        for step in 0..4_000 {
            exploration.act(parameters, observation, at(step), &mut action);
            counts[action[0] as usize] += 1;
        }
        counts
    }

    #[test]
    fn epsilon_is_shared_by_all_actions_and_the_best_one_has_the_rest() {
        let values = [0.0, 3.0, 3.0, 1.0, 0.0, 0.0, 0.0, 2.0];
        assert_eq!(
            counts(&mut lake(0.0), &values, &[0.0]),
            [0, 4_000, 0, 0],
            "the first among equals"
        );
        let exploring = counts(&mut lake(0.4), &values, &[1.0]);
        // 400 are expected of each, with a standard deviation of 19, and 2,800 of the best one.
        assert!(exploring[..3].iter().all(|n| n.abs_diff(400) < 100), "{exploring:?}");
        assert!(exploring[3].abs_diff(2_800) < 150, "{exploring:?}");
    }

    #[test]
    fn actions_are_drawn_from_the_softmax_and_depend_only_on_the_step() {
        let spec = EnvironmentSpec {
            observation: Space::boxed(&[(-1.0, 1.0)]),
            action: Space::discrete(2),
            time_limit: 100,
            state_width: 1,
        };
        let stream = stream(7, Purpose::Exploration, 0, 0);
        let algorithm = AlgorithmConfig::Reinforce(ReinforceConfig {
            hidden: [1, 1].into(),
            ..ReinforceConfig::default()
        });
        let mut policy = Exploration::new(algorithm.behaviour(&spec, 1).unwrap(), 1, stream);
        // The logits are 0 and ln 3, whatever is observed: probabilities 1/4 and 3/4.
        let parameters = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 3_f32.ln()];
        let drawn = counts(&mut policy, &parameters, &[0.5]);
        assert!(drawn[0].abs_diff(1_000) < 120 && drawn[2] == 0, "{drawn:?}");
        assert_eq!(counts(&mut policy, &parameters, &[0.5]), drawn);
    }

    #[test]
    fn warmup_actions_may_be_uniform_over_their_range_and_depend_only_on_the_step() {
        let spec = EnvironmentSpec {
            observation: Space::boxed(&[(-1.0, 1.0)]),
            action: Space::boxed(&[(-2.0, 2.0), (0.0, 8.0)]),
            time_limit: 100,
            state_width: 1,
        };
        let new_for = |algorithm: AlgorithmConfig| {
            let behaviour = algorithm.behaviour(&spec, 1).unwrap();
            Exploration::new(behaviour, 1, stream(7, Purpose::Exploration, 0, 0))
        };
        let new = |warmup| {
            let noise = shoal_common::config::ExplorationConfig {
                warmup,
                ..Default::default()
            };
            new_for(AlgorithmConfig::Ddpg(DdpgConfig {
                exploration: noise,
                ..DdpgConfig::default()
            }))
        };
        type Act = fn(&mut Exploration, &[f32], &[f32], StepCounts, &mut [f32]);
        let choose = |exploration: &mut Exploration, act: Act, step| {
            let parameters = vec![0.0; exploration.layout().parameters()];
            let mut action = [f32::NAN; 2];
            act(exploration, &parameters, &[0.5], at(step), &mut action);
            action
        };
        let (warmup, act): (Act, Act) = (Exploration::warmup, Exploration::act);

        let mut uniform = new(Warmup::Uniform);
        let warm: Vec<_> = (0..1_000).map(|step| choose(&mut uniform, warmup, step)).collect();
        assert_eq!(choose(&mut uniform, warmup, 77), warm[77]);
        for (element, (low, high)) in [(-2.0, 2.0), (0.0, 8.0)].into_iter().enumerate() {
            let quarter_of = |action: &[f32; 2]| ((action[element] - low) / (high - low) * 4.0) as usize;
            for quarter in 0..4 {
                let count = warm.iter().filter(|action| quarter_of(action) == quarter).count();
                // 250 are expected, with a standard deviation of 14.
                assert!(
                    count.abs_diff(250) < 70,
                    "element {element}, quarter {quarter}: {count}"
                );
            }
        }
        for algorithm in [
            AlgorithmConfig::Td3(Td3Config::default()),
            AlgorithmConfig::Sac(SacConfig::default()),
        ] {
            assert_eq!(choose(&mut new_for(algorithm), warmup, 77), warm[77]);
        }
        let mut with_policy = new(Warmup::Policy);
        let noisy = choose(&mut with_policy, warmup, 0);
        assert_eq!(
            choose(&mut uniform, act, 0),
            noisy,
            "the noise begins at rest after a uniform warm-up"
        );
        assert_eq!(choose(&mut new(Warmup::Policy), act, 0), noisy);
    }

    #[test]
    fn sacs_actions_have_the_policys_distribution_and_depend_only_on_the_step() {
        let spec = EnvironmentSpec {
            observation: Space::boxed(&[(-1.0, 1.0)]),
            action: Space::boxed(&[(-1.0, 1.0)]),
            time_limit: 100,
            state_width: 1,
        };
        let algorithm = AlgorithmConfig::Sac(SacConfig {
            hidden: [1].into(),
            ..SacConfig::default()
        });
        let behaviour = algorithm.behaviour(&spec, 1).unwrap();
        let mut exploration = Exploration::new(behaviour, 1, stream(7, Purpose::Exploration, 0, 0));
        // Whatever is observed, μ = 0.3 and log σ = −1.
        let parameters = [0.0, 0.0, 0.0, 0.0, 0.3, -1.0];
        let mut u = |step| {
            let mut action = [f32::NAN];
            exploration.act(&parameters, &[0.5], at(step), &mut action);
            f64::from(action[0]).atanh()
        };
        let drawn: Vec<f64> = (0..4_000).map(&mut u).collect();
        let mean = drawn.iter().sum::<f64>() / 4_000.0;
        let sigma = (drawn.iter().map(|u| (u - mean).powi(2)).sum::<f64>() / 4_000.0).sqrt();
        // Their standard errors are 0.006 and 0.004.
        assert!((mean - 0.3).abs() < 0.03, "mean {mean}");
        assert!((sigma - (-1.0_f64).exp()).abs() < 0.02, "standard deviation {sigma}");
        assert_eq!(u(77), drawn[77]);
    }

    #[test]
    fn dqns_epsilon_follows_the_environment_steps_that_the_policy_was_learned_from() {
        let spec = EnvironmentSpec {
            observation: Space::boxed(&[(-1.0, 1.0)]),
            action: Space::discrete(4),
            time_limit: 100,
            state_width: 1,
        };
        let algorithm = AlgorithmConfig::Dqn(DqnConfig {
            hidden: [1].into(),
            epsilon_end: 0.0,
            epsilon_steps: 1_000,
            ..DqnConfig::default()
        });
        let behaviour = algorithm.behaviour(&spec, 1).unwrap();
        let mut exploration = Exploration::new(behaviour, 1, stream(7, Purpose::Exploration, 0, 0));
        // The third action has the highest value.
        let parameters = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5];
        let mut best = |env_steps| {
            let mut action = [f32::NAN];
            let steps = (0..2_000).filter(|step| {
                let steps = StepCounts { step: *step, env_steps };
                exploration.act(&parameters, &[0.5], steps, &mut action);
                action[0] == 2.0
            });
            steps.count()
        };
        // A quarter of the random actions is the best one: 500, 1,250 and 2,000 with standard deviations of 19 and 22.
        assert!(best(0).abs_diff(500) < 100);
        assert!(best(500).abs_diff(1_250) < 110);
        assert_eq!(best(1_000), 2_000);
    }

    #[test]
    fn the_last_action_takes_the_remainder_of_rounding() {
        assert_eq!(draw(&[0.0, 0.0], 1.0), 1);
        assert_eq!(draw(&[f32::NEG_INFINITY, 1e30], 0.0), 1);
    }
}
