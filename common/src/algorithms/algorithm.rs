//! The interface of an algorithm for code that does not depend on a particular one.

use std::fmt::{self, Display, Formatter};

use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;
use shoal_policy::network::{Activation, Hidden, NetworkLayout};

use super::behaviour::Behaviour;

/// The fixed properties of an algorithm, which do not depend on its settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AlgorithmProperties {
    /// Its name, which is also the name of its section.
    pub name: &'static str,
    /// Whether it can learn from transitions of older policies. If not, it runs in lockstep only.
    pub off_policy: bool,
    /// How it uses transitions.
    pub transition_use: TransitionUse,
    /// The defaults of a new run, a configuration in TOML: its section, and the keys of other sections that go with it.
    /// This is `presets/method/NAME.toml`.
    pub defaults: &'static str,
}

/// How an algorithm uses the transitions that it learns from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TransitionUse {
    /// In minibatches drawn at random from the replay, each transition many times.
    Minibatches,
    /// Each transition once, in order.
    Transitions,
    /// In whole episodes, each transition once. A chunk is an episode.
    Episodes,
}

/// The settings of an algorithm: its section of the configuration, and everything derived from it. Observations are as
/// the environment has them; `Config` adds their normalisation.
pub trait AlgorithmSettings {
    /// Its policy in an environment like `spec`, for at most `envs` observations a call, and how actors explore with
    /// it. `envs` is 0 if only the layout is needed.
    ///
    /// # Errors
    /// When it cannot control that environment.
    fn behaviour(&self, spec: &EnvironmentSpec, envs: usize) -> Result<Behaviour, PolicyError>;

    /// The networks or tables that it learns in an environment like `spec`. `policy` has as many parameters as the
    /// policy of `behaviour`. Names and shapes enter the run's identity, so they never change.
    fn learned_shapes(&self, spec: &EnvironmentSpec) -> LearnedShapes;

    /// Transitions in a minibatch; 1 if it does not learn from minibatches.
    fn batch(&self) -> usize;

    /// A key and its value that a run takes over, besides the shapes, when it begins with networks of these settings.
    fn inherited_setting(&self) -> Option<(&'static str, toml::Value)> {
        None
    }

    /// Fills in the key whose default depends on the length of the run, in environment steps, if it is not set. Returns
    /// that key.
    fn set_from_length(&mut self, _steps: u64) -> Option<&'static str> {
        None
    }
}

/// The networks of an algorithm with an actor and a critic, or several critics of the same layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActorCritic {
    /// The policy.
    pub actor: NetworkLayout,
    /// The action-value function.
    pub critic: NetworkLayout,
}

impl ActorCritic {
    /// The actor and two critics.
    pub(super) fn with_twin_critics(self) -> LearnedShapes {
        let critic = Shape::Network(self.critic);
        LearnedShapes {
            policy: ("actor", Shape::Network(self.actor)),
            others: vec![("critic 1", critic), ("critic 2", critic)],
        }
    }
}

/// The networks or tables that an algorithm learns, each with a name. Target networks and the state of the optimiser
/// are not included.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LearnedShapes {
    /// The policy.
    pub policy: (&'static str, Shape),
    /// All other networks or tables.
    pub others: Vec<(&'static str, Shape)>,
}

impl LearnedShapes {
    /// All of them, the policy first.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, Shape)> {
        std::iter::once(self.policy).chain(self.others.iter().copied())
    }

    /// The same, with a policy that normalises its observations or not.
    pub fn normalising(mut self, normalised: bool) -> Self {
        if let (_, Shape::Network(policy)) = &mut self.policy {
            *policy = policy.normalising(normalised);
        }
        self
    }

    /// The number of parameters in all of them.
    pub fn parameters(&self) -> usize {
        self.iter().map(|(_, shape)| shape.parameters()).sum()
    }
}

/// The shape of a network or table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// A network.
    Network(NetworkLayout),
    /// A number for each state and action.
    Table {
        /// Number of states.
        states: usize,
        /// Number of actions.
        actions: usize,
    },
}

impl Shape {
    /// The number of parameters.
    pub fn parameters(&self) -> usize {
        match self {
            Self::Network(network) => network.parameters(),
            Self::Table { states, actions } => states * actions,
        }
    }
}

/// The text of a shape in the identity of a run (`config/identity.rs`). It must not change.
impl Display for Shape {
    fn fmt(&self, to: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Network(network) => {
                let Hidden { layers, activation } = network.hidden();
                write!(to, "network {}", network.inputs())?;
                layers.iter().try_for_each(|units| write!(to, " {units}"))?;
                write!(to, " {}", network.outputs())?;
                match (network.action_inputs(), network.action_layer()) {
                    (0, _) | (_, None) => {}
                    (late, Some(0)) if layers.len() > 1 => write!(to, " joined {late}")?,
                    (late, Some(_)) => write!(to, " late {late}")?,
                }
                // Not named, as in runs from before there was a choice.
                if activation == Activation::Tanh {
                    write!(to, " tanh")?;
                }
                if network.normalises() {
                    write!(to, " normalised")?;
                }
                Ok(())
            }
            Self::Table { states, actions } => write!(to, "table {states} {actions}"),
        }
    }
}
