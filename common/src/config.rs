//! The run's configuration, as it stands in `config.toml` once everything is decided. Each section belongs to one part of
//! the system, and a role is handed the sections it needs, never the whole.

mod algorithm;
mod defaults;
pub mod explanation;
mod limits;
mod sections;

pub use algorithm::{Algorithm, Ddpg, Exploration, Reinforce, Tabular, Warmup, Weight};

use std::fmt::Display;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use self::sections::Sections;
use crate::policy::PolicyError;
use crate::space::EnvironmentSpec;
use crate::transition::{ChunkLayout, RowLayout};

/// Everything a run was started with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Sections", into = "Sections")]
pub struct Config {
    /// Identity and length of the run.
    pub run: Run,
    /// What is controlled.
    pub environment: Environment,
    /// What the environment says of itself.
    pub spec: EnvironmentSpec,
    /// Who explores, and in how large portions.
    pub actors: Actors,
    /// What is learned, and how.
    pub algorithm: Algorithm,
    /// With what it is computed.
    pub learner: Learner,
    /// What is remembered, and how often it is used.
    pub replay: Replay,
    /// How often the policy is judged.
    pub evaluation: Evaluation,
    /// How often the learner's state is saved.
    pub checkpoint: Checkpoint,
}

/// Identity and length of the run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Run {
    /// Names the run's services and shared memory; chosen when the run directory is made.
    #[schemars(extend("unit" = "–", "source" = "ours"))]
    pub id: String,
    /// The root of every random stream.
    #[schemars(extend("unit" = "–", "source" = "ours"))]
    pub seed: u64,
    /// Whether timing may decide anything.
    #[schemars(extend("unit" = "–", "source" = "ours"))]
    pub mode: Mode,
    /// Environment steps over all actors after which training ends.
    #[schemars(extend("unit" = "environment steps", "source" = "sections 4.1 to 5.3, each task its own"))]
    pub steps: u64,
    /// Episodes over all actors after which it ends, if that is earlier.
    #[schemars(extend("unit" = "episodes", "source" = "sections 4.1 and 4.2"))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub episodes: Option<u64>,
    /// How long a process may make no progress while those it waits for live and wait too; then it is replaced. One that is
    /// stopped, or an environment that takes its time over a step, is not.
    #[schemars(extend("unit" = "s", "source" = "ours"))]
    pub stall_seconds: u64,
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

/// What is controlled: an environment's name, and the parameters that this environment understands.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Environment {
    /// One of the environments' names, or what another program makes an environment from, as `gym:Pendulum-v1`.
    #[schemars(extend("unit" = "–", "source" = "chapters 4 and 5"))]
    pub name: String,
    /// The command that starts that program, an environment server as `docs/PROTOCOL.md` has it; empty for our own.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("unit" = "–", "source" = "ours"))]
    pub server: Vec<String>,
    /// The environment's own parameters.
    #[serde(flatten)]
    #[schemars(skip)]
    pub parameters: toml::Table,
}

/// Who explores, and in how large portions.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Actors {
    /// Actor processes, each with an environment server of its own.
    #[schemars(extend("unit" = "processes", "source" = "ours"))]
    pub count: u32,
    /// Environments an actor steps at once.
    #[schemars(extend("unit" = "environments", "source" = "ours"))]
    pub envs: u32,
    /// Steps of every environment that travel in one chunk: a chunk has `chunk_steps · envs` rows.
    #[schemars(extend("unit" = "steps", "source" = "ours"))]
    pub chunk_steps: u32,
    /// Chunks an actor may have sent that the learner has not yet committed.
    #[schemars(extend("unit" = "chunks", "source" = "ours"))]
    pub window: u32,
    /// The most actors the run can be scaled to.
    #[schemars(extend("unit" = "processes", "source" = "ours"))]
    pub max: u32,
}

/// With what is learned: no number that is learned depends on it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Learner {
    /// Threads that share the work of an update where there is enough of it, 1 or 2. Not a bit of what is learned depends
    /// on them.
    #[schemars(extend("unit" = "threads", "source" = "ours"))]
    pub threads: u32,
}

