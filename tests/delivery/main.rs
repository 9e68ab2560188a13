//! Delivery between real processes, any of which may be killed: chunks, policies, environment steps, and the leftovers
//! of a run in shared memory. "Delivery of chunks" in `docs/DESIGN.md` has the promises. The child processes run this
//! test binary.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a failure anywhere in here is a failed test"
)]

mod actors;
mod children;
mod chunks;
mod environments;
mod leftovers;
mod policies;
mod process;
mod run;
mod transitions;

#[test]
#[ignore = "a child process of the other tests"]
fn child() {
    children::main();
}
