//! `shoal rm`.

use crate::support::{Workplace, error_line, json};
use crate::terminal::Terminal;

#[test]
fn runs_are_removed_after_a_question_and_a_running_one_is_not() {
    let place = Workplace::new();
    for name in ["runs/one", "runs/two", "runs/three"] {
        place.train(&["pendulum", "--steps", "200", "--run", name]);
    }
    let exists = |name: &str| place.path().join(name).exists();

    let unasked = place.output(&["rm", "runs/one"]);
    let message = error_line(&unasked);
    assert!(
        message.contains("no terminal to ask on: add --yes") && unasked.status.code() == Some(2),
        "{message}"
    );
    for (answer, gone) in [("n\n", false), ("\n", false), ("y\n", true)] {
        let mut terminal = Terminal::start(&place, &["rm", "runs/one", "runs/two"], true);
        terminal.shows("Remove them? [y/N]");
        assert!(terminal.text().contains("MiB"), "{}", terminal.text());
        terminal.press(answer);
        assert_eq!(terminal.end(), Some(i32::from(!gone)), "{answer:?}");
        assert_eq!([exists("runs/one"), exists("runs/two")], [!gone; 2], "{answer:?}");
    }

    let running = place.start("runs/running", &["--steps", "100000000"]);
    let message = error_line(&place.output(&["rm", "--yes", "runs/three", "runs/running"]));
    assert!(message.contains("runs/running is running: end it first"), "{message}");
    assert!(exists("runs/three"), "nothing is removed if one of them cannot be");
    // A copy has no roles of its own.
    place.copy("runs/running", "runs/copy");
    let removed = place.output(&["rm", "--yes", "runs/copy"]);
    assert!(removed.status.success(), "{}", String::from_utf8_lossy(&removed.stderr));
    assert!(!exists("runs/copy"));
    running.wait_for_learning();
    assert!(place.output(&["stop", "runs/running"]).status.success());
    running.wait_for_launcher();
    assert!(
        place
            .output(&["rm", "--yes", "runs/three", "runs/running/../running"])
            .status
            .success()
    );
    assert!(!exists("runs/three") && !exists("runs/running"));
}

#[test]
fn a_suite_is_named_before_it_is_removed() {
    let place = Workplace::new();
    let suite = place.path().join("suite");
    std::fs::create_dir(&suite).unwrap();
    let trial = r#"{"name": "seed=1", "seed": 1, "set": []}"#;
    let written = format!(r#"{{"format": 1, "what": "pendulum", "arguments": [], "trials": [{trial}]}}"#);
    std::fs::write(suite.join("suite.json"), written).unwrap();
    // A start that was interrupted.
    std::fs::create_dir(suite.join("seed=1")).unwrap();
    std::fs::write(suite.join("seed=1/config.toml.new"), "").unwrap();
    let no_replays = error_line(&place.output(&["rm", "--replay", "--yes", "suite"]));
    assert!(no_replays.contains("suite has no runs, so"), "{no_replays}");
    let mut terminal = Terminal::start(&place, &["rm", "suite"], true);
    terminal.shows("Remove it? [y/N]");
    assert!(terminal.text().contains("the suite suite"), "{}", terminal.text());
    terminal.press("y\n");
    assert_eq!(terminal.end(), Some(0));
    assert!(!suite.exists());
}

#[test]
fn what_may_not_be_a_run_is_left_alone() {
    let place = Workplace::new();
    std::fs::create_dir(place.path().join("mine")).unwrap();
    std::fs::write(place.path().join("mine/thesis.txt"), "four months of work").unwrap();
    let message = error_line(&place.output(&["rm", "--yes", "mine"]));
    assert!(message.contains("mine is not a run directory"), "{message}");
    // The configuration of another program.
    std::fs::write(place.path().join("mine/config.toml"), "[server]\nport = 80\n").unwrap();
    let message = error_line(&place.output(&["rm", "--yes", "mine"]));
    assert!(message.contains("may not be a run, and is left as it is"), "{message}");
    assert!(place.path().join("mine/thesis.txt").exists());
}

#[test]
fn a_run_without_its_replay_can_be_used_but_not_resumed() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "200", "--run", "run"]);
    let removed = place.output(&["rm", "--replay", "--yes", "run"]);
    assert!(removed.status.success(), "{}", String::from_utf8_lossy(&removed.stderr));
    assert!(!place.path().join("run/replay.bin").exists());
    let message = error_line(&place.output(&["resume", "run", "--steps", "300"]));
    assert!(
        message.contains("cannot resume run: `shoal rm --replay` has removed its replay"),
        "{message}"
    );
    for arguments in [
        &["eval", "run", "--episodes", "2"][..],
        &["report", "run"],
        &["plot", "run"],
        &["export", "run", "--format", "onnx"],
    ] {
        let output = place.output(arguments);
        assert!(
            output.status.success(),
            "{arguments:?}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
    }
    assert_eq!(
        json(&place.output(&["list", ".", "--json"]))["runs"][0]["state"],
        "finished"
    );
    let message = error_line(&place.output(&["rm", "--replay", "--yes", "run"]));
    assert!(message.contains("run has no replay"), "{message}");
    assert!(place.output(&["rm", "--yes", "run"]).status.success());
    assert!(!place.path().join("run").exists());
}
