//! Completions in a real shell, the manual, and the explained configuration.

use std::process::Command;

use shoal_run::plan::preset_names;

use crate::support::{Workplace, error_line, output_of};

/// The completions that bash offers for the last of these words.
fn completions(place: &Workplace, words: &[&str]) -> String {
    let binary = std::path::Path::new(env!("CARGO_BIN_EXE_shoal"));
    let words: Vec<String> = words.iter().map(|word| format!("'{word}'")).collect();
    let script = format!(
        r#"eval "$(shoal completions bash)"
        COMP_WORDS=({}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); COMP_TYPE=9
        _clap_complete_shoal shoal "${{COMP_WORDS[COMP_CWORD]}}" ''
        printf '%s\n' "${{COMPREPLY[@]}}""#,
        words.join(" ")
    );
    let path = format!(
        "{}:{}",
        binary.parent().unwrap().display(),
        std::env::var("PATH").unwrap_or_default()
    );
    let mut bash = Command::new("bash");
    bash.args(["--norc", "-c", &script])
        .current_dir(place.path())
        .env("PATH", path);
    let output = output_of(&mut bash);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn bash_completes_commands_presets_files_and_keys() {
    let place = Workplace::new();
    std::fs::write(place.path().join("mine.toml"), "").unwrap();
    std::fs::write(place.path().join("mine.txt"), "").unwrap();
    assert_eq!(completions(&place, &["shoal", "expo"]).trim(), "export");
    let completed = completions(&place, &["shoal", "train", "pend"]);
    let presets: Vec<&str> = preset_names().filter(|name| name.starts_with("pend")).collect();
    assert_eq!(completed.split_whitespace().collect::<Vec<_>>(), presets);
    assert_eq!(completions(&place, &["shoal", "train", "mi"]).trim(), "mine.toml");
    let keys = completions(&place, &["shoal", "train", "pendulum", "--set", "ddpg.t"]);
    assert_eq!(keys.trim(), "ddpg.tau=");
    let forms = completions(&place, &["shoal", "export", "run", "--format", ""]);
    assert!(forms.contains("onnx") && forms.contains("safetensors"), "{forms}");
}

#[test]
fn completions_exist_for_every_shell() {
    let place = Workplace::new();
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let output = place.output(&["completions", shell]);
        let lines = String::from_utf8(output.stdout).unwrap();
        assert!(
            output.status.success() && lines.contains("SHOAL_COMPLETE"),
            "{shell}: {lines}"
        );
    }
    assert_eq!(place.output(&["completions", "tcsh"]).status.code(), Some(2));
}

#[test]
fn the_manual_has_a_page_for_every_command() {
    let place = Workplace::new();
    let page = String::from_utf8(place.output(&["man"]).stdout).unwrap();
    assert!(page.contains(".TH shoal 1") && page.contains("export"), "{page}");
    assert!(place.output(&["man", "--out", "man/man1"]).status.success());
    for command in [
        "train",
        "resume",
        "status",
        "top",
        "list",
        "export",
        "completions",
        "man",
    ] {
        let page = std::fs::read_to_string(place.path().join(format!("man/man1/shoal-{command}.1"))).unwrap();
        assert!(page.contains("DESCRIPTION"), "{page}");
    }
    assert!(
        !place.path().join("man/man1/shoal-learner.1").exists(),
        "users do not start roles"
    );
    std::fs::write(place.path().join("file"), "").unwrap();
    assert!(error_line(&place.output(&["man", "--out", "file"])).contains("cannot write the manual to file"));
}

#[test]
fn help_config_explains_the_configuration_without_training() {
    let place = Workplace::new();
    let explained = |arguments: &[&str]| {
        let output = place.output(&[&["train"], arguments, &["--help-config"]].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let all = explained(&[]);
    for part in [
        "[ddpg]",
        "[sarsa]",
        "of point-mass",
        "tau = 0.001",
        "equation 3.31",
        "800000 in point-mass-r1",
    ] {
        assert!(all.contains(part), "{part}: {all}");
    }
    let pendulum = explained(&["pendulum"]);
    assert!(
        pendulum.contains("start_speed = 2.0") && pendulum.contains("rad/s"),
        "{pendulum}"
    );
    assert!(
        !pendulum.contains("[sarsa]") && !pendulum.contains("friction"),
        "{pendulum}"
    );
    assert!(error_line(&place.output(&["train", "pendulums", "--help-config"])).contains("no preset `pendulums`"));
    assert_eq!(
        place.output(&["train"]).status.code(),
        Some(2),
        "a preset or file is required"
    );
    assert!(!place.path().join("runs").exists());
}
