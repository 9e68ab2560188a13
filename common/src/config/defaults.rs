//! What a configuration is where nothing else is said: the thesis's numbers where it prints them (sections 4.1 to 4.3).

use super::{
    Actors, Checkpoint, Ddpg, Evaluation, Exploration, Learner, Mode, Reinforce, Replay, Run, Tabular, Warmup, Weight,
};

impl Default for Run {
    fn default() -> Self {
        Self {
            id: String::new(),
            seed: 1,
            mode: Mode::Free,
            steps: 120_000,
            episodes: None,
            stall_seconds: 10,
        }
    }
}

impl Default for Actors {
    fn default() -> Self {
        Self {
            count: 2,
            envs: 1,
            chunk_steps: 8,
            window: 8,
            max: 16,
        }
    }
}

impl Default for Exploration {
    fn default() -> Self {
        Self {
            theta: 0.15,
            sigma: 0.2,
            warmup: Warmup::Policy,
        }
    }
}

impl Default for Ddpg {
    fn default() -> Self {
        Self {
            hidden: [400, 300],
            gamma: 0.99,
            tau: 0.001,
            actor_learning_rate: 1e-4,
            critic_learning_rate: 1e-3,
            batch: 64,
        }
    }
}

impl Default for Learner {
    fn default() -> Self {
        Self { threads: 2 }
    }
}

impl Default for Reinforce {
    fn default() -> Self {
        Self {
            hidden: [10, 2],
            gamma: 0.95,
            learning_rate: 0.01,
            weight: Weight::Normalised,
            discount_steps: false,
            learn_at_limit: true,
            baseline_hidden: [32, 32],
            baseline_learning_rate: 0.01,
        }
    }
}

impl Default for Tabular {
    fn default() -> Self {
        Self {
            gamma: 0.999,
            alpha: 0.03,
            epsilon: 0.4,
        }
    }
}

impl Default for Replay {
    fn default() -> Self {
        Self {
            capacity: 1_000_000,
            warmup: 1_000,
            updates_per_step: 1.0,
            tolerance: 512,
        }
    }
}

impl Default for Evaluation {
    fn default() -> Self {
        Self {
            every: 2_000,
            episodes: 10,
            final_episodes: 100,
            keep_policies: false,
        }
    }
}

impl Default for Checkpoint {
    fn default() -> Self {
        Self {
            every_seconds: 5.0,
            every_updates: 5_000,
        }
    }
}
