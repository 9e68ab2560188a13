//! The learner: what it computes with ([`networks`]), what it learns from ([`replay`]), how it learns ([`algorithms`]), and
//! the process that does so ([`process`]). Each imports from those before it and from none after it.

pub mod algorithms;
pub mod networks;
pub mod process;
pub mod replay;
