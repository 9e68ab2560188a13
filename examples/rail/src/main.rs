//! The environment server of `rail.rs`, a program that Shoal starts: see `rail.toml`.

mod rail;

use std::process::ExitCode;

fn main() -> ExitCode {
    shoal_env_server::serve(rail::Rail::new)
}
