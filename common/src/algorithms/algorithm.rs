//! What an algorithm is to everyone who need not know which one it is.

use std::fmt::{self, Display, Formatter};

use shoal_base::section::OutOfRange;
use shoal_base::space::EnvironmentSpec;
use shoal_policy::PolicyError;
use shoal_policy::network::{Activation, Hidden, NetworkLayout};

use super::behaviour::Behaviour;

/// What an algorithm is, whatever its numbers are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AlgorithmSpec {
    /// Its name, which is its section's.
    pub name: &'static str,
    /// Whether it may learn from what an older policy did. Else it runs in lockstep only.
    pub off_policy: bool,
    /// How it takes the transitions.
    pub experience: Experience,
}

/// How an algorithm takes the transitions that it learns from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Experience {
    /// In minibatches drawn at random from the replay, again and again.
    Minibatches,
    /// Each once, in order.
    Transitions,
    /// In whole episodes, each once. A chunk is an episode.
    Episodes,
}

/// The settings of an algorithm: its section of the configuration, and what follows from it.
pub trait AlgorithmSettings {
    /// Whether every number makes sense; `section` is the section's name.
    ///
    /// # Errors
    /// For the first one that does not.
    fn check(&self, section: &str) -> Result<(), OutOfRange>;

    /// γ, the discount of one step.
    fn gamma(&self) -> f64;

    /// Its policy in an environment like `spec`, for at most `batch` observations a call, and how actors explore around it.
    /// `name` is the algorithm's.
    ///
    /// # Errors
    /// When it cannot control that environment.
    fn behaviour(&self, name: &'static str, spec: &EnvironmentSpec, batch: usize) -> Result<Behaviour, PolicyError>;

    /// Numbers that the exploration of one environment in `spec` carries from step to step; 0 where each step's is drawn anew.
    fn exploration_state_width(&self, spec: &EnvironmentSpec) -> usize;

    /// Transitions that the replay must be able to hold at least: a minibatch, or 1.
    fn least_capacity(&self) -> u64;

    /// What it learns in an environment like `spec`.
    fn learned(&self, spec: &EnvironmentSpec) -> Learned;
}

/// The networks or tables that an algorithm learns, each with a name and without target networks and what an optimiser
/// remembers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Learned {
    /// The policy.
    pub policy: (&'static str, Shape),
    /// All else.
    pub others: Vec<(&'static str, Shape)>,
}

impl Learned {
    /// All of them, the policy first.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, Shape)> {
        std::iter::once(self.policy).chain(self.others.iter().copied())
    }

    /// Numbers in all of them.
    pub fn parameters(&self) -> usize {
        self.iter().map(|(_, shape)| shape.parameters()).sum()
    }
}

/// The shape of something that is learned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// A network.
    Network(NetworkLayout),
    /// A number for each state and action.
    Table {
        /// How many states there are.
        states: usize,
        /// How many actions.
        actions: usize,
    },
}

impl Shape {
    /// How many numbers there are.
    pub fn parameters(&self) -> usize {
        match self {
            Self::Network(network) => network.parameters(),
            Self::Table { states, actions } => states * actions,
        }
    }
}

/// As it stands in the identity of a run (`config/identity.rs`): the words may not change.
impl Display for Shape {
    fn fmt(&self, to: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Network(network) => {
                let Hidden { layers, activation } = network.hidden();
                write!(to, "network {}", network.inputs())?;
                layers.iter().try_for_each(|units| write!(to, " {units}"))?;
                write!(to, " {}", network.outputs())?;
                match network.late_inputs() {
                    0 => {}
                    late => write!(to, " late {late}")?,
                }
                match activation {
                    // Of runs from before there were others.
                    Activation::Relu => Ok(()),
                    Activation::Tanh => write!(to, " tanh"),
                }
            }
            Self::Table { states, actions } => write!(to, "table {states} {actions}"),
        }
    }
}