/// What is remembered, and how often it is used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Replay {
    /// The newest so many transitions are sampled from.
    #[schemars(extend("unit" = "transitions", "source" = "section 4.3.1"))]
    pub capacity: u64,
    /// Transitions collected before the first update.
    #[schemars(extend("unit" = "transitions", "source" = "ours"))]
    pub warmup: u64,
    /// Updates for each environment step beyond the warm-up. The thesis: 1.
    #[schemars(extend("unit" = "updates per environment step", "source" = "Algorithm 4"))]
    pub updates_per_step: f64,
    /// Steps the actors may be ahead of that ratio before the learner stops taking transitions.
    #[schemars(extend("unit" = "environment steps", "source" = "ours"))]
    pub tolerance: u64,
}

/// How often the policy is judged.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Evaluation {
    /// Environment steps from one evaluation to the next.
    #[schemars(extend("unit" = "environment steps", "source" = "ours"))]
    pub every: u64,
    /// Episodes of an evaluation, always from the same start states.
    #[schemars(extend("unit" = "episodes", "source" = "ours"))]
    pub episodes: u32,
    /// Episodes of the last evaluation, whose mean is the run's result.
    #[schemars(extend("unit" = "episodes", "source" = "ours"))]
    pub final_episodes: u32,
    /// Whether every policy that was judged is kept, not only the best.
    #[schemars(extend("unit" = "–", "source" = "ours"))]
    pub keep_policies: bool,
}

/// How often the learner's state is saved.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Checkpoint {
    /// Seconds between checkpoints of a free run.
    #[schemars(extend("unit" = "s", "source" = "ours"))]
    pub every_seconds: f64,
    /// Updates between checkpoints of a lockstep run.
    #[schemars(extend("unit" = "updates", "source" = "ours"))]
    pub every_updates: u64,
}

impl Evaluation {
    /// The period that a policy learned from so many environment steps falls into. A policy is judged when no policy of
    /// its period or a later one was.
    pub fn period(&self, env_steps: u64) -> u64 {
        env_steps / self.every
    }
}

/// Why a configuration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("cannot read {path}: {cause}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// The text is not a configuration.
    #[error("{origin}: {message}")]
    Malformed {
        /// Where the text came from.
        origin: String,
        /// What is wrong with it, on one line.
        message: String,
    },
    /// A value is outside what makes sense.
    #[error("{key} = {value}: must be {expected}")]
    OutOfRange {
        /// The key, with its section.
        key: &'static str,
        /// The value found.
        value: String,
        /// What would be accepted.
        expected: String,
    },
    /// The algorithm does not fit the environment.
    #[error("{algorithm} cannot control {environment}: {cause}; choose another algorithm or another environment")]
    Control {
        /// The algorithm.
        algorithm: &'static str,
        /// The environment.
        environment: String,
        /// What does not fit.
        cause: PolicyError,
    },
}

