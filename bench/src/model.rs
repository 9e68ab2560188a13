//! A closed queueing network that predicts the rates of a run from the costs of its stages.
//!
//! Each actor has a window of chunks in circulation. The actor fills one chunk at a time; a full chunk then queues at
//! the learner, which receives the chunks of all actors. Both times are assumed to be exponentially distributed with
//! the measured means. Real times vary less, so real waits are shorter than predicted.
//!
//! The network has an exact product-form solution: the state with kᵢ chunks of actor i at the learner, K of them in
//! all, has the weight K!/(k₁! … kₙ!) · (service/think)^K. With a window of one chunk it is the machine-repairman
//! model, which mean value analysis solves.

use serde::Serialize;

/// Actors that fill chunks, and one learner that receives them.
#[derive(Clone, Copy, Debug)]
pub(super) struct QueueingNetwork {
    pub(super) actors: u32,
    /// Chunks in circulation per actor.
    pub(super) window: u32,
    /// Mean time of an actor to fill a chunk, in seconds.
    pub(super) think: f64,
    /// Mean time of the learner to receive a chunk, in seconds.
    pub(super) service: f64,
}

impl QueueingNetwork {
    /// Chunks a second.
    pub(super) fn throughput(&self) -> f64 {
        let ratio = (self.service / self.think).ln();
        let choices: Vec<f64> = (0..=self.window)
            .scan(0.0, |factorial, k| {
                *factorial += f64::from(k.max(1)).ln();
                Some(f64::from(k) * ratio - *factorial)
            })
            .collect();
        // For each K, the logarithm of the sum over all states with K chunks at the learner, without the factor K!.
        // One convolution per actor.
        let mut states = vec![0.0];
        for _ in 0..self.actors {
            states = (0..states.len() + choices.len() - 1)
                .map(|total| {
                    let first = total.saturating_sub(states.len() - 1);
                    let last = total.min(choices.len() - 1);
                    log_sum((first..=last).map(|k| choices[k] + states[total - k]))
                })
                .collect();
        }
        let mut factorial = 0.0;
        for (total, state) in states.iter_mut().enumerate() {
            factorial += (total.max(1) as f64).ln();
            *state += factorial;
        }
        let all = log_sum(states.iter().copied());
        let busy = log_sum(states[1..].iter().copied());
        (busy - all).exp() / self.service
    }
}

/// The logarithm of a sum, from the logarithms of its terms.
fn log_sum(logarithms: impl Iterator<Item = f64> + Clone) -> f64 {
    let greatest = logarithms.clone().fold(f64::NEG_INFINITY, f64::max);
    greatest + logarithms.map(|it| (it - greatest).exp()).sum::<f64>().ln()
}

/// Times of the stages, in seconds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stages {
    /// An actor with its environment server fills a chunk, each on a core of its own.
    pub(super) think: f64,
    /// The same on one shared core.
    pub(super) think_on_one_core: f64,
    /// The learner receives a chunk.
    pub(super) intake: f64,
    /// The learner makes a gradient step.
    pub(super) update: f64,
    pub(super) window: u32,
}

/// The predicted rates of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Expected {
    pub(super) chunks_per_second: f64,
    pub(super) updates_per_second: f64,
}

/// The resource that keeps a run from becoming faster with more actors.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Bottleneck {
    pub(super) resource: &'static str,
    /// The number of actors that saturates it.
    pub(super) actors: f64,
}

pub(super) const CORES: &str = "cores";
pub(super) const INTAKE: &str = "the learner's intake";
pub(super) const UPDATES: &str = "the learner's updates, over which the actors' windows fill";

impl Stages {
    /// A run in which every process has a core of its own. The learner receives everything; with `updates` it makes
    /// gradient steps in the rest of its time.
    pub(super) fn with_own_cores(&self, actors: u32, updates: bool) -> Expected {
        self.with_shares(actors, updates, self.think, 1.0)
    }

