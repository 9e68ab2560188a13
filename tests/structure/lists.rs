//! The lists of algorithms that no declaration in Rust can make complete. The message names the missing line.

use shoal_common::config::AlgorithmConfig;

use crate::root;

fn text(file: &str) -> String {
    std::fs::read_to_string(root().join(file)).unwrap()
}

#[test]
fn every_algorithm_is_in_the_lists_outside_rust() {
    for algorithm in AlgorithmConfig::all() {
        let name = algorithm.name();
        for (file, line) in [
            // How the Python package reads its policies: its line in `ALGORITHMS`.
            ("python/shoal/policy.py", format!("\n    \"{name}\": lambda ")),
            // A run of it in `numpy_policies_act_as_those_of_the_program`, which tests that line.
            ("tests/python/main.rs", format!("\n        (\"{name}\", ")),
            // What it is for, and its name on the command line.
            ("docs/METHODS.md", format!("`{name}`")),
        ] {
            assert!(
                text(file).contains(&line),
                "{file} has no line for {name}, with {line:?}"
            );
        }
    }
}
