//! What the environment of a run says of its numbers.

use shoal_common::config::Config;
use shoal_env_server::environment::{Goal, Picture, Signal, make};

/// What an environment says of itself, besides its spaces.
#[derive(Clone, Debug, PartialEq)]
pub struct Description {
    /// What its numbers mean.
    pub signals: Vec<Signal>,
    /// Δt of a step in s, where it has a time.
    pub time_step: Option<f64>,
    /// What success is, where it says so.
    pub goal: Option<Goal>,
    /// What can be drawn of it.
    pub picture: Picture,
}

impl Description {
    /// Of the run's environment. Where another program serves it, its numbers are known by their place alone.
    ///
    /// # Errors
    /// When the environment cannot be made from the configuration.
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
    fn another_programs_environment_is_described_by_number_whatever_it_is_called() {
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
