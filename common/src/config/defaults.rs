//! What a configuration is where nothing else is said: the thesis's numbers where it prints them (section 4.3.1).

use super::{Actors, Checkpoint, Ddpg, Evaluation, Exploration, Mode, Replay, Run};

impl Default for Run {
    fn default() -> Self {
        Self {
            id: String::new(),
            seed: 1,
            mode: Mode::Free,
            steps: 120_000,
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
