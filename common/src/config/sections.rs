//! The configuration as it is written: a section for each part, and of the algorithms' sections one at most.

use serde::{Deserialize, Serialize};

use super::{
    Actors, Algorithm, Checkpoint, Config, Ddpg, Environment, Evaluation, Exploration, Learner, Reinforce, Replay, Run,
    Tabular,
};
use crate::space::EnvironmentSpec;

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Sections {
    run: Run,
    environment: Environment,
    spec: EnvironmentSpec,
    #[serde(default)]
    actors: Actors,
    exploration: Option<Exploration>,
    ddpg: Option<Ddpg>,
    reinforce: Option<Reinforce>,
    #[serde(rename = "q-learning")]
    q_learning: Option<Tabular>,
    sarsa: Option<Tabular>,
    #[serde(default)]
    learner: Learner,
    #[serde(default)]
    replay: Replay,
    #[serde(default)]
    evaluation: Evaluation,
    #[serde(default)]
    checkpoint: Checkpoint,
}

impl TryFrom<Sections> for Config {
    type Error = String;

    fn try_from(sections: Sections) -> Result<Self, String> {
        let named: Vec<Algorithm> = [
            sections.reinforce.map(Algorithm::Reinforce),
            sections.q_learning.map(Algorithm::QLearning),
            sections.sarsa.map(Algorithm::Sarsa),
        ]
        .into_iter()
        .flatten()
        .collect();
        let algorithm = match (named.as_slice(), sections.ddpg, sections.exploration) {
            ([], ddpg, exploration) => Algorithm::Ddpg(ddpg.unwrap_or_default(), exploration.unwrap_or_default()),
            ([one], None, None) => one.clone(),
            ([one], None, Some(_)) => {
                return Err(format!(
                    "[exploration] is the noise of ddpg, and this is a configuration for {}",
                    one.name()
                ));
            }
            ([one, ..], ddpg, _) => {
                let other = if ddpg.is_some() { "ddpg" } else { named[1].name() };
                return Err(format!(
                    "there are sections for two algorithms, [{}] and [{other}]: keep one",
                    one.name()
                ));
            }
        };
        Ok(Self {
            run: sections.run,
            environment: sections.environment,
            spec: sections.spec,
            actors: sections.actors,
            algorithm,
            learner: sections.learner,
            replay: sections.replay,
            evaluation: sections.evaluation,
            checkpoint: sections.checkpoint,
        })
    }
}

impl From<Config> for Sections {
    fn from(config: Config) -> Self {
        let mut sections = Self {
            run: config.run,
            environment: config.environment,
            spec: config.spec,
            actors: config.actors,
            exploration: None,
            ddpg: None,
            reinforce: None,
            q_learning: None,
            sarsa: None,
            learner: config.learner,
            replay: config.replay,
            evaluation: config.evaluation,
            checkpoint: config.checkpoint,
        };
        match config.algorithm {
            Algorithm::Ddpg(ddpg, exploration) => {
                (sections.ddpg, sections.exploration) = (Some(ddpg), Some(exploration));
            }
            Algorithm::Reinforce(reinforce) => sections.reinforce = Some(reinforce),
            Algorithm::QLearning(tabular) => sections.q_learning = Some(tabular),
            Algorithm::Sarsa(tabular) => sections.sarsa = Some(tabular),
        }
        sections
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn algorithm(text: &str) -> Result<Algorithm, String> {
        let rest = "[run]\nid = \"1a\"\n[environment]\nname = \"x\"\n\
            [spec]\ntime_limit = 100\nobservation.discrete.n = 16\naction.discrete.n = 4\n";
        let sections: Sections = toml::from_str(&format!("{rest}{text}")).unwrap();
        Config::try_from(sections).map(|config| config.algorithm)
    }

    #[test]
    fn an_algorithm_is_named_by_its_section_and_is_ddpg_else() {
        assert_eq!(algorithm("").unwrap().name(), "ddpg");
        assert_eq!(algorithm("[exploration]\nsigma = 0.1").unwrap().name(), "ddpg");
        for name in ["reinforce", "q-learning", "sarsa"] {
            let read = algorithm(&format!("[{name}]\ngamma = 0.5")).unwrap();
            assert_eq!((read.name(), read.gamma()), (name, 0.5));
        }
    }

    #[test]
    fn one_algorithm_is_enough() {
        for (text, part) in [
            ("[ddpg]\n[sarsa]", "[sarsa] and [ddpg]"),
            ("[reinforce]\n[q-learning]", "[reinforce] and [q-learning]"),
            ("[reinforce]\n[exploration]", "[exploration] is the noise of ddpg"),
        ] {
            let message = algorithm(text).unwrap_err();
            assert!(message.contains(part), "{message}");
        }
    }
}
