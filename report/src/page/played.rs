//! Evaluation episodes of a run's best policy, recorded step by step for the page's player.

use serde::Serialize;
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use shoal_env_server::description::Description;
use shoal_env_server::environment::Picture;
use shoal_run::description;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::rollout::{Rollout, Trajectory};
use shoal_run::numbers::thousands;

use super::numbers::{PageLimits, short};
use super::pictures::{self, Pictures};
use super::signals::{Trace, traces};

/// At most about this many frames of an episode. A longer episode shows every second step, every third, and so on.
const MAX_FRAMES: usize = 1_000;

/// Approximate limit on the steps of all episodes of a run.
const MAX_STEPS: usize = 20_000;

/// Playable episodes, or the reason why there are none.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Played {
    /// A sentence for the reader of the page if there are no episodes.
    pub(super) why_not: Option<String>,
    picture: Picture,
    /// Why an episode of an environment that another program serves has no pictures: a sentence for the reader.
    no_pictures: Option<String>,
    /// How long a step is shown, in s, by the environment's frame rate. Used only if `time_step` is `None`.
    pace: Option<f64>,
    /// Δt of a step in s; `None` if a step of the environment has no duration.
    time_step: Option<f64>,
    /// Describes the policy that acts.
    policy: String,
    pub(super) episodes: Vec<Episode>,
}

#[derive(Clone, Debug, Serialize)]
pub(super) struct Episode {
    /// Its number among the evaluation episodes of the run's seed.
    number: usize,
    pub(super) steps: usize,
    /// Steps between frames. There may be fewer before the last frame.
    stride: usize,
    #[serde(rename = "return")]
    episode_return: f64,
    terminated: bool,
    pub(super) signals: Vec<Trace>,
    /// What another program has drawn.
    pictures: Option<Pictures>,
}

impl Played {
    /// Runs the first evaluation episodes of the run's seed. A failure is not an error: its reason is in `why_not`.
    pub(super) fn of(run: &RunDir, config: &Config, limits: PageLimits) -> Self {
        let why_not = |why_not: String| Self {
            why_not: Some(why_not),
            ..Self::default()
        };
        if limits.episodes == 0 {
            return why_not(
                "A report of this many runs has no space for this run's episodes; a report of this run alone shows \
                 them."
                    .into(),
            );
        }
        let which = match (run.best_policy().exists(), run.last_policy().exists()) {
            (true, _) => SavedPolicy::Best,
            (false, true) => SavedPolicy::Last,
            (false, false) => return why_not("No policy has been evaluated yet.".into()),
        };
        Self::try_of(run, config, which, limits)
            .unwrap_or_else(|error| why_not(format!("The episodes cannot be played: {error:#}.")))
    }

    fn try_of(run: &RunDir, config: &Config, which: SavedPolicy, limits: PageLimits) -> anyhow::Result<Self> {
        let policy = which.read(run, config)?;
        let Description {
            signals,
            time_step,
            picture,
            ..
        } = description::of_run(run, config)?;
        // Built-in environments are drawn by the page, from their signals.
        let is_external = config.environment.is_external();
        let mut rollout = Rollout::of_run(run, config, &policy.parameters)?;
        let (mut no_pictures, mut pace) = (None, None);
        if is_external && limits.pictured > 0 {
            rollout = rollout.with_pictures(pictures::HEIGHT);
        } else if is_external {
            no_pictures = Some("A report of this many runs has no space for this run's pictures.".into());
        }
        let limit = config.spec.time_limit.max(1) as usize;
        let mut played = Vec::new();
        for number in 0..limits.episodes.min(MAX_STEPS / limit).max(1) {
            let episode = (config.run.seed, number as u64);
            let (trajectory, frames) = if is_external && number < limits.pictured && no_pictures.is_none() {
                let (trajectory, frames) = rollout.filmed_episode(episode, limits.pictures, |_| ())?;
                pace = pace.or(frames.as_ref().ok().and_then(|frames| frames.fps).map(f64::recip));
                let frames = frames.and_then(|frames| Pictures::of(&frames, limits.bytes));
                no_pictures = frames
                    .as_ref()
                    .err()
                    .map(|reason| format!("This environment cannot be shown: {reason}."));
                (trajectory, frames.ok())
            } else {
                (rollout.evaluation_episode(episode.0, episode.1)?, None)
            };
            let of_frames = |frames: &[usize]| traces(&signals, &config.spec, &trajectory, frames);
            played.push(Episode::of(number, &trajectory, of_frames, frames));
        }
        if is_external && no_pictures.is_none() {
            no_pictures = Some("Only the first episodes have pictures, so that the page stays small.".into());
        }
        let called = match which {
            SavedPolicy::Best => "best",
            SavedPolicy::Last => "last",
        };
        Ok(Self {
            why_not: None,
            picture,
            no_pictures,
            pace,
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
    /// `of_frames` returns the traces at the given frames.
    fn of(
        number: usize,
        trajectory: &Trajectory,
        of_frames: impl Fn(&[usize]) -> Vec<Trace>,
        pictures: Option<Pictures>,
    ) -> Self {
        let steps = trajectory.actions.len();
        let stride = steps.div_ceil(MAX_FRAMES).max(1);
        let frames: Vec<usize> = (0..steps).step_by(stride).chain([steps]).collect();
        Self {
            number,
            steps,
            stride,
            episode_return: short(trajectory.episode_return()),
            terminated: trajectory.terminated,
            signals: of_frames(&frames),
            pictures,
        }
    }
}
