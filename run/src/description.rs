//! The meaning of an environment's numbers.

use shoal_common::config::Config;
use shoal_env_server::environment::{Goal, Picture, Signal, make};

/// What is known of an environment besides its spaces.
#[derive(Clone, Debug, PartialEq)]
pub struct Description {
    /// The meaning of its observations and actions.
    pub signals: Vec<Signal>,
    /// Δt of a step in s, if the environment models time.
    pub time_step: Option<f64>,
    /// What success means, if the environment defines it.
    pub goal: Option<Goal>,
    /// How an episode is drawn.
    pub picture: Picture,
}

impl Description {
    /// Describes the run's environment. Of one that another program serves, only the positions of its numbers are
    /// known.
    ///
    /// # Errors
    /// When the environment cannot be created from the configuration.
    pub fn of(config: &Config) -> anyhow::Result<Self> {
        if !config.environment.server.is_empty() {
            return Ok(Self {
                signals: Signal::by_number(&config.spec),
                time_step: None,
                goal: None,
                picture: Picture::None,
            });
        }
        let environment = make(&config.environment.name, &config.environment.parameters)?;
        Ok(Self {
            signals: environment.signals(),
            time_step: environment.time_step(),
            goal: environment.goal(),
            picture: environment.picture(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small;

    #[test]
    fn an_external_environment_is_described_by_position_even_under_a_builtin_name() {
        let (mut config, _) = small("name = \"point-mass\"\nreward = \"r1\"");
        let ours = Description::of(&config).unwrap();
        assert!(ours.goal.is_some() && ours.picture == Picture::Plane && ours.signals[0].key == "x");
        config.environment.server = vec!["some-program".into()];
        let theirs = Description::of(&config).unwrap();
        assert_eq!(
            (theirs.goal, theirs.picture, theirs.time_step),
            (None, Picture::None, None)
        );
        let keys: Vec<_> = theirs.signals.iter().map(|signal| signal.key.as_str()).collect();
        assert_eq!((keys.len(), keys[0], keys[7]), (8, "observation-1", "action-2"));
    }
}
