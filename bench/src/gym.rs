//! How fast an environment of Gymnasium is stepped through its server in Python, beside Gymnasium's own vectors of the same
//! environments.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::Context;
use serde::{Deserialize, Serialize};
use shoal_common::config::EnvironmentConfig;
use shoal_run::external_environment::{ExternalEnvironment, default_command};

use super::measurement::{Figures, Patience};
use super::step::quantile_of;

const NAME: &str = "gym:Pendulum-v1";

/// Environments of a vector.
const ENVIRONMENTS: u32 = 16;

/// What part of the time goes to round trips, to our vector, and to each of Gymnasium's.
const SHARE: f64 = 0.25;

/// Part of a measurement's time that goes before, to warm up.
const WARM_UP: f64 = 0.1;

/// The fields of `bench gym --json`.
#[derive(Serialize)]
pub(super) struct GymFigures {
    environment: &'static str,
    /// One environment: from this process to the server's and back, the step itself included.
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
    /// In the process that asks.
    sync_vector_steps_per_second: f64,
    /// A process for each environment.
    async_vector_steps_per_second: f64,
}

pub(super) fn measure(patience: &Patience) -> anyhow::Result<GymFigures> {
    let server = default_command(NAME).context("no server for Gymnasium's environments")?;
    let environment = EnvironmentConfig::new(NAME.into(), server, toml::Table::new());
    let length = patience.length.mul_f64(SHARE);
    let mut alone = times(&environment, 1, length, patience)?;
    let together = times(&environment, ENVIRONMENTS, length, patience)?;
    let nanoseconds: f64 = together.iter().map(|ns| f64::from(*ns)).sum();
    alone.sort_unstable();
    Ok(GymFigures {
        environment: NAME,
        round_trip_median_us: quantile_of(&alone, 0.5),
        round_trip_p99_us: quantile_of(&alone, 0.99),
        environments: ENVIRONMENTS,
        steps_per_second: f64::from(ENVIRONMENTS) * together.len() as f64 / (nanoseconds / 1e9),
        gymnasium: gymnasium(&environment, length)?,
    })
}

/// Times of steps of so many environments, in ns; at least one.
fn times(
    environment: &EnvironmentConfig,
    environments: u32,
    length: Duration,
    patience: &Patience,
) -> anyhow::Result<Vec<u32>> {
    let mut conversation = ExternalEnvironment::begin(environment, environments, 1)?;
    conversation.begin_evaluation(0)?;
    let actions = vec![0.5; environments as usize * conversation.spec().action.width()];
    let begun = Instant::now();
    let mut times = Vec::new();
    while times.is_empty() || begun.elapsed() < length {
        patience.check()?;
        let before = Instant::now();
        conversation.step(&actions)?;
        if begun.elapsed() >= length.mul_f64(WARM_UP) {
            times.push(before.elapsed().as_nanos().try_into().unwrap_or(u32::MAX));
        }
    }
    Ok(times)
}

fn gymnasium(environment: &EnvironmentConfig, length: Duration) -> anyhow::Result<Gymnasium> {
    let python = environment.server.first().context("no Python")?;
    let output = Command::new(python)
        .args(["-m", "shoal_gym.peers", "--name", NAME])
        .args(["--environments", &ENVIRONMENTS.to_string()])
        .args(["--seconds", &length.as_secs_f64().to_string()])
        .stdin(Stdio::null())
        .stderr(Stdio::inherit())
        .output()
        .with_context(|| format!("cannot start {python}"))?;
    anyhow::ensure!(output.status.success(), "Gymnasium's own vectors could not be measured");
    serde_json::from_slice(&output.stdout).context("shoal_gym.peers printed no figures")
}

impl Figures for GymFigures {
    fn lines(&self) -> Vec<(&'static str, String)> {
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
