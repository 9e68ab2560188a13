//! Remote actors: the rate of rows from joined hosts into the learner's replay, what gate and relay cost, and how soon
//! rows flow again after an interruption. Learner, gate and relays are the ordinary roles.

mod cable;
mod hosts;
mod model;
mod usage;

use std::time::{Duration, Instant};

use serde::Serialize;
use shoal_common::config::{ActorsConfig, RemoteConfig};

use self::cable::Cable;
use self::hosts::{Network, RemoteRun};
use self::model::{Bottleneck, Costs, PolicyAge, policy_age};
use super::intervals::{self, Samples};
use super::measurement::{StageResults, TimeBudget};
use super::memory::Memory;
use super::temporary_run::{TemporaryRun, UNDISTURBED};

const INTERVAL: Duration = Duration::from_millis(100);

/// Rows of a chunk.
const CHUNK_ROWS: u32 = 64;

/// Actors of the host whose rate is measured, and chunks of the window of each.
const ACTORS: u32 = 8;
const WINDOW: u32 = 64;

/// Bits a second of the limited cable.
const FAST_CABLE: u64 = 1_000_000_000;

/// Rows of Pendulum that 1 Gbit/s carries in a second. A chunk has 64 × 40 bytes and a header, besides the headers of
/// TCP and IP.
const GIGABIT_ROWS: f64 = 2.84e6;

/// Bits a second of the cable over which the model is compared with measurements.
const SLOW_CABLE: u64 = 100_000_000;

/// Numbers of actors at which the model is compared with measurements.
const MODELLED_ACTORS: [u32; 4] = [1, 2, 4, 8];

/// The time in which an actor fills a chunk in these measurements.
const FILL_TIME: Duration = Duration::from_millis(1);

/// The default of `actors.window`.
const DEFAULT_WINDOW: u32 = 8;

/// Bytes of a policy of Pendulum with the thesis's networks.
const POLICY_BYTES: f64 = 488_804.0;

/// Policies that a learner publishes a second: every fourth of 600 gradient steps makes one.
const PUBLISHED_PER_SECOND: f64 = 150.0;

/// Hosts that join one gate, and actors of each. In the first case each actor has a service of its own, in the second
/// all share one.
const MANY_HOSTS: (u32, u32) = (32, 8);
const MOST_HOSTS: (u32, u32) = (32, 32);

/// Hosts, and actors of each, whose rate only the model predicts.
const MODELLED_HOSTS: (u32, u32) = (32, 32);

/// Length of the first outage, and by how much each is longer than the one before.
const SHORTEST_OUTAGE: Duration = Duration::from_millis(1_000);
const OUTAGE_STEP: Duration = Duration::from_millis(700);

/// Outages have this many different lengths.
const OUTAGE_LENGTHS: u32 = 9;

/// How long rows may take to come back.
const RETURN_TIMEOUT: Duration = Duration::from_secs(60);

/// Shares of the time: each link's rate, the outages, each measurement with many hosts, and each rate that the model
/// predicts. A tenth of each is the warm-up.
const SHARES: [f64; 4] = [0.2, 0.2, 0.1, 0.15];
const WARM_UP: f64 = 0.1;

/// The fields of `bench remote --json`.
#[derive(Serialize)]
pub(super) struct RemoteResults {
    chunk_rows: u32,
    window_chunks: u32,
    actors: u32,
    /// One host with `actors` actors, over the loopback device, without encryption.
    loopback: LinkResults,
    /// The same over a virtual cable, with encryption; `None` where the machine makes no virtual cable.
    cable: Option<LinkResults>,
    /// The same over a cable of 1 Gbit/s.
    gigabit: Option<LinkResults>,
    outages: Option<OutageResults>,
    many: ManyResults,
    most: ManyResults,
    /// What a queueing model predicts, beside measurements.
    model: Option<ModelResults>,
    /// Why there is no virtual cable.
    #[serde(skip)]
    no_cable: Option<String>,
}

