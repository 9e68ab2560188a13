//! The sections of the configuration's text. At most one of the algorithms' sections may be present.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use shoal_base::section::SectionError;
use shoal_base::space::EnvironmentSpec;
use toml::Table;

use super::{
    ActorsConfig, AlgorithmConfig, CheckpointConfig, Config, EnvironmentConfig, EvaluationConfig, ExplorationConfig,
    LearnerConfig, ObservationConfig, RemoteConfig, ReplayConfig, RewardConfig, RunConfig, Subject, explanation,
};
use crate::algorithms::TransitionUse;

/// The sections as they are read.
#[derive(Deserialize)]
pub(super) struct Sections {
    run: RunConfig,
    environment: EnvironmentConfig,
    spec: EnvironmentSpec,
    #[serde(default)]
    actors: ActorsConfig,
    exploration: Option<ExplorationConfig>,
    observation: Option<ObservationConfig>,
    reward: Option<RewardConfig>,
    #[serde(default)]
    learner: LearnerConfig,
    #[serde(default)]
    replay: ReplayConfig,
    #[serde(default)]
    evaluation: EvaluationConfig,
    #[serde(default)]
    checkpoint: CheckpointConfig,
    #[serde(default)]
    remote: RemoteConfig,
    /// Sections of algorithms, and unknown keys.
    #[serde(flatten)]
    others: Table,
}

/// The sections as they are written.
#[derive(Serialize)]
struct Written<'a> {
    run: &'a RunConfig,
    environment: &'a EnvironmentConfig,
    spec: &'a EnvironmentSpec,
    actors: &'a ActorsConfig,
    #[serde(skip_serializing_if = "Option::is_none")]
    exploration: Option<&'a ExplorationConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    observation: Option<&'a ObservationConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reward: Option<&'a RewardConfig>,
    /// A section with the algorithm's name.
    #[serde(flatten)]
    algorithm: &'a AlgorithmConfig,
    learner: &'a LearnerConfig,
    replay: &'a ReplayConfig,
    evaluation: &'a EvaluationConfig,
    checkpoint: &'a CheckpointConfig,
    /// Not written if it is the default, because most runs have one host.
    #[serde(skip_serializing_if = "Option::is_none")]
    remote: Option<&'a RemoteConfig>,
}

impl<'de> Deserialize<'de> for Config {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::try_from(Sections::deserialize(deserializer)?).map_err(de::Error::custom)
    }
}

/// Why sections that can be read one by one are not a configuration.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub(super) struct SectionsError {
    pub(super) subject: Subject,
    message: String,
}

impl SectionsError {
    fn new(sections: &[&str], message: String) -> Self {
        let names = sections.iter().map(|name| (*name).to_owned());
        Self {
            subject: Subject::Sections(names.collect()),
            message,
        }
    }
}

impl From<SectionError> for SectionsError {
    fn from(error: SectionError) -> Self {
        Self {
            subject: error.key.map_or(Subject::Unknown, Subject::Key),
            message: error.message,
        }
    }
}

impl TryFrom<Sections> for Config {
    type Error = SectionsError;

    fn try_from(sections: Sections) -> Result<Self, SectionsError> {
        let mut algorithm = one_algorithm(sections.others)?;
        if let Some(exploration) = sections.exploration {
            // Only DDPG has a section for its exploration.
            let AlgorithmConfig::Ddpg(ddpg) = &mut algorithm else {
                let why = "[exploration] is the noise of ddpg, but this configuration is for";
                return Err(SectionsError::new(
                    &["exploration"],
                    format!("{why} {}", algorithm.name()),
                ));
            };
            ddpg.exploration = exploration;
        }
        let (observation, reward) = (
            sections.observation.unwrap_or_default(),
            sections.reward.unwrap_or_default(),
        );
        let are_default = observation == ObservationConfig::default() && reward == RewardConfig::default();
        if !are_default && algorithm.properties().transition_use != TransitionUse::Minibatches {
            let why = "[observation] and [reward] are for algorithms that learn from minibatches, but this \
                       configuration is for";
            return Err(SectionsError::new(
                &["observation", "reward"],
                format!("{why} {}", algorithm.name()),
            ));
        }
        Ok(Self {
            run: sections.run,
            environment: sections.environment,
            spec: sections.spec,
            actors: sections.actors,
            algorithm,
            observation,
            reward,
            learner: sections.learner,
            replay: sections.replay,
            evaluation: sections.evaluation,
            checkpoint: sections.checkpoint,
            remote: sections.remote,
        })
    }
}

