//! Remote actors. Each other host has a *relay*, which stands in for the learner: its actors send their chunks to it,
//! and read policy and commit record from it. The learner's host has a *gate*, which stands in for the remote actors.
//! The two speak over a network; no other role knows of it.
//!
//! A chunk is committed exactly once, whatever the network loses, repeats or reorders, and whichever process dies:
//! [`uncommitted`] is the sending half of the protocol, [`forwarding`] the receiving half, and [`wire`] the bytes
//! between them. These need no network. Gate and relay themselves are built with the feature `network`.

pub mod endpoint;
pub mod files;
pub mod forwarding;
pub mod rate_limiter;
pub mod uncommitted;
pub mod wire;

/// The message of a program without the network.
pub const NOT_BUILT: &str = "this program was built without remote actors: build it with `cargo build --release \
                             --features remote`";

#[cfg(feature = "network")]
pub mod gate;
#[cfg(feature = "network")]
pub mod join;
#[cfg(feature = "network")]
pub mod keys;
#[cfg(feature = "network")]
pub mod network;
#[cfg(feature = "network")]
pub mod refused;
#[cfg(feature = "network")]
pub mod relay;
#[cfg(feature = "network")]
mod requests;
