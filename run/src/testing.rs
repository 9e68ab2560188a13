//! Helpers for the tests of several crates.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

use std::f64::consts::PI;
use std::io::Write;
use std::path::Path;

use shoal_common::config::Config;
use shoal_common::durable::seal;
use shoal_common::policy_file::PolicyFile;
use shoal_common::run_dir::RunDir;
use shoal_env_server::environment::angle::wrap;
use shoal_env_server::environment::make;

use crate::demonstrations::KIND;
use crate::evaluation::analysis::pendulum::SwingUp;
use crate::evaluation::analysis::point_mass::TestRun;
use crate::evaluation::rollout::policy_layout;

/// A small configuration for tests, and a policy for it that always takes the action in the middle of its range.
pub fn small(environment: &str) -> (Config, Vec<f32>) {
    let text = format!("[run]\nid = \"1a\"\n[environment]\n{environment}\n[ddpg]\nhidden = [4, 3]\n");
    let mut table: toml::Table = text.parse().unwrap();
    let mut parameters = table["environment"].as_table().unwrap().clone();
    let name = parameters.remove("name").unwrap();
    let spec = make(name.as_str().unwrap(), &parameters).unwrap().spec();
    table.insert("spec".into(), toml::Value::try_from(spec).unwrap());
    let config = Config::from_table(table, "test").unwrap();
    let parameters = vec![0.0; policy_layout(&config).unwrap().parameters()];
    (config, parameters)
}

/// A run directory as the launcher makes it, with a best policy if `parameters` are given.
pub fn run_with_policy(parent: &Path, name: &str, config: &Config, parameters: Option<Vec<f32>>) -> RunDir {
    let run = RunDir::create(&parent.join(name)).unwrap();
    run.write_config(config).unwrap();
    std::fs::create_dir(run.checkpoints()).unwrap();
    if let Some(parameters) = parameters {
        let policy = PolicyFile {
            fingerprint: policy_layout(config).unwrap().fingerprint(),
            version: 1,
            env_steps: 1_000,
            return_mean: 0.0,
            return_std: 0.0,
            episodes: 1,
            parameters,
        };
        policy.write(&run.best_policy()).unwrap();
    }
    run
}

/// The file that the package `shoal` writes of a dataset with these rows: s, a, r, whether it was terminated, s', last.
pub fn dataset(header: &str, rows: &[[f32; 10]]) -> Vec<u8> {
    let mut file = Vec::new();
    let written = seal(KIND, &mut file, |body| {
        body.write_all(&(header.len() as u64).to_le_bytes())?;
        body.write_all(header.as_bytes())?;
        rows.iter()
            .flatten()
            .try_for_each(|number| body.write_all(&number.to_le_bytes()))
    });
    written.unwrap();
    file
}

/// A test run that comes to rest `rest` m from the goal. It turns back and forth by `shake` rad each step. The force is
/// `force` on the way and `held` at rest, in N.
pub fn test_run(start: [f64; 2], rest: f64, shake: f64, force: f64, held: f64) -> TestRun {
    let left = |t: u32| rest / start[0].hypot(start[1]) + (1.0 - f64::from(t.min(80)) / 80.0);
    TestRun {
        start,
        x: (0..=200).map(|t| start[0] * left(t)).collect(),
        y: (0..=200).map(|t| start[1] * left(t)).collect(),
        direction: (0..200).map(|t| wrap(PI - 0.1 + shake * f64::from(t % 2))).collect(),
        force: (0..200).map(|t| if t < 80 { force } else { held }).collect(),
        rewards: vec![0.5; 200],
    }
}

/// An episode that swings for 60 steps and then stands still at an angle of `rest` rad, held by ±`torque` N m.
pub fn swing(rest: f64, torque: f64) -> SwingUp {
    let angle = |t: u32| {
        let left = 1.0 - f64::from(t.min(60)) / 60.0;
        PI * left + 2.0 * left * (f64::from(t) / 8.0).sin() + rest
    };
    SwingUp {
        angle: (0..=200).map(angle).collect(),
        velocity: (0..=200).map(|t| (angle(t + 1) - angle(t)) / 0.05).collect(),
        torque: (0..200)
            .map(|t| if t < 60 { 2.0 } else { torque * f64::from(1 - t % 2 * 2) })
            .collect(),
        rewards: vec![-1.0; 200],
    }
}
