//! The run's resolved configuration, which is stored in `config.toml`. Each section has a file here or in
//! `algorithms/`, which declares each of its keys once.

mod actors;
mod checkpoint;
mod difference;
mod environment;
mod evaluation;
pub mod explanation;
mod identity;
mod identity_format;
mod learner;
mod observation;
mod remote;
mod replay;
mod reward;
mod run;
mod sections;

use std::fmt::Display;
use std::path::{Path, PathBuf};

pub use actors::ActorsConfig;
pub use checkpoint::CheckpointConfig;
pub use difference::Difference;
pub use environment::EnvironmentConfig;
pub use evaluation::EvaluationConfig;
pub use identity_format::IdentityFormat;
pub use learner::LearnerConfig;
pub use observation::ObservationConfig;
pub use remote::RemoteConfig;
pub use replay::ReplayConfig;
pub use reward::RewardConfig;
pub use run::{Mode, RunConfig};
use sections::Sections;
use shoal_base::message::one_line;
use shoal_base::section;
pub use shoal_base::section::{Change, OutOfRange};
use shoal_base::space::EnvironmentSpec;
use shoal_base::transition::{ChunkLayout, RowLayout};
use shoal_policy::{Policy, PolicyError, PolicyLayout};

use crate::actor_snapshot::ActorSnapshotLayout;
pub use crate::algorithms::*;

/// The complete configuration of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// The run itself: id, seed, mode, length, origin, and when its processes are stalled.
    pub run: RunConfig,
    /// The environment.
    pub environment: EnvironmentConfig,
    /// The environment's spaces and time limit, as its server describes them.
    pub spec: EnvironmentSpec,
    /// The actors, and the size of their chunks.
    pub actors: ActorsConfig,
    /// The algorithm and its settings.
    pub algorithm: AlgorithmConfig,
    /// How observations are prepared for networks. Only algorithms that learn from minibatches have a choice.
    pub observation: ObservationConfig,
    /// How rewards are prepared. Only algorithms that learn from minibatches have a choice.
    pub reward: RewardConfig,
    /// The learner's threads.
    pub learner: LearnerConfig,
    /// The replay, and the ratio of updates to environment steps.
    pub replay: ReplayConfig,
    /// How often, how and on how many episodes policies are evaluated.
    pub evaluation: EvaluationConfig,
    /// How often the learner's state is saved.
    pub checkpoint: CheckpointConfig,
    /// Actors on other hosts.
    pub remote: RemoteConfig,
}

/// What a configuration is refused for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Subject {
    /// A key, with its section.
    Key(String),
    /// Whole sections, by their names.
    Sections(Vec<String>),
    /// Something without a name of its own.
    Unknown,
}

/// Why a configuration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("cannot read {path}: {cause}")]
    Unreadable {
        /// The configuration file.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// The text is not a configuration.
    #[error("{}{message}", origin.as_ref().map(|origin| format!("{origin}: ")).unwrap_or_default())]
    Malformed {
        /// Where the text came from, if it has a name.
        origin: Option<String>,
        /// The part of it that is wrong.
        subject: Subject,
        /// What is wrong with it, on one line.
        message: String,
    },
    /// The text is not TOML.
    #[error("{message}")]
    Syntax {
        /// Where it is wrong and why, on one line.
        message: String,
    },
    /// A value is out of range.
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
    /// The algorithm does not fit the environment.
    #[error("{algorithm} cannot control {environment}: {cause}; choose {fitting}")]
    Control {
        /// Name of the algorithm.
        algorithm: &'static str,
        /// Name of the environment.
        environment: String,
        /// What does not fit.
        cause: PolicyError,
        /// The algorithms that can.
        fitting: String,
    },
}

