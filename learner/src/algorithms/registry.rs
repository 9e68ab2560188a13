//! The list of the learning algorithms.

use std::ops::Range;

use shoal_common::config::{self, Config};
use shoal_common::policy::PolicyError;

use super::algorithm::{Algorithm, AlgorithmDefinition, RunSizes, SavedState, StateArrayError};
use super::normaliser::{self, Normaliser};
use super::tabular::{Bootstrap, TabularDefinition};
use crate::networks::product::Products;

/// The definition of the algorithm with these settings.
fn definition(algorithm: &config::AlgorithmConfig) -> Box<dyn AlgorithmDefinition + '_> {
    let tabular = |bootstrap, settings| Box::new(TabularDefinition { bootstrap, settings });
    match algorithm {
        config::AlgorithmConfig::Ddpg(settings) => Box::new(settings),
        config::AlgorithmConfig::Td3(settings) => Box::new(settings),
        config::AlgorithmConfig::Sac(settings) => Box::new(settings),
        config::AlgorithmConfig::Dqn(settings) => Box::new(settings),
        config::AlgorithmConfig::Reinforce(settings) => Box::new(settings),
        config::AlgorithmConfig::QLearning(settings) => tabular(Bootstrap::Max, settings),
        config::AlgorithmConfig::Sarsa(settings) => tabular(Bootstrap::NextAction, settings),
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
pub fn weight_names(config: &Config) -> Vec<&'static str> {
    let statistics = config.observation.normalise.then_some(Normaliser::ARRAY);
    let learned = definition(&config.algorithm).weight_names().iter().copied();
    learned.chain(statistics).collect()
}

/// The first state of a run that begins with the weights of another run. The arrays in `weight_names` come from the
/// other run's state `saved`; all others, such as the optimisers' moments, come from the new algorithm `fresh`.
/// `copied` are the rows of the other replay that the new one begins with. The statistics of observations keep what the
/// other run had counted, so these rows are not counted again.
///
/// # Errors
/// When the other state lacks a part, or has it in another shape.
pub fn inherited(
    fresh: &dyn Algorithm,
    weight_names: &[&str],
    mut saved: SavedState,
    copied: Range<u64>,
) -> Result<Vec<(&'static str, Vec<f32>)>, StateArrayError> {
    let array = |(name, numbers): (&'static str, &[f32])| {
        if !weight_names.contains(&name) {
            return Ok((name, numbers.to_vec()));
        }
        let mut inherited = saved.take(name, numbers.len())?;
        if name == Normaliser::ARRAY {
            normaliser::begin_with_rows(&mut inherited, copied.clone());
        }
        Ok((name, inherited))
    };
    fresh.state().into_iter().map(array).collect()
}

/// The matrix products of one or a few updates of the configuration's algorithm; none if it has no networks, or if its
/// updates have no fixed size.
pub fn products(config: &Config) -> Products {
    definition(&config.algorithm).products(&config.spec)
}

/// The total length of the state of the configuration's algorithm, computed without creating it.
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
    use shoal_common::algorithms::TransitionUse;
    use shoal_common::config::AlgorithmConfig;

    use super::*;

    const REAL: &str = "box = { low = [-1.0, -1.0], high = [1.0, 1.0] }";
    const COUNTED: &str = "discrete.n = 5";

    fn config(sections: &str, observation: &str, action: &str) -> Option<Config> {
        let text = format!(
            "[run]\nid = \"1a\"\nmode = \"lockstep\"\n[environment]\nname = \"x\"\n{sections}\n\
             [spec]\ntime_limit = 8\nobservation.{observation}\naction.{action}\n"
        );
        Config::from_table(text.parse().unwrap(), "test").ok()
    }

    /// Each algorithm with its defaults, in an environment that it can control.
    fn defaults() -> impl Iterator<Item = (String, Config)> {
        AlgorithmConfig::all().into_iter().map(|algorithm| {
            let once = algorithm.properties().transition_use != TransitionUse::Minibatches;
            let replay = if once { "[replay]\nwarmup = 0" } else { "" };
            let sections = format!("[{}]\n{replay}", algorithm.name());
            let spaces = [(REAL, REAL), (REAL, COUNTED), (COUNTED, COUNTED)];
            let mut fitting = spaces.iter().filter_map(|(s, a)| config(&sections, s, a));
            let config = fitting.next().unwrap();
            (sections, config)
        })
    }

    /// Settings that change what the state consists of.
    fn variants() -> impl Iterator<Item = (String, Config)> {
        let variants = [
            ("[ddpg]\nhidden = [7]", REAL, REAL),
            ("[ddpg]\nhidden = [7, 5, 6]", REAL, REAL),
            ("[ddpg]\n[observation]\nnormalise = true", REAL, REAL),
            ("[sac]\n[observation]\nnormalise = true", REAL, REAL),
            ("[dqn]\ndueling = true\nhidden = [7]", REAL, COUNTED),
            (
                "[reinforce]\nweight = \"baseline\"\n[replay]\nwarmup = 0",
                REAL,
                COUNTED,
            ),
            (
                "[q-learning]\n[replay]\nwarmup = 0\n[actors]\nenvs = 3",
                COUNTED,
                COUNTED,
            ),
        ];
        variants
            .into_iter()
            .map(|(sections, s, a)| (sections.to_owned(), config(sections, s, a).unwrap()))
    }

    #[test]
    fn the_size_and_the_weights_of_a_state_are_known_before_it_exists() {
        for (sections, config) in defaults().chain(variants()) {
            let algorithm = new(&config).unwrap();
            let state = algorithm.state();
            let numbers: usize = state.iter().map(|(_, numbers)| numbers.len()).sum();
            assert_eq!(state_numbers(&config), numbers, "{sections}");
            let named = |name: &&str| state.iter().any(|(array, _)| array == name);
            let weight_names = weight_names(&config);
            assert_eq!(
                weight_names.contains(&"observations"),
                sections.contains("normalise = true"),
                "{sections}"
            );
            // An algorithm inherits its weights, and nothing of the optimiser.
            let mut other: Vec<(String, Vec<f32>)> = state
                .iter()
                .map(|(name, numbers)| ((*name).to_owned(), vec![0.5; numbers.len()]))
                .collect();
            // It had looked at 6 rows, and rows 4 to 8 are copied.
            for (_, numbers) in other.iter_mut().filter(|(name, _)| name == Normaliser::ARRAY) {
                numbers[..2].copy_from_slice(&bytemuck::cast::<f64, [f32; 2]>(6.0));
            }
            let begun = inherited(&*algorithm, &weight_names, SavedState::from(other), 4..9).unwrap();
            for ((name, numbers), (_, fresh)) in begun.iter().zip(&state) {
                match *name {
                    name if weight_names.contains(&name) && name != Normaliser::ARRAY => {
                        assert!(numbers.iter().all(|it| *it == 0.5), "{name}")
                    }
                    Normaliser::ARRAY => assert_eq!(numbers[..2], bytemuck::cast::<f64, [f32; 2]>(2.0)),
                    name => assert_eq!(numbers, fresh, "{name}"),
                }
            }
            // Only some algorithms have a baseline.
            assert!(
                weight_names.iter().filter(|name| **name != "baseline").all(named),
                "{sections}"
            );
        }
    }
}