/// Actors that fill a chunk in a millisecond, on one host behind a cable of 100 Mbit/s; and what the model expects of
/// 1,024 actors on 32 hosts with cables of 1 Gbit/s.
#[derive(Serialize)]
struct ModelResults {
    rows: Vec<ModelRow>,
    relay_us: f64,
    gate_us: f64,
    intake_us: f64,
    delay_us: f64,
    expected_of_many: f64,
    first_bottleneck: Bottleneck,
    policy_age: PolicyAge,
}

#[derive(Serialize)]
struct ModelRow {
    actors: u32,
    rows_per_second: f64,
    expected: f64,
}

#[derive(Serialize)]
struct LinkResults {
    rows_per_second: f64,
    /// Cores that the processes keep busy.
    gate_cores: f64,
    relay_cores: f64,
    learner_cores: f64,
    #[serde(skip)]
    rates: Samples,
}

/// The cable is unplugged and plugged in again.
#[derive(Serialize)]
struct OutageResults {
    count: usize,
    /// From plugging in to the next rows in the replay.
    median_s: f64,
    longest_s: f64,
}

/// Many hosts and one gate, over the loopback device.
#[derive(Serialize)]
struct ManyResults {
    hosts: u32,
    actors: u32,
    rows_per_second: f64,
    /// Rows of the slowest host divided by rows of the fastest.
    fairness: f64,
    gate_open_files: usize,
    gate_private_bytes: u64,
    gate_shared_memory_bytes: u64,
    /// From `kill -9` of the gate until its successor has brought rows of each host.
    rejoined_s: f64,
}

pub(super) fn measure(budget: &TimeBudget) -> anyhow::Result<RemoteResults> {
    let [rates, outages, many, modelled] = SHARES.map(|share| budget.length.mul_f64(share));
    let loopback = measure_link(&Network::Loopback, rates, budget)?;
    let cables = || -> anyhow::Result<_> {
        let cable = |limit| Cable::new(limit).map(Network::Cable);
        Ok([cable(None)?, cable(Some(FAST_CABLE))?, cable(Some(SLOW_CABLE))?])
    };
    let mut results = RemoteResults {
        chunk_rows: CHUNK_ROWS,
        window_chunks: WINDOW,
        actors: ACTORS,
        loopback,
        cable: None,
        gigabit: None,
        outages: None,
        many: measure_many_hosts(MANY_HOSTS, many, budget)?,
        most: measure_many_hosts(MOST_HOSTS, many, budget)?,
        model: None,
        no_cable: None,
    };
    match cables() {
        Ok([unlimited, gigabit, slow]) => {
            let cable = measure_link(&unlimited, rates, budget)?;
            results.gigabit = Some(measure_link(&gigabit, rates, budget)?);
            results.outages = Some(measure_outages(&unlimited, outages, budget)?);
            results.model = Some(predict(&cable, &slow, modelled, budget)?);
            results.cable = Some(cable);
        }
        Err(why) => results.no_cable = Some(format!("{why:#}")),
    }
    Ok(results)
}

/// A run whose learner makes no gradient steps.
fn temporary_run(actors: u32, window: u32) -> anyhow::Result<TemporaryRun> {
    let (most, window) = (format!("actors.max={actors}"), format!("actors.window={window}"));
    TemporaryRun::of(
        // The measured actors belong to other hosts, but a run must have one of its own.
        1,
        1,
        &[
            &format!("actors.chunk_steps={CHUNK_ROWS}"),
            &window,
            &most,
            "replay.updates_per_step=0",
            UNDISTURBED[0],
            UNDISTURBED[1],
        ],
    )
}