impl ConfigError {
    /// What the configuration is refused for.
    pub fn subject(&self) -> Subject {
        match self {
            Self::OutOfRange(OutOfRange { key, .. }) => {
                // A number of a list has its index behind the key.
                let key = key.split_once('[').map_or(key.as_str(), |(key, _)| key);
                Subject::Key(key.into())
            }
            Self::Malformed { subject, .. } => subject.clone(),
            Self::Control { algorithm, .. } => Subject::Sections(vec![(*algorithm).into()]),
            Self::Unreadable { .. } | Self::Syntax { .. } => Subject::Unknown,
        }
    }
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
        let table = text.parse::<toml::Table>().map_err(|error| ConfigError::Syntax {
            message: section::malformed(path.display(), &text, &error),
        })?;
        Self::from_table(table, path.display())
    }

    /// Reads a configuration from its sections. `origin` is named in errors.
    ///
    /// # Errors
    /// When a key is unknown, of the wrong type, or out of range.
    pub fn from_table(table: toml::Table, origin: impl Display) -> Result<Self, ConfigError> {
        Self::read(&table, Some(&origin))
    }

    /// Reads a configuration from sections that were put together. Errors name no origin.
    ///
    /// # Errors
    /// As for [`from_table`](Self::from_table).
    pub fn from_settings(table: &toml::Table) -> Result<Self, ConfigError> {
        Self::read(table, None)
    }

    fn read(table: &toml::Table, origin: Option<&dyn Display>) -> Result<Self, ConfigError> {
        let malformed = |(subject, message)| ConfigError::Malformed {
            origin: origin.map(ToString::to_string),
            subject,
            message,
        };
        let sections: Sections = table.clone().try_into().map_err(|error: toml::de::Error| {
            let unreadable = sections::first_unreadable(table);
            malformed(unreadable.unwrap_or_else(|| (Subject::Unknown, one_line(error.message()))))
        })?;
        let config = Self::try_from(sections).map_err(|error| {
            let unreadable = sections::first_unreadable(table);
            malformed(unreadable.unwrap_or_else(|| (error.subject.clone(), error.to_string())))
        })?;
        config.check()?;
        Ok(config)
    }

    /// The configuration as the text of `config.toml`.
    ///
    /// # Errors
    /// When a value cannot be written as TOML (a seed beyond 2⁶³).
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        toml::to_string(self).map_err(|error| ConfigError::Malformed {
            origin: Some("configuration".into()),
            subject: Subject::Unknown,
            message: error.to_string(),
        })
    }

    /// How actors act in `envs` environments.
    ///
    /// # Errors
    /// When the algorithm cannot control the environment; a checked configuration has no such algorithm.
    pub fn behaviour(&self, envs: usize) -> Result<Behaviour, PolicyError> {
        let behaviour = self.algorithm.behaviour(&self.spec, envs)?;
        Ok(behaviour.normalising(self.observation.normalise))
    }

    /// The policy without exploration, for at most `batch` observations a call.
    ///
    /// # Errors
    /// As [`behaviour`](Self::behaviour).
    pub fn policy(&self, batch: usize) -> Result<Policy, PolicyError> {
        Ok(self.behaviour(batch)?.into_policy())
    }

    /// The layout of the policy's parameters.
    ///
    /// # Errors
    /// As [`behaviour`](Self::behaviour).
    pub fn policy_layout(&self) -> Result<PolicyLayout, PolicyError> {
        Ok(self.policy(0)?.layout())
    }

    /// The networks or tables that are learned.
    pub fn learned_shapes(&self) -> LearnedShapes {
        let learned = self.algorithm.settings().learned_shapes(&self.spec);
        learned.normalising(self.observation.normalise)
    }

    /// Rows in a full chunk.
    pub fn chunk_rows(&self) -> usize {
        (self.actors.chunk_steps * self.actors.envs) as usize
    }

    /// Index of the evaluator's environment server. The servers of actors have the actors' indices.
    pub fn evaluation_server(&self) -> u32 {
        self.actors.max
    }

    /// How many actors share a service for their transitions.
    pub fn actors_that_share(&self) -> u32 {
        match self.run.mode {
            Mode::Free => self.actors.max - self.actors.max_on_a_host(),
            Mode::Lockstep => 0,
        }
    }

    /// Environments that the evaluator steps at once.
    pub fn evaluation_envs(&self) -> u32 {
        self.evaluation.episodes.min(self.evaluation.envs)
    }

    /// The layout of a transition's row.
    pub fn row_layout(&self) -> RowLayout {
        RowLayout::new(self.spec.observation.width(), self.spec.action.width())
    }

    /// The layout of a chunk of transitions.
    pub fn chunk_layout(&self) -> ChunkLayout {
        ChunkLayout {
            row: self.row_layout(),
            rows: self.chunk_rows(),
            actor_snapshot_words: self.actor_snapshot_words(),
        }
    }

    /// The layout of an actor's snapshot between two chunks; `None` if there are no snapshots. They exist in lockstep
    /// runs whose environments can save their state: the replacement of a killed process then continues with the same
    /// bits.
    pub fn actor_snapshot_layout(&self) -> Option<ActorSnapshotLayout> {
        let envs = self.actors.envs as usize;
        match (self.run.mode, self.spec.snapshot_words(envs)) {
            (Mode::Free, _) | (_, 0) => None,
            (Mode::Lockstep, environments) => Some(ActorSnapshotLayout {
                environments,
                // An algorithm that cannot control the environment is refused before there is a snapshot.
                exploration: envs * self.behaviour(0).map_or(0, |behaviour| behaviour.state_width()),
                envs,
                n_step: self.row_layout().n_step_words(self.replay.n_step as usize, envs),
            }),
        }
    }

    /// Words of an actor's snapshot; 0 if there are no snapshots.
    pub fn actor_snapshot_words(&self) -> usize {
        self.actor_snapshot_layout().map_or(0, |layout| layout.words())
    }

    /// Checks every value, by itself and together with the others.
    ///
    /// # Errors
    /// For the first invalid value.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.run.check()?;
        self.environment.check()?;
        environment::check_spec(&self.spec)?;
        self.check_episodes()?;
        self.actors.check()?;
        self.algorithm.check()?;
        self.algorithm
            .check_spaces(&self.spec)
            .map_err(|cause| ConfigError::Control {
                algorithm: self.algorithm.name(),
                environment: self.environment.name.clone(),
                cause,
                fitting: self.fitting(),
            })?;
        self.observation.check_bounds("observation")?;
        self.reward.check_bounds("reward")?;
        self.replay.check(&self.algorithm)?;
        self.check_collection()?;
        self.learner.check_bounds("learner")?;
        self.evaluation.check_bounds("evaluation")?;
        self.checkpoint.check_bounds("checkpoint")?;
        Ok(self.remote.check_bounds("remote")?)
    }

    /// The names of the algorithms that can control the environment.
    fn fitting(&self) -> String {
        let all = AlgorithmConfig::all().into_iter();
        let fitting = all.filter(|algorithm| algorithm.check_spaces(&self.spec).is_ok());
        let names: Vec<&str> = fitting.map(|algorithm| algorithm.name()).collect();
        if names.is_empty() {
            "another environment".into()
        } else {
            format!("one of {}, or another environment", names.join(", "))
        }
    }

    /// Checks that an episode fits into a chunk, if the algorithm learns from whole episodes.
    fn check_episodes(&self) -> Result<(), OutOfRange> {
        let algorithm = self.algorithm.properties();
        let (limit, most) = (self.spec.time_limit, ActorsConfig::MAX_CHUNK_STEPS);
        if algorithm.transition_use != TransitionUse::Episodes || limit <= most {
            return Ok(());
        }
        Err(OutOfRange {
            key: "spec.time_limit".into(),
            value: limit.to_string(),
            expected: format!(
                "at most {most}: {} learns from whole episodes, each in a chunk of its own",
                algorithm.name
            ),
        })
    }

    /// Checks the algorithm's requirements on the collection of transitions.
    fn check_collection(&self) -> Result<(), OutOfRange> {
        let algorithm = self.algorithm.properties();
        let only = |key: &str, value: String, only: &str, why: &str| OutOfRange {
            key: key.into(),
            value,
            expected: format!("{only}: {} {why}", algorithm.name),
        };
        if !algorithm.off_policy && self.run.mode == Mode::Free {
            let why = "learns only from transitions of the newest policy";
            return Err(only("run.mode", "free".into(), "lockstep", why));
        }
        if algorithm.transition_use == TransitionUse::Episodes {
            let why = "learns from whole episodes, each in a chunk of its own";
            let (limit, steps) = (self.spec.time_limit, self.actors.chunk_steps);
            if steps != limit {
                let limit = format!("{limit}, the time limit");
                return Err(only("actors.chunk_steps", steps.to_string(), &limit, why));
            }
            if self.actors.envs != 1 {
                return Err(only("actors.envs", self.actors.envs.to_string(), "1", why));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Config, ConfigError> {
        Config::from_table(text.parse().unwrap(), "test")
    }

    const MINIMAL: &str = "[run]\nid = \"1a\"\n[spec]\ntime_limit = 200\nobservation.discrete.n = 16\naction.box = { low = [-2.0], high = [2.0] }\n\
        [environment]\nname = \"pendulum\"\n";

    #[test]
    fn a_resolved_configuration_is_read_back_as_written() {
        let config = parse(&format!("{MINIMAL}start_speed = 1.0\n")).unwrap();
        assert_eq!(parse(&config.to_toml().unwrap()).unwrap(), config);
        assert_eq!(config.spec.state_width, 0, "the value of a file without it");
    }

    #[test]
    fn unknown_keys_and_values_out_of_range_are_named() {
        let unknown = parse(&format!("{MINIMAL}[ddpg]\ngama = 0.9\n"))
            .unwrap_err()
            .to_string();
        assert!(
            unknown.contains("gama") && unknown.contains("gamma") && !unknown.contains('\n'),
            "{unknown}"
        );
        let range = parse(&format!("{MINIMAL}[ddpg]\ngamma = 1.5\n"))
            .unwrap_err()
            .to_string();
        assert_eq!(range, "ddpg.gamma = 1.5: must be from 0 to 1");
        let nan = parse(&format!("{MINIMAL}[ddpg]\ntau = nan\n")).unwrap_err().to_string();
        assert!(nan.contains("ddpg.tau = NaN"), "{nan}");
    }

    #[test]
    fn a_discrete_space_has_at_most_as_many_indices_as_a_float_counts_exactly() {
        let sized = |n: u64| parse(&MINIMAL.replace("discrete.n = 16", &format!("discrete.n = {n}")));
        assert!(sized(1 << 24).is_ok());
        assert_eq!(
            sized((1 << 24) + 1).unwrap_err().to_string(),
            "spec.observation = 16777217 indices: must be at most 16777216 (2^24) indices: choose an environment with fewer"
        );
    }

    #[test]
    fn a_time_limit_is_named_if_an_episode_does_not_fit_into_a_chunk() {
        let text = MINIMAL.replace("time_limit = 200", "time_limit = 4097");
        assert!(parse(&text).is_ok());
        assert_eq!(
            parse(&format!("{text}[reinforce]\n")).unwrap_err().to_string(),
            "spec.time_limit = 4097: must be at most 4096: reinforce learns from whole episodes, each in a chunk of its own"
        );
    }

    #[test]
    fn a_key_of_the_wrong_type_is_named() {
        for (text, part) in [
            (
                "[actors]\nenvs = true\n",
                "test: actors.envs = true: must be a whole number",
            ),
            (
                "[replay]\nwarmup = -1\n",
                "test: replay.warmup = -1: must be a whole number from 0 on",
            ),
            (
                "[learner]\nthread = 1\n",
                "test: learner.thread = 1: unknown field `thread`",
            ),
            ("[ddpg]\ntau = \"\"\n", "test: ddpg.tau = \"\": must be a number"),
            ("[ddpg]\nhidden = 5\n", "test: ddpg.hidden = 5: must be a list"),
            (
                "[ddpg]\nhidden = [5, \"a\"]\n",
                "test: ddpg.hidden = [5, \"a\"]: each must be a whole number",
            ),
            (
                "[evaluation]\nkeep_policies = 1\n",
                "test: evaluation.keep_policies = 1: must be true or false",
            ),
        ] {
            let message = parse(&format!("{MINIMAL}{text}")).unwrap_err().to_string();
            assert!(message.starts_with(part) && !message.contains('\n'), "{message}");
        }
    }

    #[test]
    fn the_fingerprint_depends_on_the_environment_but_not_on_the_length_of_the_run() {
        let base = parse(MINIMAL).unwrap();
        let mut other = base.clone();
        other.run.steps += 1;
        assert_eq!(base.fingerprint(), other.fingerprint());
        other.environment.parameters.insert("start_speed".into(), 1.0.into());
        assert_ne!(base.fingerprint(), other.fingerprint());
    }
}
