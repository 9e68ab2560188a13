//! What rates are to be expected of a run, from what each of its stages costs: a closed queueing network.
//!
//! Of every actor a window of chunks is under way. A chunk is collected by its actor, one at a time, and then waits its turn
//! at the learner, which takes in the chunks of all. Both take an exponentially distributed time with the mean that was
//! measured: real ones vary less, so waits are smaller than predicted. Such a network has a product form. With `k` chunks of
//! each actor at the learner and K of them in all, its state has the weight K!/(k₁! … kₙ!) · (service/think)^K: so the
//! solution is exact. With a window of one chunk it is the machine-repairman model that mean value analysis solves.

use serde::Serialize;

/// Actors that fill chunks, and one learner that takes them in.
#[derive(Clone, Copy, Debug)]
pub(super) struct Network {
    pub(super) actors: u32,
    /// Chunks of each actor that are under way.
    pub(super) window: u32,
    /// Mean time of an actor over a chunk, in seconds.
    pub(super) think: f64,
    /// Mean time of the learner over a chunk, in seconds.
    pub(super) service: f64,
}

impl Network {
    /// Chunks a second.
    pub(super) fn throughput(&self) -> f64 {
        let ratio = (self.service / self.think).ln();
        let choices: Vec<f64> = (0..=self.window)
            .scan(0.0, |factorial, k| {
                *factorial += f64::from(k.max(1)).ln();
                Some(f64::from(k) * ratio - *factorial)
            })
            .collect();
        // Logarithm of the sum over all states with K chunks at the learner, but for the factor K!; actor after actor.
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

/// Logarithm of the sum of what these are logarithms of.
fn log_sum(logarithms: impl Iterator<Item = f64> + Clone) -> f64 {
    let greatest = logarithms.clone().fold(f64::NEG_INFINITY, f64::max);
    greatest + logarithms.map(|it| (it - greatest).exp()).sum::<f64>().ln()
}

/// What the stages cost, in seconds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stages {
    /// An actor with its environment server over a chunk, where each has a core.
    pub(super) think: f64,
    /// The same where they share one.
    pub(super) think_on_one_core: f64,
    /// The learner over taking in a chunk.
    pub(super) intake: f64,
    /// The learner over an update.
    pub(super) update: f64,
    pub(super) window: u32,
}

/// What is expected of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Expected {
    pub(super) chunks_per_second: f64,
    pub(super) updates_per_second: f64,
}

/// What keeps a run from becoming faster with more actors.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Bottleneck {
    pub(super) resource: &'static str,
    /// So many actors saturate it.
    pub(super) actors: f64,
}

pub(super) const CORES: &str = "cores";
pub(super) const INTAKE: &str = "the learner's intake";
pub(super) const UPDATES: &str = "the learner's updates, over which the actors' windows fill";

impl Stages {
    /// A run in which every process has a core of its own; the learner takes everything in and makes updates in the rest of
    /// its time, or none.
    pub(super) fn alone(&self, actors: u32, updates: bool) -> Expected {
        self.with_shares(actors, updates, self.think, 1.0)
    }

    /// A run on so many cores. A waiting pair's halves take turns, so a pair counts as one process that can run, and the
    /// learner as another; those that can run share the cores alike.
    pub(super) fn on(&self, cores: u32, actors: u32, updates: bool) -> Expected {
        let (cores, n) = (f64::from(cores), f64::from(actors));
        let think = if 2.0 * n + 1.0 <= cores {
            self.think
        } else {
            // The system puts a pair on one core where cores are scarce. That is not always the slower way: an idle core has
            // to be woken for each request.
            self.think_on_one_core
        };
        if updates {
            // A learner that makes updates can always run.
            let learner = (cores / (n + 1.0)).min(1.0);
            let pair = ((cores - learner) / n).min(1.0);
            return self.with_shares(actors, true, think / pair, learner);
        }
        // One that only takes in runs when there is something: all the work has to fit into the cores.
        let most = cores / (think + self.intake);
        let Expected { chunks_per_second, .. } = self.with_shares(actors, false, think, 1.0);
        Expected {
            chunks_per_second: chunks_per_second.min(most),
            updates_per_second: 0.0,
        }
    }

    /// Where a pair takes `think` over a chunk and the learner has such a share of a core.
    fn with_shares(&self, actors: u32, updates: bool, think: f64, share: f64) -> Expected {
        // Between two updates the learner takes at most a window of each actor: under load each chunk carries its part of an
        // update. Without load it does not matter, for the actor goes on while the chunk waits.
        let carried = if updates {
            self.update / f64::from(self.window * actors)
        } else {
            0.0
        };
        let chunks_per_second = Network {
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

    /// What more actors meet first where every process has a core of its own.
    pub(super) fn first_bottleneck_alone(&self, updates: bool) -> Bottleneck {
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

    /// What more actors meet first on so many cores, the learner making no updates.
    pub(super) fn first_bottleneck_on(&self, cores: u32) -> Bottleneck {
        let think = self.think_on_one_core;
        let actors = f64::from(cores) * think / (think + self.intake);
        let intake = self.first_bottleneck_alone(false);
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

    fn network(actors: u32, window: u32, think: f64, service: f64) -> Network {
        Network {
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
    fn a_window_of_one_is_what_mean_value_analysis_says() {
        for actors in [1, 2, 3, 7, 64, 256] {
            for service in [1e-4, 0.03, 1.0, 20.0] {
                let found = network(actors, 1, 1.0, service).throughput();
                close(found, mean_value_analysis(actors, 1.0, service));
            }
        }
    }

    #[test]
    fn it_stays_within_its_bounds_and_grows() {
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
    fn updates_get_the_time_that_the_intake_leaves() {
        let few = STAGES.alone(1, true);
        close(
            few.updates_per_second,
            (1.0 - few.chunks_per_second * STAGES.intake) / STAGES.update,
        );
        assert!((450.0..510.0).contains(&few.chunks_per_second), "{few:?}");
        let many = STAGES.alone(256, true);
        assert!(many.chunks_per_second < 2e4 && many.updates_per_second < 0.1 * few.updates_per_second);
        assert_eq!(STAGES.alone(1, false).updates_per_second, 0.0);
    }

    #[test]
    fn cores_bound_what_all_do_together() {
        let two = 2.0 / (STAGES.think + STAGES.intake);
        close(STAGES.on(2, 8, false).chunks_per_second, two);
        assert!(STAGES.on(2, 1, false).chunks_per_second <= 1.0 / STAGES.think);
        let plenty = STAGES.on(1_000, 8, true);
        close(plenty.chunks_per_second, STAGES.alone(8, true).chunks_per_second);
        // Nine that can run share two cores alike.
        let crowded = STAGES.on(2, 8, true);
        assert!(crowded.updates_per_second < 2.0 / 9.0 / STAGES.update, "{crowded:?}");
    }

    #[test]
    fn the_first_bottleneck_is_where_its_bounds_cross() {
        let intake = STAGES.first_bottleneck_alone(false);
        assert_eq!(intake.resource, INTAKE);
        close(intake.actors, 41.0);
        close(STAGES.first_bottleneck_alone(true).actors, 35.0);
        let cores = STAGES.first_bottleneck_on(2);
        assert_eq!(cores.resource, CORES);
        close(cores.actors, 2.0 * 2e-3 / 2.05e-3);
        assert_eq!(STAGES.first_bottleneck_on(1_000), intake);
        let slow = Stages { update: 1.0, ..STAGES };
        assert_eq!(slow.first_bottleneck_alone(true).resource, UPDATES);
    }
}