/// The rate of one host.
fn measure_link(network: &Network, length: Duration, budget: &TimeBudget) -> anyhow::Result<LinkResults> {
    let temporary = temporary_run(ACTORS, WINDOW)?;
    RemoteRun::with(&temporary, network, (1, ACTORS), budget, |run| {
        run.send_for(length.mul_f64(WARM_UP))?;
        // On a busy machine, a short warm-up may end before the first rows arrive.
        let before = run.rows();
        if !run.send_until(RETURN_TIMEOUT, |run| run.rows() > before)? {
            anyhow::bail!(
                "no rows of the joined host arrived within {} s",
                RETURN_TIMEOUT.as_secs()
            );
        }
        let observed = [run.gate(), run.relay(), run.learner()];
        let busy = || -> anyhow::Result<_> { observed.into_iter().map(usage::busy).collect() };
        let before: Vec<Duration> = busy()?;
        let begun = Instant::now();
        let mut rates = Samples::default();
        for _ in 0..intervals::count(length, 1.0 - WARM_UP, INTERVAL) {
            let (then, rows) = (Instant::now(), run.rows());
            run.send_for(INTERVAL)?;
            rates.add((run.rows() - rows) as f64 / then.elapsed().as_secs_f64());
        }
        let elapsed = begun.elapsed().as_secs_f64();
        let after: Vec<Duration> = busy()?;
        let cores = |i: usize| after[i].saturating_sub(before[i]).as_secs_f64() / elapsed;
        Ok(LinkResults {
            rows_per_second: rates.median(),
            gate_cores: cores(0),
            relay_cores: cores(1),
            learner_cores: cores(2),
            rates,
        })
    })
}

/// Unplugs the cable several times, for [`OUTAGE_LENGTHS`] different times in turn.
fn measure_outages(network: &Network, length: Duration, budget: &TimeBudget) -> anyhow::Result<OutageResults> {
    let Network::Cable(cable) = network else {
        anyhow::bail!("only a cable can be unplugged");
    };
    let temporary = temporary_run(ACTORS, WINDOW)?;
    RemoteRun::with(&temporary, network, (1, ACTORS), budget, |run| {
        let mut returned = Samples::default();
        for i in 0..intervals::count(length, 1.0, Duration::from_secs_f64(0.13)) as u32 {
            run.send_for(INTERVAL)?;
            cable.set_plugged(false)?;
            run.send_for(SHORTEST_OUTAGE + OUTAGE_STEP * (i % OUTAGE_LENGTHS))?;
            // Nothing is under way between relay and replay any more.
            let before = run.rows();
            cable.set_plugged(true)?;
            let plugged = Instant::now();
            if !run.send_until(RETURN_TIMEOUT, |run| run.rows() > before)? {
                anyhow::bail!(
                    "no rows came within {} s of plugging the cable in",
                    RETURN_TIMEOUT.as_secs()
                );
            }
            returned.add(plugged.elapsed().as_secs_f64());
        }
        Ok(OutageResults {
            count: returned.len(),
            median_s: returned.median(),
            longest_s: returned.greatest(),
        })
    })
}

