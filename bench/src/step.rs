//! The time of an environment step, from an actor's process to an environment server's and back.

use std::time::{Duration, Instant};

use anyhow::bail;
use rustix::thread::sched_setaffinity;
use serde::Serialize;
use shoal_common::channel::environment::{EnvironmentClient, ResetRequest, StepResult};
use shoal_common::channel::{ChannelError, Domain, EventName, Listener};
use shoal_common::config::Config;
use shoal_common::exit::Exit;
use shoal_common::role::Role;
use shoal_run::child_process::ChildProcess;

use super::cores::Cores;
use super::measurement::{StageResults, TimeBudget};
use super::spin;
use super::target::{Target, TargetRow};
use super::temporary_run::TemporaryRun;

/// Time between two checks for an interruption.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);

/// Share of the time that is spent on warming up.
const WARM_UP: f64 = 0.1;

/// Shares of the time: round trips between two cores, and within one.
const SHARES: [f64; 2] = [0.6, 0.3];

/// Share of the time for the limit, half before the round trips and half after them: a virtual machine may be moved to
/// other cores in between.
const SPIN: f64 = 0.1;

/// The fields of `bench step --json`.
#[derive(Serialize)]
pub(super) struct StepResults {
    median_us: f64,
    p99_us: f64,
    least_us: f64,
    p90_us: f64,
    /// Median of the limit: two threads that spin on a word in memory.
    spin_median_us: f64,
    round_trips: usize,
    environments: u32,
    /// Both processes bound to the same core.
    one_core_median_us: f64,
    one_core_p99_us: f64,
}

pub(super) fn measure(budget: &TimeBudget) -> anyhow::Result<StepResults> {
    let temporary = TemporaryRun::new(&[])?;
    let mut spins = spin::times(budget.length.mul_f64(SPIN / 2.0));
    let [apart, together] = SHARES.map(|share| budget.length.mul_f64(share));
    let mut times = temporary.with_role(Role::EnvServer, |domain, server| {
        round_trips(&temporary.config, domain, server, apart, budget)
    })?;
    let mut on_one_core = on_one_core(together, budget)?;
    spins.extend(spin::times(budget.length.mul_f64(SPIN / 2.0)));
    spins.sort_unstable();
    times.sort_unstable();
    on_one_core.sort_unstable();
    let microseconds = |quantile| quantile_of(&times, quantile);
    Ok(StepResults {
        median_us: microseconds(0.5),
        p99_us: microseconds(0.99),
        least_us: microseconds(0.0),
        p90_us: microseconds(0.9),
        spin_median_us: quantile_of(&spins, 0.5),
        round_trips: times.len(),
        environments: temporary.config.actors.envs,
        one_core_median_us: quantile_of(&on_one_core, 0.5),
        one_core_p99_us: quantile_of(&on_one_core, 0.99),
    })
}

/// Times of round trips while this process and the server share a core.
fn on_one_core(length: Duration, budget: &TimeBudget) -> anyhow::Result<Vec<u32>> {
    let temporary = TemporaryRun::new(&[])?;
    let cores = Cores::choose()?;
    temporary.with_role(Role::EnvServer, |domain, server| {
        server.pin(&cores.pair)?;
        sched_setaffinity(None, &cores.pair)?;
        round_trips(&temporary.config, domain, server, length, budget)
    })
}

/// A quantile in µs of sorted times in ns. Panics if there are none.
pub(super) fn quantile_of(sorted: &[u32], quantile: f64) -> f64 {
    f64::from(sorted[((sorted.len() - 1) as f64 * quantile) as usize]) / 1e3
}

/// Times of round trips, in ns; at least one.
fn round_trips(
    config: &Config,
    domain: &Domain,
    server: &mut ChildProcess,
    length: Duration,
    budget: &TimeBudget,
) -> anyhow::Result<Vec<u32>> {
    let environments = config.actors.envs as usize;
    let listener = Listener::bind(domain, EventName(Role::Actor, 0))?;
    let client = EnvironmentClient::open(domain, 0, &config.spec, environments, budget.stop.clone())?;
    let mut ask = |request: &dyn Fn() -> Result<(), Exit<ChannelError>>| match request() {
        Ok(()) => Ok(()),
        Err(Exit::Stopped) => budget.check(),
        Err(Exit::Failed(error)) => server.check().and(Err(error.into())),
    };
    ask(&|| client.spec(&listener, || ()).map(|_| ()))?;
    ask(&|| client.reset(&listener, ResetRequest::Next, || ()).map(|_| ()))?;

    let actions = vec![0.5; environments * config.spec.action.width()];
    let mut times = Vec::new();
    let warm_up = length.mul_f64(WARM_UP);
    let (begun, mut looked) = (Instant::now(), Instant::now());
    loop {
        let before = Instant::now();
        match client.step(&listener, &actions, || ()) {
            Ok(StepResult::Taken(_)) => {}
            Ok(StepResult::Lost) => {
                server.check()?;
                bail!("the environment server lost its episodes");
            }
            Err(Exit::Stopped) => bail!(super::measurement::INTERRUPTED),
            Err(Exit::Failed(error)) => return Err(error.into()),
        }
        let after = Instant::now();
        if before.duration_since(begun) >= warm_up {
            times.push((after - before).as_nanos().try_into().unwrap_or(u32::MAX));
        }
        if after - looked >= CHECK_INTERVAL {
            looked = after;
            budget.check()?;
        }
        if !times.is_empty() && after - begun >= length {
            return Ok(times);
        }
    }
}

impl StageResults for StepResults {
    fn target_rows(&self) -> Vec<TargetRow> {
        let [apart, together] = [self.median_us, self.one_core_median_us];
        vec![
            TargetRow {
                stage: "environment step, two cores",
                ours: format!("{apart:.2} µs"),
                limit: format!("{:.2} µs, two threads that spin", self.spin_median_us),
                share: Some(self.spin_median_us / apart),
                target: Target::at_most(2.5, apart, "2.5 µs"),
            },
            TargetRow {
                stage: "environment step, one core",
                ours: format!("{together:.2} µs"),
                limit: String::new(),
                share: None,
                target: Target::at_most(15.0, together, "15 µs"),
            },
        ]
    }

    fn entries(&self) -> Vec<(&'static str, String)> {
        vec![
            ("median", format!("{:.2} µs", self.median_us)),
            ("90 of 100 within", format!("{:.2} µs", self.p90_us)),
            ("99 of 100 within", format!("{:.2} µs", self.p99_us)),
            ("fastest", format!("{:.2} µs", self.least_us)),
            (
                "sharing a core",
                format!(
                    "{:.2} µs in the median, 99 of 100 within {:.2} µs",
                    self.one_core_median_us, self.one_core_p99_us
                ),
            ),
            (
                "limit",
                format!(
                    "{:.2} µs: the median of two threads that spin on a word",
                    self.spin_median_us
                ),
            ),
            (
                "round trips",
                format!("{}, {} environment each", self.round_trips, self.environments),
            ),
        ]
    }
}
