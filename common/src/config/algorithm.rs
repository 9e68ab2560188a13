//! What is learned, and how: one of the thesis's algorithms, with its own numbers.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The algorithm of a run. Its section in `config.toml` has its name.
#[derive(Clone, Debug, PartialEq)]
pub enum Algorithm {
    /// `[ddpg]` and `[exploration]`.
    Ddpg(Ddpg, Exploration),
    /// `[reinforce]`.
    Reinforce(Reinforce),
    /// `[q-learning]`.
    QLearning(Tabular),
    /// `[sarsa]`.
    Sarsa(Tabular),
}

/// Algorithm 4 with the numbers of section 4.3.1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Ddpg {
    /// Units of the two hidden layers, of actor and critic alike.
    #[schemars(extend("unit" = "units", "source" = "section 4.3.1"))]
    pub hidden: [usize; 2],
    /// γ, the discount of one step.
    #[schemars(extend("unit" = "–", "source" = "section 4.3.1"))]
    pub gamma: f64,
    /// τ, how far the target networks follow in one update (equation 3.31).
    #[schemars(extend("unit" = "–", "source" = "equation 3.31, section 4.3.1"))]
    pub tau: f64,
    /// Adam's step size for the actor, α_μ.
    #[schemars(extend("unit" = "–", "source" = "section 4.3.1"))]
    pub actor_learning_rate: f64,
    /// Adam's step size for the critic, α_Q.
    #[schemars(extend("unit" = "–", "source" = "section 4.3.1"))]
    pub critic_learning_rate: f64,
    /// N, transitions in a minibatch.
    #[schemars(extend("unit" = "transitions", "source" = "Algorithm 4, section 4.3.1"))]
    pub batch: usize,
}

/// Ornstein-Uhlenbeck noise: x ← x − θ x + σ N(0, 1) at each step, added to the action in units of half its range.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Exploration {
    /// θ, the pull towards zero.
    #[schemars(extend("unit" = "1 / step", "source" = "section 4.3.1"))]
    pub theta: f64,
    /// σ, the size of each step's impulse.
    #[schemars(extend("unit" = "half action ranges", "source" = "section 4.3.1"))]
    pub sigma: f64,
    /// What actors do until the learner's first update, while `replay.warmup` fills.
    #[schemars(extend("unit" = "–", "source" = "ours"))]
    pub warmup: Warmup,
}

/// How actors act while nothing has been learned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Warmup {
    /// As ever: the policy's first weights, and noise.
    Policy,
    /// Each element of an action uniformly from its range.
    Uniform,
}

/// Algorithm 3 with the numbers of section 4.2.1, and its variants of section 4.2.2.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Reinforce {
    /// Units of the policy's two hidden layers.
    #[schemars(extend("unit" = "units", "source" = "section 4.2.1"))]
    pub hidden: [usize; 2],
    /// γ, the discount of one step.
    #[schemars(extend("unit" = "–", "source" = "section 4.2.1"))]
    pub gamma: f64,
    /// Adam's step size for the policy, α.
    #[schemars(extend("unit" = "–", "source" = "section 4.2.1"))]
    pub learning_rate: f64,
    /// What a step's ∇ ln π is multiplied by.
    #[schemars(extend("unit" = "–", "source" = "section 4.2.2"))]
    pub weight: Weight,
    /// Whether that is also multiplied by γᵗ, as line 6 of Algorithm 3 has it.
    #[schemars(extend("unit" = "–", "source" = "Algorithm 3"))]
    pub discount_steps: bool,
    /// Whether an episode that the time limit ended is learned from.
    #[schemars(extend("unit" = "–", "source" = "section 4.2.2"))]
    pub learn_at_limit: bool,
    /// Units of the baseline's two hidden layers; only where it is the weight.
    #[schemars(extend("unit" = "units", "source" = "ours"))]
    pub baseline_hidden: [usize; 2],
    /// Adam's step size for the baseline.
    #[schemars(extend("unit" = "–", "source" = "ours"))]
    pub baseline_learning_rate: f64,
}

/// What a step's ∇ ln π is multiplied by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Weight {
    /// The return G.
    Return,
    /// G, less its mean over the episode and divided by its standard deviation.
    Normalised,
    /// δ = G − V(s), V learned beside the policy (equation 3.25).
    Baseline,
}

/// Algorithms 1 and 2 with the numbers of section 4.1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Tabular {
    /// γ, the discount of one step.
    #[schemars(extend("unit" = "–", "source" = "section 4.1"))]
    pub gamma: f64,
    /// α, the step size.
    #[schemars(extend("unit" = "–", "source" = "section 4.1"))]
    pub alpha: f64,
    /// ε, how often an actor takes any action instead of the best.
    #[schemars(extend("unit" = "share of the steps", "source" = "section 4.1"))]
    pub epsilon: f64,
}

impl Algorithm {
    /// All their names, which are their sections'.
    pub const NAMES: [&str; 4] = ["ddpg", "reinforce", "q-learning", "sarsa"];

    /// Its name, which is its section's.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Ddpg(..) => "ddpg",
            Self::Reinforce(_) => "reinforce",
            Self::QLearning(_) => "q-learning",
            Self::Sarsa(_) => "sarsa",
        }
    }

    /// γ, the discount of one step.
    pub fn gamma(&self) -> f64 {
        match self {
            Self::Ddpg(ddpg, _) => ddpg.gamma,
            Self::Reinforce(reinforce) => reinforce.gamma,
            Self::QLearning(tabular) | Self::Sarsa(tabular) => tabular.gamma,
        }
    }

    /// DDPG's numbers, where it is that.
    pub fn ddpg(&self) -> Option<&Ddpg> {
        match self {
            Self::Ddpg(ddpg, _) => Some(ddpg),
            _ => None,
        }
    }

    /// Whether it may learn from what an older policy did.
    pub fn is_off_policy(&self) -> bool {
        matches!(self, Self::Ddpg(..) | Self::QLearning(_))
    }

    /// Whether it learns from transitions drawn at random, again and again; else from each once, in order.
    pub fn samples(&self) -> bool {
        matches!(self, Self::Ddpg(..))
    }

    /// Whether it learns from whole episodes, so that a chunk is one.
    pub fn learns_from_episodes(&self) -> bool {
        matches!(self, Self::Reinforce(_))
    }
}