/// Compares the model with measurements over a slow cable. The costs of relay, gate and learner were measured over the
/// unlimited cable.
fn predict(
    unlimited: &LinkResults,
    slow: &Network,
    length: Duration,
    budget: &TimeBudget,
) -> anyhow::Result<ModelResults> {
    let chunks_per_second = unlimited.rows_per_second / f64::from(CHUNK_ROWS);
    let of_gigabit = f64::from(CHUNK_ROWS) / GIGABIT_ROWS;
    let mut costs = Costs {
        think: 0.0,
        relay: unlimited.relay_cores / chunks_per_second,
        host_link: of_gigabit * FAST_CABLE as f64 / SLOW_CABLE as f64,
        learner_link: 0.0,
        gate: unlimited.gate_cores / chunks_per_second,
        intake: unlimited.learner_cores / chunks_per_second,
        delay: 0.0,
        window: 1,
    };
    // With one chunk in circulation nothing queues, so what exceeds the model's time is the delay.
    let alone = chunks_per_second_at_pace(slow, 1, 1, Duration::ZERO, length, budget)?;
    costs.delay = (1.0 / alone - 1.0 / costs.throughput(1, 1)).max(0.0);
    (costs.think, costs.window) = (FILL_TIME.as_secs_f64(), DEFAULT_WINDOW);
    let row = |actors: u32| -> anyhow::Result<ModelRow> {
        let measured = chunks_per_second_at_pace(slow, actors, DEFAULT_WINDOW, FILL_TIME, length, budget)?;
        Ok(ModelRow {
            actors,
            rows_per_second: measured * f64::from(CHUNK_ROWS),
            expected: costs.throughput(1, actors) * f64::from(CHUNK_ROWS),
        })
    };
    let rows = MODELLED_ACTORS.into_iter().map(row).collect::<anyhow::Result<_>>()?;
    let (hosts, actors) = MODELLED_HOSTS;
    let many = Costs {
        host_link: of_gigabit,
        learner_link: of_gigabit,
        ..costs
    };
    Ok(ModelResults {
        rows,
        relay_us: costs.relay * 1e6,
        gate_us: costs.gate * 1e6,
        intake_us: costs.intake * 1e6,
        delay_us: costs.delay * 1e6,
        expected_of_many: many.throughput(hosts, actors) * f64::from(CHUNK_ROWS),
        first_bottleneck: many.first_bottleneck(hosts),
        policy_age: policy_age(
            POLICY_BYTES,
            hosts,
            PUBLISHED_PER_SECOND,
            RemoteConfig::default().policy_bandwidth,
            FAST_CABLE as f64 / 8.0,
            costs.delay,
        ),
    })
}

/// Chunks a second of a host's actors if each actor needs `think` to fill a chunk.
fn chunks_per_second_at_pace(
    network: &Network,
    actors: u32,
    window: u32,
    think: Duration,
    length: Duration,
    budget: &TimeBudget,
) -> anyhow::Result<f64> {
    let temporary = temporary_run(actors, window)?;
    RemoteRun::with(&temporary, network, (1, actors), budget, |run| {
        run.set_pace(think);
        run.send_for(length.mul_f64(WARM_UP))?;
        let (begun, rows) = (Instant::now(), run.rows());
        run.send_for(length.mul_f64(1.0 - WARM_UP))?;
        Ok((run.rows() - rows) as f64 / f64::from(CHUNK_ROWS) / begun.elapsed().as_secs_f64())
    })
}

/// Many hosts at one gate, which is killed once.
fn measure_many_hosts(
    (hosts, actors): (u32, u32),
    length: Duration,
    budget: &TimeBudget,
) -> anyhow::Result<ManyResults> {
    let with_own_service = hosts * actors <= ActorsConfig::MAX_ON_A_HOST;
    let first = if with_own_service {
        0
    } else {
        ActorsConfig::MAX_ON_A_HOST
    };
    let temporary = temporary_run(first + hosts * actors, DEFAULT_WINDOW)?;
    RemoteRun::with(&temporary, &Network::Loopback, (hosts, actors), budget, |run| {
        run.send_for(length.mul_f64(WARM_UP))?;
        let (begun, before) = (Instant::now(), run.rows_of_hosts());
        run.send_for(length.mul_f64(1.0 - WARM_UP))?;
        let (elapsed, after) = (begun.elapsed().as_secs_f64(), run.rows_of_hosts());
        let of_hosts: Vec<u64> = after
            .iter()
            .zip(&before)
            .map(|(after, before)| after - before)
            .collect();
        let [least, most] = [of_hosts.iter().min(), of_hosts.iter().max()].map(|rows| rows.copied().unwrap_or(0));
        let gate = run.gate();
        let memory = Memory::of(gate, &temporary.run.replay_file())?;
        let gate_open_files = usage::open_files(gate)?;
        let killed = Instant::now();
        run.replace_gate()?;
        let before = run.rows_of_hosts();
        let all = |run: &RemoteRun<'_>| {
            run.rows_of_hosts()
                .iter()
                .zip(&before)
                .all(|(after, before)| after > before)
        };
        if !run.send_until(RETURN_TIMEOUT, all)? {
            anyhow::bail!(
                "not all hosts came back within {} s of the gate's death",
                RETURN_TIMEOUT.as_secs()
            );
        }
        Ok(ManyResults {
            hosts,
            actors: hosts * actors,
            rows_per_second: of_hosts.iter().sum::<u64>() as f64 / elapsed,
            fairness: least as f64 / most.max(1) as f64,
            gate_open_files,
            gate_private_bytes: memory.private_bytes,
            gate_shared_memory_bytes: memory.shared_memory_bytes,
            rejoined_s: killed.elapsed().as_secs_f64(),
        })
    })
}

