//! `[run]`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::section;
use shoal_base::section::{OutOfRange, from};

use super::identity_format::IdentityFormat;

section! {
    /// Identity and length of the run.
    pub struct RunConfig {
        /// Names the run's services and shared memory; chosen when the run directory is made.
        id: String = String::new(), unit: "–", source: "ours";
        /// The root of every random stream.
        seed: u64 = 1, bounds: from(0, i64::MAX as u64), unit: "–", source: "ours";
        /// Whether timing may decide anything.
        mode: Mode = Mode::Free, unit: "–", source: "ours";
        /// Environment steps over all actors after which training ends.
        steps: u64 = 120_000, bounds: from(1, 1_000_000_000_000),
            unit: "environment steps", source: "sections 4.1 to 5.3, each task its own";
        /// Episodes over all actors after which it ends, if that is earlier.
        #[serde(skip_serializing_if = "Option::is_none")]
        episodes: Option<u64> = None, bounds: from(1, 1_000_000_000), unit: "episodes", source: "sections 4.1 and 4.2";
        /// How long a process may make no progress while those it waits for live and wait too; then it is replaced. One that is
        /// stopped, or an environment that takes its time over a step, is not.
        stall_seconds: u64 = 10, bounds: from(1, 86_400), unit: "s", source: "ours";
        /// The form of the text that tells the run's files from those of others; noted when the run directory is made.
        #[serde(skip_serializing_if = "IdentityFormat::is_unnumbered")]
        #[schemars(with = "u32")]
        identity_format: IdentityFormat = IdentityFormat::Unnumbered, unit: "–", source: "ours";
    }
}

/// Whether timing may decide anything.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Actors and learner run side by side, within the ratio's tolerance.
    Free,
    /// Actors and learner take turns: the same seed and actor count give the same bits.
    Lockstep,
}

impl RunConfig {
    /// Whether so many environment steps, or episodes, are all that were asked for. Updates may be left.
    pub fn has_all_steps(&self, env_steps: u64, episodes: u64) -> bool {
        env_steps >= self.steps || self.episodes.is_some_and(|limit| episodes >= limit)
    }

    /// Whether every value makes sense.
    ///
    /// # Errors
    /// For the first one that does not.
    pub fn check(&self) -> Result<(), OutOfRange> {
        self.check_id()?;
        self.check_bounds("run")
    }

    /// The id is part of file names, and what has those names is removed when the run ends: `..` would be everybody's.
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
