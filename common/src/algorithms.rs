//! The algorithms: the registry, and for each algorithm a file with its section of the configuration, its policy and
//! its exploration. How each learns is part of the crate `learner`.

mod algorithm;
mod behaviour;
mod ddpg;
mod dqn;
mod exploration;
mod reinforce;
mod sac;
mod tabular;
mod td3;

pub use algorithm::{ActorCritic, AlgorithmProperties, AlgorithmSettings, LearnedShapes, Shape, TransitionUse};
pub use behaviour::{Behaviour, Epsilon};
pub use ddpg::DdpgConfig;
pub use dqn::DqnConfig;
pub use exploration::{ExplorationConfig, Warmup};
pub use reinforce::{ReinforceConfig, ReinforceNetworks, ReturnWeighting};
pub use sac::SacConfig;
use serde::Serialize;
use shoal_base::section::{self, OutOfRange, Section, SectionError, describe};
use shoal_base::space::{EnvironmentSpec, Space};
use shoal_policy::PolicyError;
pub use tabular::TabularConfig;
pub use td3::Td3Config;

macro_rules! registry {
    ($($(#[$attribute:meta])* $variant:ident($settings:ty) is $properties:expr;)*) => {
        /// The algorithm of a run, with its settings. Its section in `config.toml` has its name.
        #[derive(Clone, Debug, PartialEq, Serialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum AlgorithmConfig {
            $($(#[$attribute])* $variant($settings)),*
        }

        impl AlgorithmConfig {
            /// Each algorithm with its default settings.
            pub fn all() -> Vec<Self> {
                vec![$(Self::$variant(<$settings>::default())),*]
            }

            /// The algorithm's fixed properties.
            pub fn properties(&self) -> AlgorithmProperties {
                match self {
                    $(Self::$variant(_) => $properties),*
                }
            }

            /// Its settings, without the type of the algorithm.
            pub fn settings(&self) -> &dyn AlgorithmSettings {
                match self {
                    $(Self::$variant(settings) => settings),*
                }
            }

            fn settings_mut(&mut self) -> &mut dyn AlgorithmSettings {
                match self {
                    $(Self::$variant(settings) => settings),*
                }
            }

            /// γ, the discount of one step.
            pub fn gamma(&self) -> f64 {
                match self {
                    $(Self::$variant(settings) => settings.gamma),*
                }
            }

            /// Checks every number of its sections.
            ///
            /// # Errors
            /// For the first invalid number.
            pub fn check(&self) -> Result<(), OutOfRange> {
                match self {
                    $(Self::$variant(settings) => settings.check_bounds($properties.name)),*
                }
            }

            /// The keys of every algorithm's section.
            pub fn sections() -> Vec<Section> {
                vec![$(describe::<$settings>($properties.name)),*]
            }

            /// Reads the section of the algorithm `name`; `None` if there is no algorithm of that name.
            ///
            /// # Errors
            /// When a key is unknown or of the wrong type. The error names the key and its value.
            pub fn read(name: &str, section: toml::Value) -> Option<Result<Self, SectionError>> {
                $(if name == $properties.name {
                    return Some(section::read(name, section).map(Self::$variant));
                })*
                None
            }
        }
    };
}

// The registry: a line for each algorithm. The variant in kebab case is the section's name (`QLearning`:
// `[q-learning]`).
registry! {
    /// `[ddpg]` and `[exploration]`.
    Ddpg(DdpgConfig) is ddpg::PROPERTIES;
    /// `[td3]`.
    Td3(Td3Config) is td3::PROPERTIES;
    /// `[sac]`.
    Sac(SacConfig) is sac::PROPERTIES;
    /// `[dqn]`.
    Dqn(DqnConfig) is dqn::PROPERTIES;
    /// `[reinforce]`.
    Reinforce(ReinforceConfig) is reinforce::PROPERTIES;
    /// `[q-learning]`.
    QLearning(TabularConfig) is tabular::Q_LEARNING;
    /// `[sarsa]`.
    Sarsa(TabularConfig) is tabular::SARSA;
}

impl Default for AlgorithmConfig {
    /// The algorithm of a configuration that has no algorithm's section.
    fn default() -> Self {
        Self::Ddpg(DdpgConfig::default())
    }
}

impl AlgorithmConfig {
    /// The algorithms whose own sections are among these.
    pub fn all_in(sections: &toml::Table) -> Vec<AlgorithmProperties> {
        let all = Self::all().into_iter().map(|algorithm| algorithm.properties());
        all.filter(|algorithm| sections.contains_key(algorithm.name)).collect()
    }

    /// The algorithm of a configuration with these sections, if they name one. Only DDPG has a second section,
    /// `[exploration]`.
    pub fn named_in(sections: &toml::Table) -> Option<AlgorithmProperties> {
        let named = Self::all_in(sections).into_iter().next();
        named.or_else(|| sections.contains_key("exploration").then_some(ddpg::PROPERTIES))
    }

    /// The name of the algorithm that suits an environment, for a user who has chosen none.
    pub fn suitable(spec: &EnvironmentSpec) -> &'static str {
        let suitable = match (&spec.observation, &spec.action) {
            (Space::Box { .. }, Space::Box { .. }) => sac::PROPERTIES,
            (Space::Discrete { .. }, Space::Box { .. }) => ddpg::PROPERTIES,
            (Space::Box { .. }, Space::Discrete { .. }) => dqn::PROPERTIES,
            (Space::Discrete { .. }, Space::Discrete { .. }) => tabular::Q_LEARNING,
        };
        suitable.name
    }

    /// Sets what follows from the length of the run, in environment steps, if it is left open. Returns the key that was
    /// set.
    pub fn set_from_length(&mut self, steps: u64) -> Option<&'static str> {
        self.settings_mut().set_from_length(steps)
    }

    /// Each algorithm that learns from minibatches, with its default settings.
    pub fn all_with_minibatches() -> impl Iterator<Item = Self> {
        let all = Self::all().into_iter();
        all.filter(|algorithm| algorithm.properties().transition_use == TransitionUse::Minibatches)
    }

    /// Its name, which is its section's.
    pub fn name(&self) -> &'static str {
        self.properties().name
    }

    /// The settings of DDPG, if this is DDPG.
    pub fn ddpg(&self) -> Option<&DdpgConfig> {
        match self {
            Self::Ddpg(ddpg) => Some(ddpg),
            _ => None,
        }
    }

    /// How its actors act in `envs` environments like `spec`, if observations are not normalised.
    ///
    /// # Errors
    /// When it cannot control such environments.
    pub fn behaviour(&self, spec: &EnvironmentSpec, envs: usize) -> Result<Behaviour, PolicyError> {
        self.settings().behaviour(spec, envs)
    }

    /// Checks that it can control environments like `spec`.
    ///
    /// # Errors
    /// When it cannot.
    pub fn check_spaces(&self, spec: &EnvironmentSpec) -> Result<(), PolicyError> {
        self.behaviour(spec, 0).map(drop)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(observation: Space, action: Space) -> EnvironmentSpec {
        EnvironmentSpec {
            observation,
            action,
            time_limit: 100,
            state_width: 0,
        }
    }

    #[test]
    fn each_algorithm_accepts_the_spaces_that_it_can_control() {
        let real = || Space::boxed(&[(-1.0, 1.0); 4]);
        let counted = || Space::discrete(3);
        let fitting = |observation: fn() -> Space, action: fn() -> Space| -> Vec<&str> {
            let spec = spec(observation(), action());
            let all = AlgorithmConfig::all().into_iter();
            all.filter(|algorithm| algorithm.check_spaces(&spec).is_ok())
                .map(|algorithm| algorithm.name())
                .collect()
        };
        assert_eq!(fitting(real, real), ["ddpg", "td3", "sac"]);
        // DDPG's networks take an index as a number, as in earlier versions.
        assert_eq!(fitting(counted, real), ["ddpg"]);
        assert_eq!(fitting(real, counted), ["dqn", "reinforce"]);
        assert_eq!(fitting(counted, counted), ["q-learning", "sarsa"]);
    }

    #[test]
    fn the_suitable_algorithm_can_control_the_environment() {
        let spaces = || [Space::boxed(&[(-1.0, 1.0); 4]), Space::discrete(3)];
        for (observation, action) in spaces()
            .into_iter()
            .flat_map(|one| spaces().map(|other| (one.clone(), other)))
        {
            let spec = spec(observation, action);
            let mut all = AlgorithmConfig::all().into_iter();
            let suitable = all.find(|algorithm| algorithm.name() == AlgorithmConfig::suitable(&spec));
            suitable.unwrap().check_spaces(&spec).unwrap();
        }
    }

    #[test]
    fn an_algorithm_is_written_and_read_under_its_name() {
        for algorithm in AlgorithmConfig::all() {
            let written = toml::Table::try_from(&algorithm).unwrap();
            assert_eq!(written.keys().collect::<Vec<_>>(), [algorithm.name()]);
            let section = written[algorithm.name()].clone();
            assert_eq!(
                AlgorithmConfig::read(algorithm.name(), section).unwrap().unwrap(),
                algorithm
            );
        }
        assert!(AlgorithmConfig::read("exploration", toml::Table::new().into()).is_none());
    }

    #[test]
    fn the_learned_policy_has_as_many_parameters_as_the_policy_layout() {
        let (real, counted) = (|| Space::boxed(&[(-1.0, 1.0); 4]), || Space::discrete(3));
        let specs = [
            spec(real(), real()),
            spec(real(), counted()),
            spec(counted(), counted()),
        ];
        for algorithm in AlgorithmConfig::all() {
            let fits = specs
                .iter()
                .find_map(|spec| Some((spec, algorithm.behaviour(spec, 0).ok()?)));
            let (spec, behaviour) = fits.unwrap();
            for normalised in [false, true] {
                let layout = behaviour.clone().normalising(normalised).into_policy().layout();
                let (_, policy) = algorithm.settings().learned_shapes(spec).normalising(normalised).policy;
                assert_eq!(policy.parameters(), layout.parameters(), "{}", algorithm.name());
            }
        }
    }
}
