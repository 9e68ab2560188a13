//! `[evaluation]`.

use shoal_base::section;
use shoal_base::section::{Change, from};

section! {
    /// How often, how and on how many episodes policies are evaluated.
    #[derive(Eq)]
    pub struct EvaluationConfig {
        /// Environment steps from one evaluation to the next. A new run with fewer steps gets `run.steps` instead, so
        /// that it is evaluated once.
        every: u64 = 2_000, bounds: from(1, u64::MAX), unit: "environment steps", source: "ours",
            change: Change::Anytime;
        /// Episodes of an evaluation. Their start states are always the same.
        episodes: u32 = 10, bounds: from(1, 10_000), unit: "episodes", source: "ours", change: Change::Anytime;
        /// A policy that beats the best one must also beat it on `confirm` × `episodes` other episodes. 0: the first
        /// comparison decides.
        confirm: u32 = 2, bounds: from(0, 100), unit: "–", source: "ours", change: Change::Anytime;
        /// Environments that the evaluator steps at once; at most one for each episode of an evaluation.
        envs: u32 = 64, bounds: from(1, 64), unit: "environments", source: "ours", change: Change::Anytime;
        /// Episodes of the last evaluation. Their mean return is the run's result.
        final_episodes: u32 = 100, bounds: from(1, 100_000), unit: "episodes", source: "ours", change: Change::Anytime;
        /// Whether every evaluated policy is kept, not only the best.
        keep_policies: bool = false, unit: "–", source: "ours", change: Change::Anytime;
    }
}

impl EvaluationConfig {
    /// The evaluation period of a policy that was learned from `env_steps` environment steps. A policy is evaluated if
    /// no policy of its period or a later one was evaluated before.
    pub fn period(&self, env_steps: u64) -> u64 {
        env_steps / self.every
    }
}
