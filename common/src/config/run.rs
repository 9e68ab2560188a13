//! `[run]`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::section;
use shoal_base::section::{Change, OutOfRange, from, never};

use super::identity_format::IdentityFormat;

section! {
    /// The run itself: id, seed, mode, length, origin, and when its processes are stalled.
    pub struct RunConfig {
        /// Names the run's services and shared memory. Chosen by the program when the run directory is created.
        id: String = String::new(), unit: "–", source: "ours", change: Change::ByProgram;
        /// The seed of every random stream.
        seed: u64 = 1, bounds: from(0, i64::MAX as u64), unit: "–", source: "ours",
            change: never("every random stream of the run depends on it");
        /// Whether results may depend on timing (free) or not (lockstep).
        mode: Mode = Mode::Free, unit: "–", source: "ours",
            change: never("the replay and its actors' snapshots are made for it");
        /// Environment steps of all actors after which training ends.
        steps: u64 = 120_000, bounds: from(1, 1_000_000_000_000),
            unit: "environment steps", source: "sections 4.1 to 5.3, each task its own", change: Change::Anytime;
        /// Episodes of all actors after which training ends, if that is earlier.
        #[serde(skip_serializing_if = "Option::is_none")]
        episodes: Option<u64> = None, bounds: from(1, 1_000_000_000), unit: "episodes", source: "sections 4.1 and 4.2",
            change: Change::Anytime;
        /// A process is replaced after this time without progress if the processes that it waits for are alive and wait
        /// too. Stopped processes and environments with long steps are not replaced.
        stall_seconds: u64 = 10, bounds: from(1, 86_400), unit: "s", source: "ours", change: Change::Anytime;
        /// The run fails if a role fails to start five times in a row and these starts span at least this time and
        /// twice its longest start.
        give_up_seconds: u64 = 30, bounds: from(1, 86_400), unit: "s", source: "ours", change: Change::Anytime;
        /// The run that supplied the initial networks, from `--from`.
        #[serde(skip_serializing_if = "Option::is_none")]
        from: Option<String> = None, unit: "–", source: "ours", change: Change::ByProgram;
        /// The dataset that supplied the initial rows, from `--demonstrations`.
        #[serde(skip_serializing_if = "Option::is_none")]
        demonstrations: Option<String> = None, unit: "–", source: "ours", change: Change::ByProgram;
        /// The format of the text that identifies the run's files. Chosen by the program when the run directory is
        /// created.
        #[serde(skip_serializing_if = "IdentityFormat::is_unnumbered")]
        #[schemars(with = "u32")]
        identity_format: IdentityFormat = IdentityFormat::Unnumbered, unit: "–", source: "ours",
            change: Change::ByProgram;
    }
}

/// Whether results may depend on timing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Actors and learner run side by side, within the ratio's tolerance.
    Free,
    /// Actors and learner take turns: the same seed and actor count give the same bits.
    Lockstep,
}

impl RunConfig {
    /// Whether the run begins with another run's networks or with a dataset's rows.
    pub fn has_origin(&self) -> bool {
        self.from.is_some() || self.demonstrations.is_some()
    }

    /// Whether this many environment steps or episodes complete the collection. Updates may remain to be made.
    pub fn has_all_steps(&self, env_steps: u64, episodes: u64) -> bool {
        env_steps >= self.steps || self.episodes.is_some_and(|limit| episodes >= limit)
    }

    /// Checks every value.
    ///
    /// # Errors
    /// For the first invalid value.
    pub fn check(&self) -> Result<(), OutOfRange> {
        self.check_id()?;
        self.check_bounds("run")
    }

    /// Checks the id, which is part of the names of files that are removed when the run ends. With an id such as `..`
    /// other files would be removed.
    fn check_id(&self) -> Result<(), OutOfRange> {
        let id = &self.id;
        if (1..=32).contains(&id.len()) && id.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-') {
            return Ok(());
        }
        Err(OutOfRange {
            key: "run.id".into(),
            value: format!("{id:?}"),
            expected: "1 to 32 letters, digits and hyphens, as the program chose it".into(),
        })
    }
}
