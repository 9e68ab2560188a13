//! The learner: its networks ([`networks`]), the replay ([`replay`]), the learning methods ([`algorithms`]) and the
//! process that runs them ([`process`]). Each of these modules imports only from those named before it.

pub mod algorithms;
pub mod networks;
pub mod process;
pub mod replay;
