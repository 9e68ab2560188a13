//! `[evaluation]`.

use shoal_base::section;
use shoal_base::section::from;

section! {
    /// How often the policy is evaluated.
    #[derive(Eq)]
    pub struct EvaluationConfig {
        /// Environment steps from one evaluation to the next.
        every: u64 = 2_000, bounds: from(1, u64::MAX), unit: "environment steps", source: "ours";
        /// Episodes of an evaluation, always from the same start states.
        episodes: u32 = 10, bounds: from(1, 10_000), unit: "episodes", source: "ours";
        /// A policy that seems better than the best one has to be better on so many times the episodes, other ones, as well. 0:
        /// the first comparison decides.
        confirm: u32 = 2, bounds: from(0, 100), unit: "–", source: "ours";
        /// Episodes of the last evaluation, whose mean is the run's result.
        final_episodes: u32 = 100, bounds: from(1, 100_000), unit: "episodes", source: "ours";
        /// Whether every policy that was evaluated is kept, not only the best.
        keep_policies: bool = false, unit: "–", source: "ours";
    }
}

impl EvaluationConfig {
    /// The period that a policy learned from so many environment steps falls into. A policy is evaluated when no policy of
    /// its period or a later one was.
    pub fn period(&self, env_steps: u64) -> u64 {
        env_steps / self.every
    }
}
