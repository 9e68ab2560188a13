//! The figures of one run. `shoal plot` draws them, and every training draws them at its end.

mod thesis;

use std::path::{Path, PathBuf};

use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use shoal_run::description::Description;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::rollout::Rollout;
use shoal_run::records::recorder::read_evaluations;

use crate::figure;

/// Draws the learning curve of a run so far and, if it has a best policy, that policy's behaviour. Returns the files.
pub fn draw(run: &RunDir, config: &Config, out: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut pictures = vec![out.join("learning-curve.svg")];
    let evaluations = read_evaluations(&run.evaluations())?;
    figure::learning_curve((&run.name(), config.algorithm.name()), &evaluations, &pictures[0])?;
    if run.best_policy().exists() {
        pictures.extend(behaviour(run, config, out)?);
    }
    Ok(pictures)
}

/// Draws the behaviour of the best policy and returns the files: the thesis's figures, or the signals of the first
/// evaluation episode of the run's seed. Draws nothing if another program serves the environment, because that program
/// would have to be started only for this.
fn behaviour(run: &RunDir, config: &Config, out: &Path) -> anyhow::Result<Vec<PathBuf>> {
    if !config.environment.server.is_empty() {
        return Ok(Vec::new());
    }
    let policy = SavedPolicy::Best.read(run, config)?;
    let mut rollout = Rollout::new(config, &policy.parameters)?;
    if let Some(files) = thesis::behaviour(config, &mut rollout, out)? {
        return Ok(files);
    }
    let path = out.join("episode.svg");
    let Description { signals, time_step, .. } = Description::of(config)?;
    let trajectory = rollout.evaluation_episode(config.run.seed, 0)?;
    figure::episode(&signals, time_step, &trajectory, &path)?;
    Ok(vec![path])
}

#[cfg(test)]
mod tests {
    use shoal_common::policy_file::PolicyFile;

    use super::*;
    use shoal_run::evaluation::rollout::policy_layout;
    use shoal_run::plan::resolve_preset;
    use shoal_run::testing::small;

    /// The figures of a run with a policy, by name.
    fn files_of((config, parameters): (Config, Vec<f32>)) -> Vec<String> {
        let parent = tempfile::tempdir().unwrap();
        let run_dir = RunDir::create(&parent.path().join("run")).unwrap();
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

    /// A preset's configuration, and a policy for it.
    fn of_preset(name: &str) -> (Config, Vec<f32>) {
        let config = resolve_preset(name).unwrap();
        let parameters = vec![0.0; policy_layout(&config).unwrap().parameters()];
        (config, parameters)
    }

    #[test]
    fn every_environment_has_figures_of_its_behaviour() {
        let pendulum = files_of(small("name = \"pendulum\""));
        assert_eq!(pendulum, ["learning-curve.svg", "swing-up.svg"]);
        let point_mass = files_of(small("name = \"point-mass\"\nreward = \"r2\""));
        assert_eq!(
            point_mass,
            [
                "learning-curve.svg",
                "test-runs-far.svg",
                "test-runs.svg",
                "trajectories.svg"
            ]
        );
        for name in ["cart-pole", "frozen-lake"] {
            let files = files_of(of_preset(name));
            assert_eq!(files, ["episode.svg", "learning-curve.svg"], "{name}");
        }
    }

    #[test]
    fn an_environment_served_by_another_program_has_only_a_learning_curve() {
        let (mut config, parameters) = small("name = \"pendulum\"");
        config.environment.server = vec!["no-such-program".into()];
        assert_eq!(files_of((config, parameters)), ["learning-curve.svg"]);
    }
}
