//! Delivery between real processes, any of which may be killed: chunks, policies, steps of environments, and what a run
//! leaves in shared memory. The promises are those of `ARCHITECTURE.md`; the children are this binary again.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a failure anywhere in here is a failed test"
)]

mod actors;
mod children;
mod chunks;
mod environments;
mod policies;
mod process;
mod run;
mod traces;
mod transitions;

#[test]
#[ignore = "a child process of the other tests"]
fn child() {
    children::main();
}