impl ModelResults {
    fn show_rows(&self) -> String {
        let one = |row: &ModelRow| {
            let ModelRow {
                actors,
                rows_per_second,
                expected,
            } = row;
            format!("{actors}: {:.0} ({:.0})", rows_per_second / 1e3, expected / 1e3)
        };
        let rows: Vec<String> = self.rows.iter().map(one).collect();
        format!("{} thousand rows a second", rows.join(", "))
    }

    fn show_many(&self) -> String {
        let Bottleneck { station, actors } = self.first_bottleneck;
        let PolicyAge {
            policies_per_second,
            mean_age_s,
        } = self.policy_age;
        format!(
            "{:.1} million rows a second; first limit {station}, by {actors:.0} actors; each host gets \
             {policies_per_second:.1} policies a second, {mean_age_s:.2} s old",
            self.expected_of_many / 1e6
        )
    }
}

impl ManyResults {
    fn show(&self) -> String {
        format!(
            "{} with {} actors: {:.2} million rows a second, the slowest has {:.2} of the fastest",
            self.hosts,
            self.actors,
            self.rows_per_second / 1e6,
            self.fairness
        )
    }

    fn show_gate(&self) -> String {
        format!(
            "{} open files, {:.1} MB private, {:.1} MB of shared memory; killed, rows of all hosts again after {:.2} s",
            self.gate_open_files,
            self.gate_private_bytes as f64 / 1e6,
            self.gate_shared_memory_bytes as f64 / 1e6,
            self.rejoined_s
        )
    }
}

impl LinkResults {
    fn show(&self) -> String {
        format!(
            "{} million rows a second; gate {:.2} cores, relay {:.2}",
            self.rates.show(1e6, 2),
            self.gate_cores,
            self.relay_cores
        )
    }
}

impl StageResults for RemoteResults {
    fn entries(&self) -> Vec<(&'static str, String)> {
        let none = || self.no_cable.clone().unwrap_or_default();
        let link = |link: &Option<LinkResults>| link.as_ref().map_or_else(none, LinkResults::show);
        vec![
            ("one host, loopback, unencrypted", self.loopback.show()),
            ("one host, virtual cable, encrypted", link(&self.cable)),
            (
                "one host, cable of 1 Gbit/s",
                self.gigabit.as_ref().map_or_else(none, |gigabit| {
                    let share = gigabit.rows_per_second / GIGABIT_ROWS;
                    format!("{} ({share:.2} of the cable)", gigabit.show())
                }),
            ),
            (
                "cable plugged in, to the next rows",
                self.outages.as_ref().map_or_else(none, |outages| {
                    let OutageResults {
                        count,
                        median_s,
                        longest_s,
                    } = outages;
                    format!("{median_s:.2} s, at worst {longest_s:.2} (of {count})")
                }),
            ),
            ("many hosts", self.many.show()),
            ("their gate", self.many.show_gate()),
            ("1,024 actors", self.most.show()),
            ("their gate", self.most.show_gate()),
            (
                "actors over 100 Mbit/s (expected)",
                self.model.as_ref().map_or_else(none, ModelResults::show_rows),
            ),
            (
                "expected of 1,024 over 1 Gbit/s",
                self.model.as_ref().map_or_else(none, ModelResults::show_many),
            ),
            (
                "chunks",
                format!(
                    "{} rows, {} chunks in the window of each of {} actors (of the many: 8)",
                    self.chunk_rows, self.window_chunks, self.actors
                ),
            ),
        ]
    }
}