/// What the first section that cannot be read is refused for, and why. serde's own error does not name the key.
pub(super) fn first_unreadable(sections: &Table) -> Option<(Subject, String)> {
    explanation::sections().into_iter().find_map(|section| {
        let name = section.name;
        let SectionError { key, message } = (section.check)(name, sections.get(name)?.clone()).err()?;
        let subject = key.map_or_else(|| Subject::Sections(vec![name.into()]), Subject::Key);
        Some((subject, message))
    })
}

/// The algorithm that has a section, or the default algorithm if none has one.
fn one_algorithm(mut sections: Table) -> Result<AlgorithmConfig, SectionsError> {
    let named = AlgorithmConfig::all_in(&sections);
    let is_unknown = |section: &&String| !named.iter().any(|algorithm| algorithm.name == section.as_str());
    if let Some(unknown) = sections.keys().find(is_unknown) {
        let known = explanation::sections().into_iter().map(|section| section.name);
        let known: Vec<String> = known.chain(["spec"]).map(|name| format!("`{name}`")).collect();
        let message = format!("unknown field `{unknown}`, expected one of {}", known.join(", "));
        return Err(SectionsError::new(&[unknown.as_str()], message));
    }
    if let [one, other, ..] = named.as_slice() {
        let (one, other) = (one.name, other.name);
        return Err(SectionsError::new(
            &[one, other],
            format!("there are sections for two algorithms, [{one}] and [{other}]: keep one"),
        ));
    }
    let read = named
        .into_iter()
        .find_map(|algorithm| AlgorithmConfig::read(algorithm.name, sections.remove(algorithm.name)?));
    Ok(read.unwrap_or_else(|| Ok(AlgorithmConfig::default()))?)
}

impl Serialize for Config {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        // Every field, so that the compiler names a section that is not written.
        let Self {
            run,
            environment,
            spec,
            actors,
            algorithm,
            observation,
            reward,
            learner,
            replay,
            evaluation,
            checkpoint,
            remote,
        } = self;
        let has_minibatches = algorithm.properties().transition_use == TransitionUse::Minibatches;
        Written {
            run,
            environment,
            spec,
            actors,
            exploration: algorithm.ddpg().map(|ddpg| &ddpg.exploration),
            observation: has_minibatches.then_some(observation),
            reward: has_minibatches.then_some(reward),
            algorithm,
            learner,
            replay,
            evaluation,
            checkpoint,
            remote: Some(remote).filter(|remote| **remote != RemoteConfig::default()),
        }
        .serialize(serializer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn algorithm(text: &str) -> Result<AlgorithmConfig, String> {
        let rest = "[run]\nid = \"1a\"\n[environment]\nname = \"x\"\n\
            [spec]\ntime_limit = 100\nobservation.discrete.n = 16\naction.discrete.n = 4\n";
        let sections: Sections = toml::from_str(&format!("{rest}{text}")).unwrap();
        let config = Config::try_from(sections).map_err(|error| error.to_string())?;
        Ok(config.algorithm)
    }

    #[test]
    fn the_algorithm_is_the_one_with_a_section_and_ddpg_by_default() {
        assert_eq!(algorithm("").unwrap().name(), "ddpg");
        assert_eq!(algorithm("[exploration]\nsigma = 0.1").unwrap().name(), "ddpg");
        for name in ["reinforce", "q-learning", "sarsa"] {
            let read = algorithm(&format!("[{name}]\ngamma = 0.5")).unwrap();
            assert_eq!((read.name(), read.gamma()), (name, 0.5));
        }
    }

    #[test]
    fn sections_of_two_algorithms_and_unknown_sections_are_refused() {
        for (text, part) in [
            ("[sarsa]\n[ddpg]", "[ddpg] and [sarsa]"),
            ("[reinforce]\n[q-learning]", "[reinforce] and [q-learning]"),
            ("[reinforce]\n[exploration]", "[exploration] is the noise of ddpg"),
            ("[td4]", "unknown field `td4`, expected one of `run`, "),
        ] {
            let message = algorithm(text).unwrap_err();
            assert!(message.contains(part), "{message}");
        }
    }
}
