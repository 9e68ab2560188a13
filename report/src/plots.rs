//! The figures of one run: what `shoal plot` draws, and every training at its end.

use std::path::{Path, PathBuf};

use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use shoal_run::analysis::pendulum::SwingUp;
use shoal_run::analysis::point_mass::{Drive, FAR_STARTS, NEAR_STARTS};
use shoal_run::evaluation::WhichPolicy;
use shoal_run::recorder::read_evaluations;
use shoal_run::rollout::Rollout;

use crate::figure;

/// Draws the evaluations of a run so far, and what its best policy does if there is one yet; gives the files.
pub fn draw(run: &RunDir, config: &Config, out: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut pictures = vec![out.join("learning-curve.svg")];
    figure::learning_curve(&read_evaluations(&run.evaluations())?, &pictures[0])?;
    if run.best_policy().exists() {
        pictures.extend(behaviour(run, config, out)?);
    }
    Ok(pictures)
}

/// Draws what the best policy does, and gives the files.
fn behaviour(run: &RunDir, config: &Config, out: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let name = config.environment.name.as_str();
    if !["pendulum", "point-mass"].contains(&name) {
        return Ok(Vec::new());
    }
    let policy = WhichPolicy::Best.read(run, config)?;
    let mut rollout = Rollout::new(config, &policy.parameters)?;
    if name == "pendulum" {
        let path = out.join("swing-up.svg");
        figure::swing_up(&SwingUp::run(&mut rollout)?, &path)?;
        return Ok(vec![path]);
    }
    let files = ["test-runs.svg", "test-runs-far.svg", "trajectories.svg"].map(|file| out.join(file));
    figure::test_runs(&Drive::run_from(&mut rollout, starts_shown(config))?, &files[0])?;
    let mut runs = Drive::run_from(&mut rollout, &FAR_STARTS)?;
    figure::test_runs(&runs, &files[1])?;
    runs.extend(Drive::run_from(&mut rollout, &NEAR_STARTS)?);
    figure::trajectories(&runs, &files[2])?;
    Ok(files.into())
}

/// The two starts of the thesis's figure for the run's reward: 5.5 (r1), 5.7 (r2), 5.9 (r3).
fn starts_shown(config: &Config) -> &'static [[f64; 2]] {
    let reward = config
        .environment
        .parameters
        .get("reward")
        .and_then(toml::Value::as_str);
    if reward == Some("r2") {
        &NEAR_STARTS[2..]
    } else {
        &NEAR_STARTS[..2]
    }
}

#[cfg(test)]
mod tests {
    use shoal_common::policy_file::PolicyFile;

    use super::*;
    use shoal_run::rollout::policy_layout;
    use shoal_run::testing::small;

    fn files_of(environment: &str) -> Vec<String> {
        let parent = tempfile::tempdir().unwrap();
        let run_dir = RunDir::create(&parent.path().join("run")).unwrap();
        let (config, parameters) = small(environment);
        std::fs::write(run_dir.config_file(), config.to_toml().unwrap()).unwrap();
        std::fs::create_dir(run_dir.checkpoints()).unwrap();
        let fingerprint = policy_layout(&config).unwrap().fingerprint();
        let policy = PolicyFile {
            fingerprint,
            version: 1,
            env_steps: 1,
            return_mean: 0.0,
            return_std: 0.0,
            episodes: 1,
            parameters,
        };
        policy.write(&run_dir.best_policy()).unwrap();
        let out = parent.path().join("pictures");
        std::fs::create_dir(&out).unwrap();
        draw(&run_dir, &config, &out).unwrap();
        let entries = std::fs::read_dir(out).unwrap();
        let mut files: Vec<_> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        files.sort();
        files
    }

    #[test]
    fn every_environment_has_its_pictures() {
        assert_eq!(files_of("name = \"pendulum\""), ["learning-curve.svg", "swing-up.svg"]);
        let point_mass = files_of("name = \"point-mass\"\nreward = \"r2\"");
        assert_eq!(
            point_mass,
            [
                "learning-curve.svg",
                "test-runs-far.svg",
                "test-runs.svg",
                "trajectories.svg"
            ]
        );
    }

    #[test]
    fn the_starts_are_those_of_the_rewards_figure() {
        let starts = |reward: &str| starts_shown(&small(&format!("name = \"point-mass\"\nreward = \"{reward}\"")).0);
        assert_eq!(starts("r1"), [[2.0, -2.0], [-2.0, 2.0]]);
        assert_eq!(starts("r2"), [[2.0, 2.0], [-2.0, -2.0]]);
        assert_eq!(starts("r3"), starts("r1"));
    }
}
