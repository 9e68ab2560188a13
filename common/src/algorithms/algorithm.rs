//! The interface of an algorithm for code that does not depend on a particular one.

use std::fmt::{self, Display, Formatter};

use shoal_base::section::OutOfRange;
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;
use shoal_policy::network::{Activation, Hidden, NetworkLayout};

use super::behaviour::Behaviour;
use super::preparation::Preparation;

/// The fixed properties of an algorithm, which do not depend on its settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AlgorithmSpec {
    /// Its name, which is also the name of its section.
    pub name: &'static str,
    /// Whether it can learn from transitions of older policies. If not, it runs in lockstep only.
    pub off_policy: bool,
    /// How it uses transitions.
    pub experience: Experience,
}

/// How an algorithm uses the transitions that it learns from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Experience {
    /// In minibatches drawn at random from the replay, each transition many times.
    Minibatches,
    /// Each transition once, in order.
    Transitions,
    /// In whole episodes, each transition once. A chunk is an episode.
    Episodes,
}

/// The settings of an algorithm: its section of the configuration, and everything derived from it.
pub trait AlgorithmSettings {
    /// Checks every number. `section` is the section's name.
    ///
    /// # Errors
    /// For the first invalid number.
    fn check(&self, section: &str) -> Result<(), OutOfRange>;

    /// γ, the discount of one step.
    fn gamma(&self) -> f64;

    /// How observations and rewards are prepared for its networks; `None` if it learns from them as they are.
    fn preparation(&self) -> Option<&Preparation>;

    /// As [`preparation`](Self::preparation).
    fn preparation_mut(&mut self) -> Option<&mut Preparation>;

    /// Its policy in an environment like `spec`, for at most `batch` observations a call, and how actors explore with
    /// it. `name` is the name of the algorithm.
    ///
    /// # Errors
    /// When it cannot control that environment.
    fn behaviour(&self, name: &'static str, spec: &EnvironmentSpec, batch: usize) -> Result<Behaviour, PolicyError>;

    /// Numbers of exploration state that one environment keeps from step to step; 0 if the steps are independent.
    fn exploration_state_width(&self, spec: &EnvironmentSpec) -> usize;

    /// The smallest capacity of the replay, in transitions: a minibatch, or 1.
    fn least_capacity(&self) -> u64;

    /// The networks or tables that it learns in an environment like `spec`.
    fn learned(&self, spec: &EnvironmentSpec) -> Learned;
}

/// The networks or tables that an algorithm learns, each with a name. Target networks and the state of the optimiser
/// are not included.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Learned {
    /// The policy.
    pub policy: (&'static str, Shape),
    /// All other networks or tables.
    pub others: Vec<(&'static str, Shape)>,
}

impl Learned {
    /// All of them, the policy first.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, Shape)> {
        std::iter::once(self.policy).chain(self.others.iter().copied())
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
                match (network.late_inputs(), network.late_layer()) {
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
