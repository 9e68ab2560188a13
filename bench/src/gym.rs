//! Steps per second of a Gymnasium environment through its Python server, compared with Gymnasium's own vector
//! environments.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::Context;
use serde::{Deserialize, Serialize};
use shoal_common::config::EnvironmentConfig;
use shoal_run::external_environment::{ExternalEnvironment, default_command};

use super::measurement::{StageResults, TimeBudget};
use super::step::quantile_of;

const NAME: &str = "gym:Pendulum-v1";

/// Environments in a vector.
const ENVIRONMENTS: u32 = 16;

/// Share of the time for each measurement: round trips, our vector, and each of Gymnasium's two.
const SHARE: f64 = 0.25;

/// Share of a measurement's time that is spent on warming up.
const WARM_UP: f64 = 0.1;

/// The fields of `bench gym --json`.
#[derive(Serialize)]
pub(super) struct GymResults {
    environment: &'static str,
    /// Round trip to a server with one environment, its step included.
    round_trip_median_us: f64,
    round_trip_p99_us: f64,
    environments: u32,
    steps_per_second: f64,
    #[serde(flatten)]
    gymnasium: Gymnasium,
}

/// What `shoal_gym.peers` prints.
#[derive(Serialize, Deserialize)]
struct Gymnasium {
    /// All environments in the calling process.
    sync_vector_steps_per_second: f64,
    /// One process per environment.
    async_vector_steps_per_second: f64,
}

pub(super) fn measure(budget: &TimeBudget) -> anyhow::Result<GymResults> {
    let server = default_command(NAME).context("found no server for Gymnasium's environments")?;
    let environment = EnvironmentConfig::new(NAME.into(), server, toml::Table::new());
    let length = budget.length.mul_f64(SHARE);
    let mut alone = times(&environment, 1, length, budget)?;
    let together = times(&environment, ENVIRONMENTS, length, budget)?;
    let nanoseconds: f64 = together.iter().map(|ns| f64::from(*ns)).sum();
    alone.sort_unstable();
    Ok(GymResults {
        environment: NAME,
        round_trip_median_us: quantile_of(&alone, 0.5),
        round_trip_p99_us: quantile_of(&alone, 0.99),
        environments: ENVIRONMENTS,
        steps_per_second: f64::from(ENVIRONMENTS) * together.len() as f64 / (nanoseconds / 1e9),
        gymnasium: gymnasium(&environment, length)?,
    })
}

/// Times of steps of a vector of `environments`, in ns; at least one.
fn times(
    environment: &EnvironmentConfig,
    environments: u32,
    length: Duration,
    budget: &TimeBudget,
) -> anyhow::Result<Vec<u32>> {
    let mut client = ExternalEnvironment::begin(environment, environments, 1)?;
    client.begin_evaluation(0)?;
    let actions = vec![0.5; environments as usize * client.spec().action.width()];
    let begun = Instant::now();
    let mut times = Vec::new();
    while times.is_empty() || begun.elapsed() < length {
        budget.check()?;
        let before = Instant::now();
        client.step(&actions)?;
        if begun.elapsed() >= length.mul_f64(WARM_UP) {
            times.push(before.elapsed().as_nanos().try_into().unwrap_or(u32::MAX));
        }
    }
    Ok(times)
}

fn gymnasium(environment: &EnvironmentConfig, length: Duration) -> anyhow::Result<Gymnasium> {
    let python = environment
        .server
        .first()
        .context("the environment has no server: `gym:` environments need a Python with ./python installed")?;
    let output = Command::new(python)
        .args(["-m", "shoal_gym.peers", "--name", NAME])
        .args(["--environments", &ENVIRONMENTS.to_string()])
        .args(["--seconds", &length.as_secs_f64().to_string()])
        .stdin(Stdio::null())
        .stderr(Stdio::inherit())
        .output()
        .with_context(|| format!("cannot start {python}"))?;
    anyhow::ensure!(
        output.status.success(),
        "could not measure Gymnasium's own vector environments"
    );
    serde_json::from_slice(&output.stdout).context("shoal_gym.peers printed no results")
}

impl StageResults for GymResults {
    fn entries(&self) -> Vec<(&'static str, String)> {
        let rate = |steps: f64| format!("{steps:.0} steps/s");
        vec![
            ("environment", self.environment.into()),
            (
                "round trip, 1 environment",
                format!(
                    "{:.1} µs in the median, 99 % within {:.1} µs",
                    self.round_trip_median_us, self.round_trip_p99_us
                ),
            ),
            ("environments together", self.environments.to_string()),
            ("through shared memory", rate(self.steps_per_second)),
            ("SyncVectorEnv", rate(self.gymnasium.sync_vector_steps_per_second)),
            ("AsyncVectorEnv", rate(self.gymnasium.async_vector_steps_per_second)),
        ]
    }
}
