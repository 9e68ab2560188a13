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
//! *Late inputs* are the action of a critic; a policy has none. DDPG's enter at the second hidden layer, as the last
//! columns of W2 (thesis, section 4.3.1). With a single hidden layer they enter there, as the last columns of W1: at the
//! output layer a critic would be linear in the action, and the best action would be the same in every state. Those of
//! the other methods enter at the first layer: the network's input is (s, a).
//!
//! A batch of vectors is a column-major matrix, one vector after the other.

mod acting;
mod forward;
mod gaussian;
mod hidden;
mod layout;
mod normalise;
mod policy;

pub use acting::Network;
pub use forward::{Activations, Layer, matrix, matrix_mut};
pub use gaussian::{GaussianPolicy, LOG_STD_RANGE};
pub use hidden::{Activation, Hidden, Layers, LayersError};
pub use layout::{LayerRange, NetworkLayout};
pub use normalise::{CLIP, normalise};
pub use policy::{ActionRange, ActionRangeError, PolicyNetwork};