impl Config {
    /// Reads a resolved configuration.
    ///
    /// # Errors
    /// When the file is missing, is not a configuration, or holds a value out of range.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|cause| ConfigError::Unreadable {
            path: path.to_owned(),
            cause,
        })?;
        let table = text.parse().map_err(|error| malformed(path.display(), &error))?;
        Self::from_table(table, path.display())
    }

    /// A configuration from its sections; `origin` is named when something is wrong with them.
    ///
    /// # Errors
    /// When a key is unknown, of the wrong type, or out of range.
    pub fn from_table(table: toml::Table, origin: impl Display) -> Result<Self, ConfigError> {
        let config: Self = table.try_into().map_err(|error| malformed(origin, &error))?;
        config.check()?;
        Ok(config)
    }

    /// The configuration as the text of `config.toml`.
    ///
    /// # Errors
    /// When a value cannot be written as TOML (a seed beyond 2⁶³).
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        toml::to_string(self).map_err(|error| ConfigError::Malformed {
            origin: "configuration".into(),
            message: error.to_string(),
        })
    }

    /// Rows in a full chunk.
    pub fn chunk_rows(&self) -> usize {
        (self.actors.chunk_steps * self.actors.envs) as usize
    }

    /// Index of the evaluator's environment server; those of the actors have the actors' indices.
    pub fn evaluation_server(&self) -> u32 {
        self.actors.max
    }

    /// Environments that the evaluator steps at once.
    pub fn evaluation_envs(&self) -> u32 {
        self.evaluation.episodes.min(64)
    }

    /// How a transition's row is laid out.
    pub fn row_layout(&self) -> RowLayout {
        RowLayout::new(self.spec.observation.width(), self.spec.action.width())
    }

    /// What a chunk of transitions has room for.
    pub fn chunk_layout(&self) -> ChunkLayout {
        ChunkLayout {
            row: self.row_layout(),
            rows: self.chunk_rows(),
            standing_words: self.standing_words(),
        }
    }

    /// Words that say where an actor stands between two chunks: in lockstep, where the environments can say their state, a
    /// process that is killed is replaced by one that goes on with the same bits.
    pub fn standing_words(&self) -> usize {
        let envs = self.actors.envs as usize;
        match (self.run.mode, self.spec.snapshot_words(envs)) {
            (Mode::Free, _) | (_, 0) => 0,
            // The actor's own step, and of each environment the state of the noise and the return and length of its episode.
            (Mode::Lockstep, snapshot) => snapshot + 1 + envs * (self.noise_width() + 2),
        }
    }

    /// Numbers in the exploration noise's state for each environment.
    pub fn noise_width(&self) -> usize {
        match self.algorithm {
            Algorithm::Ddpg(..) => self.spec.action.width(),
            _ => 0,
        }
    }

    /// A number for all that the rows of the replay and the weights of a checkpoint depend on. Length of the run, number
    /// of actors and intervals are not among it: those may change when a run is resumed.
    pub fn fingerprint(&self) -> u64 {
        let algorithm = match &self.algorithm {
            // As it was written when there was no other.
            Algorithm::Ddpg(ddpg, exploration) => format!("{ddpg:?} {exploration:?}"),
            other => format!("{other:?}"),
        };
        let identity = format!(
            "{} {} {:?} {} {:?} {algorithm}",
            self.run.id, self.run.seed, self.run.mode, self.environment.name, self.environment.parameters,
        );
        let digest = Sha256::digest(identity.as_bytes());
        digest.iter().take(8).fold(0, |word, &byte| word << 8 | u64::from(byte))
    }
}

fn malformed(origin: impl Display, error: &toml::de::Error) -> ConfigError {
    ConfigError::Malformed {
        origin: origin.to_string(),
        message: error.message().replace('\n', " "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Config, ConfigError> {
        Config::from_table(text.parse().unwrap(), "test")
    }

    const LEAST: &str = "[run]\nid = \"1a\"\n[spec]\ntime_limit = 200\nobservation.discrete.n = 16\naction.box = { low = [-2.0], high = [2.0] }\n\
        [environment]\nname = \"pendulum\"\n";

    #[test]
    fn a_resolved_configuration_reads_back() {
        let config = parse(&format!("{LEAST}start_speed = 1.0\n")).unwrap();
        assert_eq!(parse(&config.to_toml().unwrap()).unwrap(), config);
        assert_eq!(config.spec.state_width, 0, "where it is not written");
    }

    #[test]
    fn unknown_keys_and_values_out_of_range_are_named() {
        let unknown = parse(&format!("{LEAST}[ddpg]\ngama = 0.9\n")).unwrap_err().to_string();
        assert!(
            unknown.contains("gama") && unknown.contains("gamma") && !unknown.contains('\n'),
            "{unknown}"
        );
        let range = parse(&format!("{LEAST}[ddpg]\ngamma = 1.5\n")).unwrap_err().to_string();
        assert_eq!(range, "ddpg.gamma = 1.5: must be from 0 to 1");
        let nan = parse(&format!("{LEAST}[ddpg]\ntau = nan\n")).unwrap_err().to_string();
        assert!(nan.contains("ddpg.tau = NaN"), "{nan}");
    }

    #[test]
    fn the_fingerprint_follows_what_the_rows_depend_on() {
        let base = parse(LEAST).unwrap();
        let mut other = base.clone();
        other.run.steps += 1;
        assert_eq!(base.fingerprint(), other.fingerprint());
        other.environment.parameters.insert("start_speed".into(), 1.0.into());
        assert_ne!(base.fingerprint(), other.fingerprint());
    }
}
