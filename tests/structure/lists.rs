//! The lists that no declaration in Rust can make complete: of algorithms, commands, sections and presets. The message
//! names the missing line.

use std::process::Command;

use shoal_common::config::AlgorithmConfig;
use shoal_common::config::explanation::sections;
use shoal_run::plan::preset_names;

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

/// The commands that `shoal --help` lists.
fn commands() -> Vec<String> {
    let output = Command::new(env!("CARGO_BIN_EXE_shoal"))
        .arg("--help")
        .output()
        .unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    let lines = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    let lines = lines.take_while(|line| !line.is_empty());
    let names = lines.map(|line| line.split_whitespace().next().unwrap().to_owned());
    // `help` is clap's own.
    names.filter(|name| name != "help").collect()
}

#[test]
fn every_command_and_section_is_in_the_list_of_commands() {
    let list = text("docs/COMMANDS.md");
    let commands = commands();
    assert!(commands.len() > 10, "{commands:?}");
    for name in commands {
        assert!(
            list.contains(&format!("\nshoal {name}")),
            "docs/COMMANDS.md has no line `shoal {name} …`"
        );
        let mut rows = list.lines().filter(|line| line.starts_with("| `"));
        assert!(
            rows.any(|row| row.split('|').nth(1).unwrap().contains(&format!("`{name}`"))),
            "docs/COMMANDS.md has no row that says what `{name}` does"
        );
    }
    for section in sections() {
        let name = format!("`[{}]`", section.name);
        assert!(list.contains(&name), "docs/COMMANDS.md has no {name}");
    }
}

#[test]
fn every_task_with_a_preset_is_in_the_documents() {
    let documents = text("README.md") + &text("docs/COMMANDS.md");
    for preset in preset_names() {
        let algorithms = AlgorithmConfig::all().into_iter();
        let task = algorithms.filter_map(|it| preset.strip_suffix(it.name())?.strip_suffix('-').map(str::to_owned));
        let named = task.chain([preset.to_owned()]).map(|name| format!("`{name}`"));
        assert!(
            named.into_iter().any(|name| documents.contains(&name)),
            "neither README.md nor docs/COMMANDS.md names the preset {preset}"
        );
    }
}
