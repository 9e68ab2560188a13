//! A closed queueing network that predicts the rates of remote actors from the costs of the stages that a chunk passes.
//!
//! Each actor has a window of chunks in circulation: one is being filled, the others are under way or wait. A chunk
//! passes its actor, its host's relay and link, the learner's link, the gate and the learner; then it takes a while
//! until the actor knows that it is committed. All actors are alike. Times are assumed to be exponentially distributed,
//! so real waits are shorter than predicted.
//!
//! The network is solved by the approximation of Schweitzer (1979): a chunk that arrives at a station finds the mean
//! number of chunks there, less its own share of it. The time grows with the number of stations only.

use serde::Serialize;

/// Iterations end when no rate changes by more than this share.
const TOLERANCE: f64 = 1e-10;
const MOST_ITERATIONS: usize = 100_000;

/// Time of each stage for one chunk, in seconds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Costs {
    /// An actor fills it.
    pub(super) think: f64,
    /// The relay receives and sends it.
    pub(super) relay: f64,
    /// The link of its host carries it.
    pub(super) host_link: f64,
    /// The link of the learner's host carries it; 0 if that is the same link.
    pub(super) learner_link: f64,
    /// The gate receives and forwards it.
    pub(super) gate: f64,
    /// The learner commits it.
    pub(super) intake: f64,
    /// Everything that does not queue: travel in both directions, and until the acknowledgement is sent.
    pub(super) delay: f64,
    /// Chunks that an actor may have uncommitted.
    pub(super) window: u32,
}

/// Who shares a station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Shared {
    Nobody,
    ActorsOfAHost,
    All,
}

/// The station that first keeps a run from becoming faster.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Bottleneck {
    pub(super) station: &'static str,
    /// The number of actors, on all hosts together, that saturates it.
    pub(super) actors: f64,
}

pub(super) const RELAY: &str = "a host's relay";
pub(super) const HOST_LINK: &str = "a host's link";
pub(super) const LEARNER_LINK: &str = "the link of the learner's host";
pub(super) const GATE: &str = "the gate";
pub(super) const INTAKE: &str = "the learner's intake";

impl Costs {
    fn stations(&self) -> [(&'static str, f64, Shared); 6] {
        [
            ("an actor", self.think, Shared::Nobody),
            (RELAY, self.relay, Shared::ActorsOfAHost),
            (HOST_LINK, self.host_link, Shared::ActorsOfAHost),
            (LEARNER_LINK, self.learner_link, Shared::All),
            (GATE, self.gate, Shared::All),
            (INTAKE, self.intake, Shared::All),
        ]
    }

    /// Chunks a second of all actors together, with `actors` actors on each of `hosts` hosts.
    pub(super) fn throughput(&self, hosts: u32, actors: u32) -> f64 {
        let window = f64::from(self.window);
        let stations = self.stations().map(|(_, service, shared)| {
            let sharing = match shared {
                Shared::Nobody => 1.0,
                Shared::ActorsOfAHost => f64::from(actors),
                Shared::All => f64::from(hosts) * f64::from(actors),
            };
            (service, sharing)
        });
        // Chunks of one actor at each station.
        let mut present = stations.map(|_| window / stations.len() as f64);
        let mut rate = 0.0;
        for _ in 0..MOST_ITERATIONS {
            let mut times = [0.0; 6];
            for ((time, (service, sharing)), present) in times.iter_mut().zip(stations).zip(present) {
                *time = service * (1.0 + (sharing - 1.0 / window) * present);
            }
            let before = rate;
            rate = window / (times.iter().sum::<f64>() + self.delay);
            // The mean of the old and the new value, because full steps may oscillate.
            for (present, time) in present.iter_mut().zip(times) {
                *present = (*present + rate * time) / 2.0;
            }
            if (rate - before).abs() <= TOLERANCE * rate {
                break;
            }
        }
        rate * f64::from(hosts) * f64::from(actors)
    }

    /// The station that the fewest actors saturate, if they are spread over `hosts` hosts.
    pub(super) fn first_bottleneck(&self, hosts: u32) -> Bottleneck {
        let alone = self.throughput(1, 1);
        let mut first = Bottleneck {
            station: INTAKE,
            actors: f64::INFINITY,
        };
        for (station, service, shared) in self.stations() {
            let actors = match shared {
                Shared::Nobody => continue,
                Shared::ActorsOfAHost => f64::from(hosts) / (alone * service),
                Shared::All => 1.0 / (alone * service),
            };
            if actors < first.actors {
                first = Bottleneck { station, actors };
            }
        }
        first
    }
}

/// How often each host gets a policy, and how old it is on average.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct PolicyAge {
    pub(super) policies_per_second: f64,
    pub(super) mean_age_s: f64,
}

