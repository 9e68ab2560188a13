//! The layout of networks for every process: where each weight lies in a flat parameter slice, and the forward pass,
//! which reads the slice in place, in the learner's own memory or in shared memory.
//!
//! Every network has 1 to 8 hidden layers of ReLU or tanh units and a linear output. With two hidden layers, its
//! parameters are
//!
//! ```text
//! [ W1 | b1 | W2 | b2 | W3 | b3 ]        each W column-major, outputs × inputs
//! ```
//!
//! A critic has *action inputs* besides its inputs, the observation; a policy has none. They enter at one layer, as the
//! last columns of its W. For DDPG that is the second hidden layer (thesis, section 4.3.1), or the only one: at the
//! output layer a critic would be linear in the action, and the best action would be the same in every state. For the
//! other algorithms it is the first layer: the network's input is (s, a).
//!
//! A batch of vectors is a column-major matrix, one vector after the other.

mod acting;
mod action_range;
mod deterministic;
mod forward;
mod gaussian;
mod hidden;
mod layout;
mod normalise;

pub use acting::Network;
pub use action_range::{ActionRange, ActionRangeError};
pub use deterministic::DeterministicPolicy;
pub use forward::{Activations, Layer, matrix, matrix_mut};
pub use gaussian::{GaussianPolicy, LOG_STD_RANGE};
pub use hidden::{Activation, Hidden, Layers, LayersError};
pub use layout::{LayerRange, NetworkLayout};
pub use normalise::{OBSERVATION_CLIP, normalise};
