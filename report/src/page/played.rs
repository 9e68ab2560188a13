//! Evaluation episodes of a run's best policy, step by step, to be played.

use serde::Serialize;
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use shoal_env_server::environment::Picture;
use shoal_run::description::Description;
use shoal_run::evaluation::WhichPolicy;
use shoal_run::numbers::thousands;
use shoal_run::rollout::{Rollout, Trajectory};

use super::numbers::short;
use super::signals::{Trace, traces};

/// Pictures of an episode; of a longer one every second step is left out, or more.
const FRAMES: usize = 1_000;

/// Steps taken for all episodes of a run together, about.
const STEPS: usize = 20_000;

/// Episodes to be played, or why there are none.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Played {
    /// One sentence for the reader.
    pub(super) why_not: Option<String>,
    picture: Picture,
    /// Δt of a step in s, where the environment has a time.
    time_step: Option<f64>,
    /// Which policy acts.
    policy: String,
    pub(super) episodes: Vec<Episode>,
}

#[derive(Clone, Debug, Serialize)]
pub(super) struct Episode {
    /// Its number among the evaluation episodes of the run's seed.
    number: usize,
    pub(super) steps: usize,
    /// Steps from one picture to the next; the last may be nearer.
    stride: usize,
    #[serde(rename = "return")]
    episode_return: f64,
    terminated: bool,
    pub(super) signals: Vec<Trace>,
}

impl Played {
    /// Plays the first `episodes` evaluation episodes of the run's seed. What cannot be played is said, and no error.
    pub(super) fn of(run: &RunDir, config: &Config, episodes: usize) -> Self {
        let why_not = |why_not: String| Self {
            why_not: Some(why_not),
            ..Self::default()
        };
        if episodes == 0 {
            return why_not(
                "There is no room for played episodes of so many runs; a report of this run alone has them.".into(),
            );
        }
        let which = match (run.best_policy().exists(), run.last_policy().exists()) {
            (true, _) => WhichPolicy::Best,
            (false, true) => WhichPolicy::Last,
            (false, false) => return why_not("No policy has been evaluated yet.".into()),
        };
        Self::try_of(run, config, which, episodes)
            .unwrap_or_else(|error| why_not(format!("This cannot be played: {error:#}.")))
    }

    fn try_of(run: &RunDir, config: &Config, which: WhichPolicy, episodes: usize) -> anyhow::Result<Self> {
        let policy = which.read(run, config)?;
        let Description {
            signals,
            time_step,
            picture,
            ..
        } = Description::of(config)?;
        let mut rollout = Rollout::of_run(run, config, &policy.parameters)?;
        let limit = config.spec.time_limit.max(1) as usize;
        let mut played = Vec::new();
        for number in 0..episodes.min(STEPS / limit).max(1) {
            let trajectory = rollout.evaluation_episode(config.run.seed, number as u64)?;
            let of_frames = |frames: &[usize]| traces(&signals, &config.spec, &trajectory, frames);
            played.push(Episode::of(number, &trajectory, of_frames));
        }
        let called = match which {
            WhichPolicy::Best => "best",
            WhichPolicy::Last => "last",
        };
        Ok(Self {
            why_not: None,
            picture,
            time_step,
            policy: format!(
                "the {called} policy, learned from {} environment steps",
                thousands(policy.env_steps)
            ),
            episodes: played,
        })
    }
}

impl Episode {
    /// The traces are asked for at the frames that the episode is shown by.
    fn of(number: usize, trajectory: &Trajectory, of_frames: impl Fn(&[usize]) -> Vec<Trace>) -> Self {
        let steps = trajectory.actions.len();
        let stride = steps.div_ceil(FRAMES).max(1);
        let frames: Vec<usize> = (0..steps).step_by(stride).chain([steps]).collect();
        Self {
            number,
            steps,
            stride,
            episode_return: short(trajectory.episode_return()),
            terminated: trajectory.terminated,
            signals: of_frames(&frames),
        }
    }
}