/// The policies of `bytes` bytes that each of `hosts` hosts gets, from a learner that publishes `published` a second
/// and a gate that sends at most `bandwidth` bytes a second over a link with `link` bytes a second. A host asks for the
/// next policy when it has the last.
pub(super) fn policy_age(bytes: f64, hosts: u32, published: f64, bandwidth: f64, link: f64, delay: f64) -> PolicyAge {
    let transfer = bytes / link + delay;
    let of_a_host = (bandwidth.min(link) / (f64::from(hosts) * bytes))
        .min(1.0 / transfer)
        .min(published);
    PolicyAge {
        policies_per_second: of_a_host,
        // On arrival a policy is as old as its transfer took. It ages by one period until the next one arrives; this is
        // the mean.
        mean_age_s: transfer + 0.5 / of_a_host,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COSTS: Costs = Costs {
        think: 1e-3,
        relay: 5e-6,
        host_link: 2e-5,
        learner_link: 2e-5,
        gate: 8e-6,
        intake: 3e-6,
        delay: 2e-3,
        window: 8,
    };

    #[test]
    fn one_actor_with_one_chunk_waits_for_nobody() {
        let costs = Costs { window: 1, ..COSTS };
        let cycle = 1e-3 + 5e-6 + 2e-5 + 2e-5 + 8e-6 + 3e-6 + 2e-3;
        assert!((costs.throughput(1, 1) * cycle - 1.0).abs() < 1e-6);
    }

    #[test]
    fn few_actors_are_as_fast_as_they_think_and_many_as_fast_as_the_slowest_station() {
        let few = COSTS.throughput(1, 2);
        assert!((0.9 * 2e3..=2e3).contains(&few), "{few}");
        // 1,024 actors offer a million chunks a second, and the learner's link carries 50,000.
        let many = COSTS.throughput(32, 32);
        assert!((0.98 * 5e4..=5e4).contains(&many), "{many}");
        // With slow host links, the links are the limit: four of them carry 4,000 chunks a second.
        let slow = Costs {
            host_link: 1e-3,
            ..COSTS
        };
        assert!(
            (slow.throughput(4, 8) / 4e3 - 1.0).abs() < 0.02,
            "{}",
            slow.throughput(4, 8)
        );
    }

    #[test]
    fn a_long_way_is_limited_by_the_window() {
        let far = Costs { delay: 0.1, ..COSTS };
        let expected = 8.0 / 0.1;
        assert!((far.throughput(1, 1) / expected - 1.0).abs() < 0.05);
    }

    /// With a single queue, exact mean value analysis is known.
    #[test]
    fn the_approximation_is_near_the_exact_solution() {
        for actors in [1, 2, 8, 64] {
            let costs = Costs {
                think: 0.0,
                relay: 0.0,
                host_link: 0.0,
                learner_link: 0.0,
                gate: 1e-4,
                intake: 0.0,
                delay: 2e-3,
                window: 4,
            };
            let (mut waiting, mut exact) = (0.0, 0.0);
            for customers in 1..=4 * actors {
                let time = 1e-4 * (1.0 + waiting);
                exact = f64::from(customers) / (2e-3 + time);
                waiting = exact * time;
            }
            let found = costs.throughput(1, actors);
            assert!((found / exact - 1.0).abs() < 0.05, "{found} for {exact} with {actors}");
        }
    }

    #[test]
    fn the_first_bottleneck_is_the_station_that_the_fewest_actors_saturate() {
        let first = COSTS.first_bottleneck(32);
        assert_eq!(first.station, LEARNER_LINK);
        assert!((45.0..60.0).contains(&first.actors), "{first:?}");
        let slow = Costs { gate: 1e-4, ..COSTS };
        assert_eq!(slow.first_bottleneck(32).station, GATE);
        let slow = Costs {
            host_link: 1e-3,
            ..COSTS
        };
        assert_eq!(slow.first_bottleneck(32).station, HOST_LINK);
    }

    #[test]
    fn policies_share_the_bandwidth() {
        let alone = policy_age(5e5, 1, 150.0, 3e7, 1.25e8, 1e-3);
        assert!((alone.policies_per_second - 60.0).abs() < 1e-9);
        let many = policy_age(5e5, 32, 150.0, 3e7, 1.25e8, 1e-3);
        assert!((many.policies_per_second - 60.0 / 32.0).abs() < 1e-9);
        assert!((many.mean_age_s - (4e-3 + 1e-3 + 0.5 * 32.0 / 60.0)).abs() < 1e-9);
        let slow = policy_age(5e5, 1, 2.0, 3e7, 1.25e8, 1e-3);
        assert_eq!(slow.policies_per_second, 2.0);
    }
}