    /// A run on `cores` cores. An actor and its server take turns, so such a pair counts as one runnable process and
    /// the learner as another. Runnable processes share the cores equally.
    pub(super) fn on_cores(&self, cores: u32, actors: u32, updates: bool) -> Expected {
        let (cores, n) = (f64::from(cores), f64::from(actors));
        let think = if 2.0 * n + 1.0 <= cores {
            self.think
        } else {
            // With too few cores the system puts a pair on one core. This can even be faster, because an idle core
            // would have to be woken for each request.
            self.think_on_one_core
        };
        if updates {
            // A learner that makes gradient steps is always runnable.
            let learner = (cores / (n + 1.0)).min(1.0);
            let pair = ((cores - learner) / n).min(1.0);
            return self.with_shares(actors, true, think / pair, learner);
        }
        // A learner that only receives is idle at times. The total work must fit the cores.
        let most = cores / (think + self.intake);
        let Expected { chunks_per_second, .. } = self.with_shares(actors, false, think, 1.0);
        Expected {
            chunks_per_second: chunks_per_second.min(most),
            updates_per_second: 0.0,
        }
    }

    /// The rates if a pair takes `think` per chunk and the learner has the given share of a core.
    fn with_shares(&self, actors: u32, updates: bool, think: f64, share: f64) -> Expected {
        // Between two gradient steps the learner receives at most a window from each actor, so under load each chunk
        // carries its part of a gradient step. Without load the actor continues while the chunk waits, so it costs
        // nothing.
        let carried = if updates {
            self.update / f64::from(self.window * actors)
        } else {
            0.0
        };
        let chunks_per_second = QueueingNetwork {
            actors,
            window: self.window,
            think,
            service: (self.intake + carried) / share,
        }
        .throughput();
        let left = (share - chunks_per_second * self.intake).max(0.0);
        Expected {
            chunks_per_second,
            updates_per_second: if updates { left / self.update } else { 0.0 },
        }
    }

    /// The first bottleneck for more actors when every process has a core of its own.
    pub(super) fn first_bottleneck_with_own_cores(&self, updates: bool) -> Bottleneck {
        let window = f64::from(self.window);
        if updates {
            // n/think = n · window / (update + n · window · intake).
            let actors = (window * self.think - self.update) / (window * self.intake);
            return Bottleneck {
                resource: if actors > 1.0 { INTAKE } else { UPDATES },
                actors: actors.max(1.0),
            };
        }
        Bottleneck {
            resource: INTAKE,
            actors: (self.think + self.intake) / self.intake,
        }
    }

