//! The list of the learning algorithms.

use shoal_common::config::{self, Config};
use shoal_common::policy::PolicyError;

use super::algorithm::{Algorithm, AlgorithmDefinition, RunSizes, SavedState, StateArrayError};
use super::normaliser::{self, Normaliser};
use super::tabular;
use crate::networks::product::Products;

/// The definition of the algorithm with these settings.
fn definition(algorithm: &config::AlgorithmConfig) -> Box<dyn AlgorithmDefinition + '_> {
    match algorithm {
        config::AlgorithmConfig::Ddpg(settings) => Box::new(settings),
        config::AlgorithmConfig::Td3(settings) => Box::new(settings),
        config::AlgorithmConfig::Sac(settings) => Box::new(settings),
        config::AlgorithmConfig::Dqn(settings) => Box::new(settings),
        config::AlgorithmConfig::Reinforce(settings) => Box::new(settings),
        config::AlgorithmConfig::QLearning(settings) => Box::new(tabular::QLearning(settings)),
        config::AlgorithmConfig::Sarsa(settings) => Box::new(tabular::Sarsa(settings)),
    }
}

/// The algorithm of a configuration, before its first update.
///
/// # Errors
/// When the algorithm cannot control the environment.
pub fn new(config: &Config) -> Result<Box<dyn Algorithm>, PolicyError> {
    definition(&config.algorithm).create(config)
}

/// Names of the arrays of a checkpoint that hold what was learned, as opposed to the state of the optimiser.
pub fn weights(config: &Config) -> Vec<&'static str> {
    let statistics = config.observation.normalise.then_some(Normaliser::ARRAY);
    let learned = definition(&config.algorithm).weights().iter().copied();
    learned.chain(statistics).collect()
}

/// The state of the algorithm `fresh`, except that the arrays `weights` are those of another one's state `saved`. The
/// optimisers begin anew. `rows` rows of its own replay are part of the statistics of observations already.
///
/// # Errors
/// When the other state lacks a part, or has it in another shape.
pub fn inherited(
    fresh: &dyn Algorithm,
    weights: &[&str],
    mut saved: SavedState,
    rows: u64,
) -> Result<Vec<(&'static str, Vec<f32>)>, StateArrayError> {
    let array = |(name, numbers): (&'static str, &[f32])| {
        if !weights.contains(&name) {
            return Ok((name, numbers.to_vec()));
        }
        let mut inherited = saved.take(name, numbers.len())?;
        if name == Normaliser::ARRAY {
            normaliser::set_rows(&mut inherited, rows);
        }
        Ok((name, inherited))
    };
    fresh.state().into_iter().map(array).collect()
}

/// The matrix products of one or a few updates of that algorithm; none if it has no networks, or if its updates
/// have no fixed size.
pub fn products(config: &Config) -> Products {
    definition(&config.algorithm).products(&config.spec)
}

/// The total length of that algorithm's state, computed without creating the algorithm.
pub fn state_numbers(config: &Config) -> usize {
    let statistics = if config.observation.normalise {
        Normaliser::state_numbers(config.spec.observation.width())
    } else {
        0
    };
    definition(&config.algorithm).state_numbers(&config.spec, RunSizes::from(config)) + statistics
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(rest: &str) -> Config {
        let text = format!("[run]\nid = \"1a\"\nmode = \"lockstep\"\n[environment]\nname = \"x\"\n{rest}");
        Config::from_table(text.parse().unwrap(), "test").unwrap()
    }

    #[test]
    fn the_size_and_the_weights_of_a_state_are_known_before_it_exists() {
        let real = "box = { low = [-1.0, -1.0], high = [1.0, 1.0] }";
        let in_order = "[replay]\nwarmup = 0\n[spec]\ntime_limit = 8";
        let mut tested = Vec::new();
        for (rest, observation, action) in [
            ("[ddpg]\nhidden = [7, 5]\n[spec]\ntime_limit = 8", real, real),
            ("[ddpg]\nhidden = [7]\n[spec]\ntime_limit = 8", real, real),
            ("[ddpg]\nhidden = [7, 5, 6]\n[spec]\ntime_limit = 8", real, real),
            ("[td3]\nhidden = [7, 5]\n[spec]\ntime_limit = 8", real, real),
            ("[sac]\nhidden = [7, 5]\n[spec]\ntime_limit = 8", real, real),
            ("[dqn]\nhidden = [7, 5]\n[spec]\ntime_limit = 8", real, "discrete.n = 3"),
            (
                "[dqn]\ndueling = true\nhidden = [7]\n[spec]\ntime_limit = 8",
                real,
                "discrete.n = 3",
            ),
            (
                "[ddpg]\n[observation]\nnormalise = true\n[spec]\ntime_limit = 8",
                real,
                real,
            ),
            (
                "[sac]\n[observation]\nnormalise = true\n[spec]\ntime_limit = 8",
                real,
                real,
            ),
            (&format!("[reinforce]\n{in_order}"), real, "discrete.n = 3"),
            (
                &format!("[reinforce]\nweight = \"baseline\"\n{in_order}"),
                real,
                "discrete.n = 3",
            ),
            (
                &format!("[actors]\nenvs = 3\n[q-learning]\n{in_order}"),
                "discrete.n = 5",
                "discrete.n = 3",
            ),
            (&format!("[sarsa]\n{in_order}"), "discrete.n = 5", "discrete.n = 3"),
        ] {
            let config = config(&format!("{rest}\nobservation.{observation}\naction.{action}\n"));
            tested.push(config.algorithm.name());
            let algorithm = new(&config).unwrap();
            let state = algorithm.state();
            let numbers: usize = state.iter().map(|(_, numbers)| numbers.len()).sum();
            assert_eq!(state_numbers(&config), numbers, "{rest}");
            let named = |name: &&str| state.iter().any(|(array, _)| array == name);
            let weights = weights(&config);
            assert_eq!(
                weights.contains(&"observations"),
                rest.contains("normalise = true"),
                "{rest}"
            );
            // An algorithm inherits its weights, and nothing of the optimiser.
            let other: Vec<(String, Vec<f32>)> = state
                .iter()
                .map(|(name, numbers)| ((*name).to_owned(), vec![0.5; numbers.len()]))
                .collect();
            let begun = inherited(&*algorithm, &weights, SavedState::from(other), 3).unwrap();
            for ((name, numbers), (_, fresh)) in begun.iter().zip(&state) {
                match *name {
                    name if weights.contains(&name) && name != Normaliser::ARRAY => {
                        assert!(numbers.iter().all(|it| *it == 0.5), "{name}")
                    }
                    Normaliser::ARRAY => assert_eq!(numbers[..2], bytemuck::cast::<f64, [f32; 2]>(3.0)),
                    name => assert_eq!(numbers, fresh, "{name}"),
                }
            }
            // Only some algorithms have a baseline.
            assert!(weights.iter().filter(|name| **name != "baseline").all(named), "{rest}");
        }
        for algorithm in config::AlgorithmConfig::all() {
            let name = algorithm.name();
            assert!(
                tested.contains(&name),
                "learner/src/algorithms/registry.rs: no case for {name}"
            );
        }
    }
}
