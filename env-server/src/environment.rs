//! The environments, and how they are made by name.

pub mod angle;
pub mod cart_pole;
mod drawing;
mod error;
pub mod frozen_lake;
mod interface;
pub mod pendulum;
pub mod point_mass;
mod signal;

pub use drawing::{Class, Drawing, Form, Point, Shape};
pub use error::{EnvironmentError, OutOfRange, RequestError, check, check_time_limit};
pub use interface::{Environment, Step};
use schemars::JsonSchema;
use serde::{Serialize, de::DeserializeOwned};
use shoal_base::section::{self, Key};
pub use signal::{Goal, Picture, Signal, SignalSource};

/// Every environment: its name, and how it is made from its parameters. A new one needs its file, a `mod` line above
/// and a line here.
const ENVIRONMENTS: &[(&str, Builder)] = &[
    ("pendulum", |parameters| build(parameters, pendulum::Pendulum::new)),
    ("point-mass", |parameters| build(parameters, point_mass::PointMass::new)),
    ("cart-pole", |parameters| build(parameters, cart_pole::CartPole::new)),
    ("frozen-lake", |parameters| {
        build(parameters, frozen_lake::FrozenLake::new)
    }),
];

/// The names that `make` and `resolve` accept.
pub fn names() -> impl Iterator<Item = &'static str> {
    ENVIRONMENTS.iter().map(|(name, _)| *name)
}

/// Makes the environment of this name. Parameters that are not given have their defaults.
pub fn make(name: &str, parameters: &toml::Table) -> Result<Box<dyn Environment>, EnvironmentError> {
    find(name, parameters).map(|made| made.environment)
}

/// All parameters of the environment of this name, with defaults filled in. `make` makes the same environment from
/// them.
pub fn resolve(name: &str, parameters: &toml::Table) -> Result<toml::Table, EnvironmentError> {
    find(name, parameters).map(|made| made.parameters)
}

/// Describes each parameter of the environment of this name.
pub fn explain(name: &str) -> Result<Vec<Key>, EnvironmentError> {
    find(name, &toml::Table::new()).map(|made| (made.explain)())
}

struct Built {
    environment: Box<dyn Environment>,
    parameters: toml::Table,
    explain: fn() -> Vec<Key>,
}

type Builder = fn(&toml::Table) -> Result<Built, String>;

fn find(name: &str, parameters: &toml::Table) -> Result<Built, EnvironmentError> {
    let Some((environment, builder)) = ENVIRONMENTS.iter().find(|(known, _)| *known == name) else {
        let (name, known) = (name.to_owned(), names().collect::<Vec<_>>().join(", "));
        return Err(EnvironmentError::UnknownName { name, known });
    };
    builder(parameters).map_err(|reason| EnvironmentError::Parameters { environment, reason })
}

fn build<P: Serialize + DeserializeOwned + JsonSchema, E: Environment + 'static>(
    parameters: &toml::Table,
    new: impl FnOnce(P) -> Result<E, OutOfRange>,
) -> Result<Built, String> {
    let read: P = parameters
        .clone()
        .try_into()
        .map_err(|error| error::wrong_parameter(parameters, &error))?;
    let parameters = toml::Table::try_from(&read).map_err(|e| e.to_string())?;
    let environment = Box::new(new(read).map_err(|e| e.to_string())?);
    Ok(Built {
        environment,
        parameters,
        explain: section::keys::<P>,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::Description;
    use shoal_base::space::Space;
    use shoal_base::stream::{Purpose, stream};

    fn table(text: &str) -> toml::Table {
        text.parse().unwrap()
    }

    fn refusal(name: &str, text: &str) -> String {
        let message = resolve(name, &table(text)).unwrap_err().to_string();
        assert!(!message.contains('\n'), "one line: {message}");
        message
    }

    #[test]
    fn every_environment_observes_within_its_spec() {
        for name in names() {
            let mut environment = make(name, &toml::Table::new()).unwrap();
            let spec = environment.spec();
            let mut rng = stream(1, Purpose::Environment, 0, 0);
            let action = vec![f64::INFINITY; spec.action.width()];
            let mut observation = vec![f32::NAN; spec.observation.width()];
            for step in 0..100 {
                if step % 10 == 0 {
                    environment.reset(&mut rng);
                }
                assert!(environment.step(&action, &mut rng).reward.is_finite(), "{name}");
                environment.observe(&mut observation);
                let inside = match &spec.observation {
                    Space::Box { low, high } => observation
                        .iter()
                        .enumerate()
                        .all(|(i, x)| (low[i]..=high[i]).contains(x)),
                    Space::Discrete { n, .. } => observation[0] < *n as f32,
                };
                assert!(inside, "{name} observed {observation:?}");
            }
            environment.step(&vec![f64::NAN; spec.action.width()], &mut rng);
        }
    }

    #[test]
    fn every_environment_is_described_correctly() {
        for name in names() {
            let environment = make(name, &toml::Table::new()).unwrap();
            let description = Description::of(&*environment);
            assert_eq!(description.check(&environment.spec()), Ok(()), "{name}");
            for Signal { key, .. } in &description.signals {
                assert!(
                    key.chars()
                        .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-'),
                    "{name}: {key}"
                );
            }
            if let Some(goal) = description.goal {
                assert!(description.signals.contains(&goal.distance), "{name}");
            }
        }
    }

    #[test]
    fn resolved_parameters_are_complete_and_resolve_to_themselves() {
        for name in names() {
            let resolved = resolve(name, &toml::Table::new()).unwrap();
            assert!(resolved.contains_key("time_limit"), "{name}");
            assert_eq!(resolve(name, &resolved).unwrap(), resolved);
        }
        let pendulum = resolve("pendulum", &table("start_speed = 1")).unwrap();
        assert_eq!(pendulum, table("start_speed = 1.0\ntime_limit = 200"));
        assert_eq!(make("pendulum", &table("time_limit = 7")).unwrap().spec().time_limit, 7);
    }

    #[test]
    fn an_unknown_name_is_answered_with_the_known_ones() {
        let message = refusal("pendulums", "");
        let known = names().collect::<Vec<_>>().join(", ");
        assert_eq!(
            message,
            format!("unknown environment `pendulums`: choose one of {known}")
        );
    }

    #[test]
    fn bad_parameters_are_refused_in_one_line_that_names_them() {
        let unknown = refusal("pendulum", "star_speed = 1.0");
        assert!(unknown.contains("pendulum") && unknown.contains("star_speed") && unknown.contains("start_speed"));
        let wrong_type = refusal("point-mass", "friction = \"much\"");
        assert!(
            wrong_type.ends_with("friction = \"much\": must be a number, such as 0.5"),
            "{wrong_type}"
        );
        let negative = refusal("cart-pole", "time_limit = -1");
        assert!(
            negative.contains("time_limit = -1: must be a whole number from 0 on"),
            "{negative}"
        );
        assert_eq!(
            refusal("point-mass", "friction = -0.5"),
            "environment point-mass: friction = -0.5: must be from 0 to 1"
        );
        for (name, text) in [
            ("pendulum", "start_speed = nan"),
            ("pendulum", "time_limit = 0"),
            ("point-mass", "stiction_ratio = 0.9"),
            ("point-mass", "mass = 0.0"),
            ("frozen-lake", "time_limit = 0"),
        ] {
            assert!(refusal(name, text).contains(": must be from "), "{name} {text}");
        }
    }
}
