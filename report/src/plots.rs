//! The figures of one run. `shoal plot` draws them, and every training draws them at its end.

mod thesis;

use std::path::{Path, PathBuf};

use shoal_common::config::Config;
use shoal_common::message::one_line;
use shoal_common::run_dir::RunDir;
use shoal_env_server::description::Description;
use shoal_run::description;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::rollout::{Rollout, Trajectory};
use shoal_run::records::recorder::read_evaluations;
use shoal_run::signals::Interrupt;

use crate::figure;

/// The figures of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Drawn {
    /// The files of the figures.
    pub files: Vec<PathBuf>,
    /// Why the environment's program could not play an episode, as a sentence without a full stop; `None` if it did not
    /// fail.
    pub no_episode: Option<String>,
}

/// Draws the run's learning curve so far and, if it has a best policy, that policy's behaviour. If another program
/// serves the environment, it is started only if it has named its signals and there is an `interrupt`, which can end
/// its episode. `check` is called before each write, because an episode may take long.
///
/// # Errors
/// When `check` fails, a file cannot be read or written, or the policy does not fit the run.
pub fn draw(
    run: &RunDir,
    config: &Config,
    out: &Path,
    interrupt: Option<&Interrupt>,
    check: impl Fn() -> anyhow::Result<()>,
) -> anyhow::Result<Drawn> {
    let mut drawn = Drawn {
        files: vec![out.join("learning-curve.svg")],
        no_episode: None,
    };
    let evaluations = read_evaluations(&run.evaluations())?;
    check()?;
    figure::learning_curve((&run.name(), config.algorithm.name()), &evaluations, &drawn.files[0])?;
    if !run.best_policy().exists() {
        return Ok(drawn);
    }
    if !config.environment.is_external() {
        check()?;
        drawn.files.extend(behaviour(run, config, out)?);
    } else if let Some(interrupt) = interrupt
        && let Some(description) = description::kept(run, config)?
    {
        match episode_of_server(run, config, interrupt) {
            Ok(trajectory) => {
                check()?;
                drawn.files.push(episode(&description, &trajectory, out)?);
            }
            Err(error) => drawn.no_episode = Some(one_line(error)),
        }
    }
    Ok(drawn)
}

/// Draws the behaviour of the best policy in a built-in environment and returns the files: the thesis's figures, or the
/// signals of the first evaluation episode of the run's seed.
fn behaviour(run: &RunDir, config: &Config, out: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let policy = SavedPolicy::Best.read(run, config)?;
    let mut rollout = Rollout::new(config, &policy.parameters)?;
    if let Some(files) = thesis::behaviour(config, &mut rollout, out)? {
        return Ok(files);
    }
    let trajectory = rollout.evaluation_episode(config.run.seed, 0)?;
    Ok(vec![episode(&description::of(config)?, &trajectory, out)?])
}

/// The first evaluation episode of the run's seed, in an environment that another program serves.
fn episode_of_server(run: &RunDir, config: &Config, interrupt: &Interrupt) -> anyhow::Result<Trajectory> {
    let policy = SavedPolicy::Best.read(run, config)?;
    let rollout = Rollout::of_run(run, config, &policy.parameters)?;
    rollout
        .interruptible_by(interrupt.clone())
        .evaluation_episode(config.run.seed, 0)
}

/// Draws the signals of an episode and returns the file.
fn episode(description: &Description, trajectory: &Trajectory, out: &Path) -> anyhow::Result<PathBuf> {
    let path = out.join("episode.svg");
    figure::episode(&description.signals, description.time_step, trajectory, &path)?;
    Ok(path)
}

#[cfg(test)]
mod tests {
    use shoal_common::versioned_file::VersionedFile;

    use super::*;
    use shoal_run::evaluation::rollout::policy_layout;
    use shoal_run::plan::resolve_preset;
    use shoal_run::testing::{run_with_policy, small};

    /// The figures of a run with a policy, by name, and why there is no episode among them.
    fn drawn((config, parameters): (Config, Vec<f32>), said: Option<&Description>) -> (Vec<String>, Option<String>) {
        let parent = tempfile::tempdir().unwrap();
        let run_dir = run_with_policy(parent.path(), "run", &config, Some(parameters));
        let out = parent.path().join("pictures");
        std::fs::create_dir(&out).unwrap();
        if let Some(said) = said {
            said.store(&run_dir.description()).unwrap();
        }
        let no_episode = draw(&run_dir, &config, &out, Some(&Interrupt::default()), || Ok(()))
            .unwrap()
            .no_episode;
        let entries = std::fs::read_dir(out).unwrap();
        let mut files: Vec<_> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        files.sort();
        (files, no_episode)
    }

    fn files_of(run: (Config, Vec<f32>)) -> Vec<String> {
        let (files, no_episode) = drawn(run, None);
        assert_eq!(no_episode, None);
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
    fn a_program_that_serves_the_environment_is_started_only_if_it_names_its_signals() {
        let (mut config, parameters) = small("name = \"pendulum\"");
        config.environment.server = vec!["no-such-program".into()];
        let of = |said| drawn((config.clone(), parameters.clone()), said);
        assert_eq!(of(None), (vec!["learning-curve.svg".into()], None));
        let (files, no_episode) = of(Some(&Description::by_number(&config.spec)));
        assert_eq!(files, ["learning-curve.svg"]);
        let why = no_episode.unwrap();
        assert!(why.contains("no-such-program") && !why.contains('\n'), "{why}");
    }
}
