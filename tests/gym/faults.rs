//! Environments that fail, and servers with invalid answers.

use shoal_common::config::Config;
use shoal_common::numbers::are_finite;
use shoal_learner::replay::Replay;

use crate::helpers::{OURS, SHORT, layout_of, place, server_of};
use crate::support::error_line;

pub(crate) fn episodes_that_never_end_are_named() {
    let place = place();
    let server = server_of("endless_server", "");
    for run in ["free", "lockstep"] {
        let mode = format!("run.mode={run}");
        let environment = format!("{OURS}Ends-v0");
        let arguments = [
            &["train", &environment, "--run", run, "--steps", "20000", "--set", &mode],
            &SHORT[..],
            &["--set", "environment.faults=3", "--set", &server],
        ]
        .concat();
        let message = error_line(&place.output(&arguments));
        assert!(
            message.contains("environment.faults is 3") && message.contains("environment 0 goes on after 5 steps"),
            "{message}"
        );
    }
}

pub(crate) fn a_lockstep_run_begins_another_episode_after_an_invalid_answer() {
    let place = place();
    let server = server_of("spoilt_server", "");
    let few = ["--lockstep", "--steps", "400", "--set", "environment.faults=5"];
    let arguments = [&SHORT[..], &few, &["--set", &server]].concat();
    let running = place.start_in("run", &format!("{OURS}Ends-v0"), &arguments);
    let incidents = running.run.join("incidents.csv");
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
    let incidents = std::fs::read_to_string(incidents).unwrap();
    assert!(incidents.contains(",fault,"), "{incidents}");
}

pub(crate) fn a_failing_environment_ends_the_run_with_its_last_output() {
    let place = place();
    for (how, word) in [("raise", "the motor is on fire"), ("abort", "killed by signal 6")] {
        let run = format!("run-{how}");
        let how = format!("environment.how={how}");
        let environment = format!("{OURS}Fails-v0");
        let plain = ["train", &environment, "--run", &run, "--steps", "1000"];
        let output = place.output(&[&plain[..], &["--set", &how, "--set", "run.give_up_seconds=1"]].concat());
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{message}");
        let last = message.lines().last().unwrap_or_default();
        assert!(
            last.contains("env-server") && last.contains("times and is given up") && last.contains(word),
            "one line: {message}"
        );
    }
}

pub(crate) fn an_invalid_answer_ends_its_episodes_and_is_counted_and_named() {
    let place = place();
    for (what, words) in [
        ("nan-reward", "a reward that is nan"),
        ("none-reward", "a reward that is None"),
        ("nan-observation", "number 1 is nan"),
        ("shape", "shape (1,)"),
        ("terminated", "terminated that is 2"),
    ] {
        let how = format!("environment.what={what}");
        let arguments = [&SHORT[..], &["--steps", "2000", "--set", &how]].concat();
        let running = place.start_in(what, &format!("{OURS}Invalid-v0"), &arguments);
        let run = running.run.clone();
        assert_eq!(running.wait().0, Some(0), "{what}: {}", place.stderr());
        let incidents = std::fs::read_to_string(run.join("incidents.csv")).unwrap();
        let fault = incidents.lines().find(|line| line.contains(",fault,"));
        let fault = fault.unwrap_or_else(|| panic!("{what}: {incidents}"));
        assert!(
            fault.contains("env-server")
                && fault.contains(words)
                && fault.contains("Invalid-v0")
                && fault.contains("episode"),
            "{fault}"
        );
        let replay = Replay::open(&run.join("replay.bin"), &layout_of(&place, what)).unwrap();
        assert!(replay.rows().all(|row| are_finite(replay.row(row))), "{what}");
    }
}

pub(crate) fn too_many_invalid_answers_end_a_run_that_can_be_resumed() {
    let place = place();
    let environment = format!("{OURS}Invalid-v0");
    let always = ["--set", "environment.what=shape", "--set", "environment.always=true"];
    let few = [
        "--steps",
        "2000",
        "--set",
        "environment.faults=7",
        "--set",
        "replay.warmup=64",
    ];
    let command = [&["train", &environment, "--run", "run"][..], &SHORT, &always, &few].concat();
    let output = place.output(&command);
    assert_eq!(output.status.code(), Some(1));
    let said = error_line(&output);
    assert!(
        said.contains("environment.faults is 7") && said.contains("shape (1,)") && said.contains("env-server"),
        "{said}"
    );
    // Its environment is mended.
    std::fs::write(place.path().join("mended"), "").unwrap();
    let resumed = place.resume("run", &[]);
    assert_eq!(resumed.wait().0, Some(0), "{}", place.stderr());
}

pub(crate) fn each_kind_of_wrong_answer_is_survived_or_one_line_names_the_server() {
    let place = place();
    for how in ["nan", "flags", "short", "long", "twice", "status", "huge"] {
        let server =
            format!("from shoal_test_environments import hostile_server; raise SystemExit(hostile_server({how:?}))");
        let server = serde_json::to_string(&["python3", "-c", &server]).unwrap();
        let server = format!("environment.server={server}");
        let few = ["--steps", "600", "--set", "environment.faults=20", "--set", &server];
        let output = place.output(&[&["train", "gym:Pendulum-v1", "--run", how][..], &SHORT, &few].concat());
        let said = String::from_utf8_lossy(&output.stderr);
        match output.status.code() {
            Some(0) => {}
            Some(1) => assert!(
                said.contains("error: ") && (said.contains("env-server") || said.contains("environment server")),
                "{how}: {said}"
            ),
            code => panic!("{how}: {code:?}: {said}"),
        }
        if let Ok(config) = Config::load(&place.path().join(how).join("config.toml")) {
            let layout = shoal_learner::process::replay_layout(&config);
            let replay = Replay::open(&place.path().join(how).join("replay.bin"), &layout).unwrap();
            assert!(replay.rows().all(|row| are_finite(replay.row(row))), "{how}");
        }
    }
}