    /// The first bottleneck for more actors on `cores` cores, with a learner that makes no gradient steps.
    pub(super) fn first_bottleneck_on_cores(&self, cores: u32) -> Bottleneck {
        let think = self.think_on_one_core;
        let actors = f64::from(cores) * think / (think + self.intake);
        let intake = self.first_bottleneck_with_own_cores(false);
        if actors < intake.actors {
            Bottleneck {
                resource: CORES,
                actors,
            }
        } else {
            intake
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn network(actors: u32, window: u32, think: f64, service: f64) -> QueueingNetwork {
        QueueingNetwork {
            actors,
            window,
            think,
            service,
        }
    }

    fn close(found: f64, expected: f64) {
        assert!((found / expected - 1.0).abs() < 1e-9, "{found} for {expected}");
    }

    /// Exact mean value analysis of one queue and a delay.
    fn mean_value_analysis(actors: u32, think: f64, service: f64) -> f64 {
        let (mut waiting, mut throughput) = (0.0, 0.0);
        for n in 1..=actors {
            let response = service * (1.0 + waiting);
            throughput = f64::from(n) / (think + response);
            waiting = throughput * response;
        }
        throughput
    }

    #[test]
    fn one_actor_with_one_chunk_never_queues() {
        close(network(1, 1, 3.0, 1.0).throughput(), 0.25);
    }

    #[test]
    fn one_actor_with_two_chunks_is_a_queue_with_three_states() {
        // Weights 1, 1/3 and 1/9: the learner is busy in 4 of 13.
        close(network(1, 2, 3.0, 1.0).throughput(), 4.0 / 13.0);
    }

    #[test]
    fn two_actors_by_hand() {
        // think = service: weights 1, 2 and 2 of none, one or two at the learner.
        close(network(2, 1, 1.0, 1.0).throughput(), 0.8);
    }

    #[test]
    fn with_a_window_of_one_mean_value_analysis_gives_the_same() {
        for actors in [1, 2, 3, 7, 64, 256] {
            for service in [1e-4, 0.03, 1.0, 20.0] {
                let found = network(actors, 1, 1.0, service).throughput();
                close(found, mean_value_analysis(actors, 1.0, service));
            }
        }
    }

    #[test]
    fn throughput_grows_with_actors_and_stays_within_its_bounds() {
        for window in [1, 8, 64] {
            let mut before = 0.0;
            for actors in 1..=64 {
                let found = network(actors, window, 1.6e-3, 5e-5).throughput();
                assert!(found > before * (1.0 - 1e-12), "{actors} of window {window}");
                assert!(found <= (f64::from(actors) / 1.6e-3).min(2e4) * (1.0 + 1e-12));
                before = found;
            }
        }
        close(network(256, 8, 1.0, 1.0).throughput(), 1.0);
        close(network(4, 8, 1.0, 1e-9).throughput(), 4.0);
    }

    const STAGES: Stages = Stages {
        think: 2e-3,
        think_on_one_core: 2e-3,
        intake: 5e-5,
        update: 2e-3,
        window: 8,
    };

    #[test]
    fn gradient_steps_get_the_time_that_the_intake_leaves() {
        let few = STAGES.with_own_cores(1, true);
        close(
            few.updates_per_second,
            (1.0 - few.chunks_per_second * STAGES.intake) / STAGES.update,
        );
        assert!((450.0..510.0).contains(&few.chunks_per_second), "{few:?}");
        let many = STAGES.with_own_cores(256, true);
        assert!(many.chunks_per_second < 2e4 && many.updates_per_second < 0.1 * few.updates_per_second);
        assert_eq!(STAGES.with_own_cores(1, false).updates_per_second, 0.0);
    }

    #[test]
    fn cores_bound_the_total_work() {
        let two = 2.0 / (STAGES.think + STAGES.intake);
        close(STAGES.on_cores(2, 8, false).chunks_per_second, two);
        assert!(STAGES.on_cores(2, 1, false).chunks_per_second <= 1.0 / STAGES.think);
        let plenty = STAGES.on_cores(1_000, 8, true);
        close(
            plenty.chunks_per_second,
            STAGES.with_own_cores(8, true).chunks_per_second,
        );
        // Nine runnable processes share two cores equally.
        let crowded = STAGES.on_cores(2, 8, true);
        assert!(crowded.updates_per_second < 2.0 / 9.0 / STAGES.update, "{crowded:?}");
    }

    #[test]
    fn the_first_bottleneck_is_where_the_bounds_cross() {
        let intake = STAGES.first_bottleneck_with_own_cores(false);
        assert_eq!(intake.resource, INTAKE);
        close(intake.actors, 41.0);
        close(STAGES.first_bottleneck_with_own_cores(true).actors, 35.0);
        let cores = STAGES.first_bottleneck_on_cores(2);
        assert_eq!(cores.resource, CORES);
        close(cores.actors, 2.0 * 2e-3 / 2.05e-3);
        assert_eq!(STAGES.first_bottleneck_on_cores(1_000), intake);
        let slow = Stages { update: 1.0, ..STAGES };
        assert_eq!(slow.first_bottleneck_with_own_cores(true).resource, UPDATES);
    }
}
