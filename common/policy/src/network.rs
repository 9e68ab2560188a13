//! The networks' shape, stated once for every process: where each weight lies in a flat parameter slice, and the forward
//! pass that reads the slice in place, be it the learner's own memory or a sample in shared memory.
//!
//! Every network has 1 to 8 hidden layers of ReLU or tanh units and a linear output. Its parameters are, with two of them,
//!
//! ```text
//! [ W1 | b1 | W2 | b2 | W3 | b3 ]        each W column-major, outputs × inputs
//! ```
//!
//! *Late inputs* enter at the second hidden layer: they are the last columns of W2. A critic takes its action there
//! (thesis, section 4.3.1); a policy has none. Where there is one hidden layer they enter at that one, as the last columns of
//! W1: at the output layer a critic would be linear in the action, and the best action the same in every state.
//! A batch of vectors is a column-major matrix, one vector after the other.

mod acting;
mod forward;
mod hidden;
mod layout;
mod policy;

pub use acting::Network;
pub use forward::{Activations, Layer, matrix, matrix_mut};
pub use hidden::{Activation, Hidden, Layers, LayersError};
pub use layout::{LayerRange, NetworkLayout};
pub use policy::{ActionRange, ActionRangeError, PolicyNetwork};
