//! Environments of Gymnasium, served from Python. Where `python3` lacks the package shoal-gym these tests are ignored; with
//! `SHOAL_REQUIRE_PYTHON` set they fail.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

#[path = "../support/suite.rs"]
mod suite;
#[path = "../support/mod.rs"]
mod support;

use std::path::Path;
use std::process::{Command, ExitCode};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use shoal_common::config::Config;
use shoal_common::space::Space;
use suite::{PYTHON, test};
use support::{Workplace, comes_further, complaint, end_of, output_of, parse, until};

fn main() -> ExitCode {
    suite::run(vec![
        test!(the_package_passes_its_own_tests, PYTHON),
        test!(gymnasiums_pendulum_is_trained_while_its_servers_are_killed, PYTHON),
        test!(seeds_reach_the_environments_and_lockstep_gives_the_same_bits, PYTHON),
        test!(what_ends_by_itself_and_what_the_limit_ends_are_kept_apart, PYTHON),
        test!(discrete_spaces_are_counted_from_zero_and_learned_by_a_table, PYTHON),
        test!(
            an_environment_that_fails_is_a_dead_role_whose_last_words_are_shown,
            PYTHON
        ),
        test!(
            what_cannot_be_served_is_refused_in_one_line_before_anything_is_made,
            PYTHON
        ),
        test!(
            servers_end_with_their_launcher_and_the_run_goes_on_when_it_is_resumed,
            PYTHON
        ),
        test!(
            the_way_through_shared_memory_is_measured_beside_gymnasiums_own_vectors,
            PYTHON
        ),
        test!(a_process_that_an_environment_leaves_behind_holds_up_nobody, PYTHON),
        test!(
            what_an_environment_writes_costs_bounded_memory_and_commands_no_terminal,
            PYTHON
        ),
        test!(a_server_that_is_stuck_ends_with_its_launcher_all_the_same, PYTHON),
        test!(a_killed_probe_leaves_no_process_and_no_file, PYTHON),
        test!(a_server_that_lives_and_does_not_hear_is_replaced, PYTHON),
        test!(an_environment_that_takes_its_time_over_a_step_is_left_alone, PYTHON),
        test!(a_failure_in_the_final_evaluation_costs_an_episode_or_a_line, PYTHON),
        test!(a_signal_ends_the_final_evaluation_in_order, PYTHON),
    ])
}

/// A module with environments for the tests.
const OURS: &str = "gym:shoal_test_environments:";

/// A place where `python3` finds the environments of the tests.
fn place() -> Workplace {
    let place = Workplace::new();
    let module = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/gym/shoal_test_environments.py");
    // Python finds modules where it is started.
    std::fs::copy(module, place.path().join("shoal_test_environments.py")).unwrap();
    place
}

const SHORT: [&str; 4] = ["--set", "evaluation.every=1000", "--envs", "2"];

fn config(place: &Workplace) -> Config {
    Config::load(&place.path().join("run/config.toml")).unwrap()
}

fn the_package_passes_its_own_tests() {
    let mut tests = Command::new("python3");
    tests
        .args(["-B", "-m", "unittest", "discover", "-s", "tests"])
        .current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("python"));
    let output = output_of(&mut tests);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && !said.contains("Ran 0 tests"), "{said}");
}

fn gymnasiums_pendulum_is_trained_while_its_servers_are_killed() {
    let place = place();
    // Long enough for two kills: who is killed while the run ends has no successor.
    let steps = ["--steps", "20000"];
    let running = place.start_in("run", "gym:Pendulum-v1", &[&SHORT[..], &steps].concat());
    for who in ["env-server-0", "env-server-16"] {
        running.learns_on();
        running.kill(who);
        until("it is replaced", || running.pids(who).len() == 2);
    }
    running.learns_on();
    let (code, printed, leftovers) = running.wait();
    assert_eq!(code, Some(0), "{}", place.said());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    assert_eq!(parse(&printed)["env_steps"], 20000);

    let spec = config(&place).spec;
    assert_eq!(spec.observation, Space::boxed(&[(-1.0, 1.0), (-1.0, 1.0), (-8.0, 8.0)]));
    assert_eq!(spec.action, Space::boxed(&[(-2.0, 2.0)]));
    assert_eq!((spec.time_limit, spec.state_width), (200, 0));

    let evaluated = || place.output(&["eval", "run", "--episodes", "3", "--json"]);
    let (first, second) = (evaluated(), evaluated());
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    assert_eq!(first.stdout, second.stdout, "evaluation episodes start alike");
    let output = place.output(&["report", "run", "--out", "page.html"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    assert!(page.contains("\"terminated\":false"), "episodes are played");
}

fn seeds_reach_the_environments_and_lockstep_gives_the_same_bits() {
    let place = place();
    let environment = format!("{OURS}Ends-v0");
    let weights = |name: &str, seed: &str| {
        let arguments = ["--lockstep", "--steps", "400", "--seed", seed];
        end_of(place.start_in(name, &environment, &[&SHORT[..], &arguments].concat()))
    };
    let first = weights("run", "1");
    assert_eq!(weights("again", "1"), first);
    assert_ne!(weights("other", "2"), first);
    let spec = config(&place).spec;
    assert_eq!((spec.observation.width(), spec.action.width()), (4, 2), "flattened");
}

fn what_ends_by_itself_and_what_the_limit_ends_are_kept_apart() {
    let place = place();
    for (after, steps, terminated) in [("3", "3", "1"), ("0", "5", "0"), ("5", "5", "1")] {
        let name = format!("after-{after}");
        let after = format!("environment.after={after}");
        let arguments = ["--steps", "300", "--set", &after];
        let running = place.start_in(&name, &format!("{OURS}Ends-v0"), &[&SHORT[..], &arguments].concat());
        let episodes = running.run.join("episodes.csv");
        assert_eq!(running.wait().0, Some(0), "{}", place.said());
        let mut episodes = csv::Reader::from_path(episodes).unwrap();
        let rows: Vec<_> = episodes.records().map(Result::unwrap).collect();
        assert!(rows.len() > 20);
        for row in rows {
            assert_eq!((&row[4], &row[5]), (steps, terminated), "{row:?}");
        }
    }
}

fn discrete_spaces_are_counted_from_zero_and_learned_by_a_table() {
    let place = place();
    let arguments = ["--steps", "3000", "--set", "q-learning.epsilon=0.5"];
    let plain = ["train", &format!("{OURS}Offset-v0"), "--run", "run", "--json"];
    let output = place.output(&[&plain[..], &arguments].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let spec = config(&place).spec;
    assert_eq!(
        (spec.observation, spec.action),
        (Space::Discrete { n: 4, start: 1 }, Space::Discrete { n: 3, start: -1 })
    );
    assert_eq!(support::json(&output)["eval_return_mean"], 3.0, "it walks to the end");
}

fn an_environment_that_fails_is_a_dead_role_whose_last_words_are_shown() {
    let place = place();
    for (how, word) in [("raise", "the motor is on fire"), ("abort", "killed by signal 6")] {
        let run = format!("run-{how}");
        let how = format!("environment.how={how}");
        let environment = format!("{OURS}Fails-v0");
        let output = place.output(&["train", &environment, "--run", &run, "--steps", "1000", "--set", &how]);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(
            said.contains("env-server") && said.contains("times and is given up") && said.contains(word),
            "{said}"
        );
    }
}

fn what_cannot_be_served_is_refused_in_one_line_before_anything_is_made() {
    let place = place();
    let odd = format!("{OURS}Odd-v0");
    let endless = format!("{OURS}Endless-v0");
    let fails = format!("{OURS}Fails-v0");
    for (arguments, part) in [
        (vec!["gym:Nonsense-v9"], "Nonsense"),
        (vec![&odd], "only Box and Discrete can be served"),
        (vec![&endless], "environment.max_episode_steps=1000"),
        (vec![&fails], "how"),
        (vec!["gym:no_such_module:X-v0"], "no_such_module"),
        (
            vec!["gym:Pendulum-v1", "--set", r#"environment.server=["no-such-program"]"#],
            "cannot start the environment server no-such-program",
        ),
        (
            vec!["gym:Pendulum-v1", "--set", r#"environment.server=["true"]"#],
            "ended",
        ),
        (
            vec![
                "gym:Pendulum-v1",
                "--set",
                r#"environment.server=["python3","-S","-m","shoal_gym"]"#,
            ],
            "pip install ./python",
        ),
        (
            vec!["gym:CartPole-v1", "--set", "ddpg.gamma=0.9"],
            "ddpg cannot control",
        ),
    ] {
        let arguments: Vec<&str> = arguments.into_iter().collect();
        let said = complaint(&place.output(&[&["train"], &arguments[..]].concat()));
        assert!(said.contains(part), "{arguments:?}: {said}");
        assert!(!place.path().join("runs").exists(), "{arguments:?}");
    }
}

/// A run of an environment that fails in its final evaluation, and has no other one: an evaluation is not due before.
fn with_a_finale<'a>(how: &'a str) -> Vec<&'a str> {
    vec!["--steps", "200", "--set", "evaluation.every=1000000", "--set", how]
}

fn outcome_of(place: &Workplace) -> serde_json::Value {
    parse(&std::fs::read_to_string(place.path().join("run/outcome.json")).unwrap())
}

fn a_failure_in_the_final_evaluation_costs_an_episode_or_a_line() {
    let environment = format!("{OURS}Finale-v0");
    let found = |place: &Workplace| place.path().join("run/final-evaluation.json").exists();
    let place_of_one = place();
    let running = place_of_one.start_in("run", &environment, &with_a_finale("environment.how=once"));
    let (code, printed, _) = running.wait();
    assert_eq!(code, Some(0), "{}", place_of_one.said());
    assert!(place_of_one.path().join("final").exists(), "it has failed once");
    assert!(found(&place_of_one) && parse(&printed)["eval_episodes"] == 3);

    let place = place();
    let running = place.start_in("run", &environment, &with_a_finale("environment.how=always"));
    let (code, printed, leftovers) = running.wait();
    let said = place.said();
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("the final evaluation failed") && said.contains("the last act fails"),
        "{said}"
    );
    assert_eq!(parse(&printed)["env_steps"], 200);
    assert_eq!(parse(&printed)["eval_return_mean"], serde_json::Value::Null);
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    assert!(!found(&place) && outcome_of(&place)["state"] == "finished");
    let output = place.output(&["export", "run", "--format", "onnx"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn a_signal_ends_the_final_evaluation_in_order() {
    let place = place();
    let environment = format!("{OURS}Finale-v0");
    let running = place.start_in("run", &environment, &with_a_finale("environment.how=sleeps"));
    until("the final evaluation is asleep", || place.path().join("final").exists());
    running.signal(Signal::TERM);
    let (code, printed, leftovers) = running.wait();
    assert_eq!(code, Some(143), "{}", place.said());
    assert_eq!(parse(&printed)["env_steps"], 200);
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    assert!(processes_of(&place, "shoal_gym").is_empty());
    let outcome = outcome_of(&place);
    assert_eq!(outcome["state"], "finished");
    assert!(outcome["reason"].to_string().contains("signal 15"), "{outcome}");
    assert!(place.path().join("run/checkpoints/best.policy").exists());
}

fn servers_end_with_their_launcher_and_the_run_goes_on_when_it_is_resumed() {
    let place = place();
    let endless = ["--steps", "100000000"];
    let running = place.start_in("run", "gym:Pendulum-v1", &[&SHORT[..], &endless].concat());
    running.learns_on();
    running.signal(Signal::KILL);
    until("no process is left", || running.leftovers().processes().is_empty());
    let resumed = place.resume("run", &[]);
    resumed.learns_on();
    assert!(place.output(&["stop", "run"]).status.success());
    let (code, _, leftovers) = resumed.wait();
    assert_eq!(code, Some(0));
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
}

fn the_way_through_shared_memory_is_measured_beside_gymnasiums_own_vectors() {
    let place = place();
    let mut bench = place.shoal(&["bench", "gym", "--json"]);
    let output = support::output_of(bench.env("SHOAL_BENCH_SECONDS", "0.4"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let figures = support::json(&output);
    let number = |field: &str| figures[field].as_f64().unwrap();
    assert!(0.0 < number("round_trip_median_us"));
    assert!(number("round_trip_median_us") <= number("round_trip_p99_us"));
    for vector in ["", "sync_vector_", "async_vector_"] {
        assert!(number(&format!("{vector}steps_per_second")) > 0.0, "{figures}");
    }
}

/// Processes whose command line holds these words, and that were started in the place.
fn processes_of(place: &Workplace, words: &str) -> Vec<i32> {
    let here = place.path().canonicalize().unwrap();
    let listed = std::fs::read_dir("/proc").unwrap().flatten();
    let pids = listed.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    pids.filter(|pid| {
        let command = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let command = String::from_utf8_lossy(&command).replace('\0', " ");
        let directory = std::fs::read_link(format!("/proc/{pid}/cwd")).unwrap_or_default();
        command.contains(words) && directory == here
    })
    .collect()
}

fn a_process_that_an_environment_leaves_behind_holds_up_nobody() {
    let place = place();
    for alone in ["false", "true"] {
        let run = format!("run-{alone}");
        let alone = format!("environment.alone={alone}");
        let arguments = [&SHORT[..], &["--steps", "100000000", "--set", &alone]].concat();
        let running = place.start_in(&run, &format!("{OURS}Parent-v0"), &arguments);
        running.learns_on();
        running.kill("env-server-0");
        until("it is replaced", || running.pids("env-server-0").len() == 2);
        running.learns_on();
        assert!(place.output(&["stop", &run]).status.success());
        assert_eq!(running.wait().0, Some(0), "{}", place.said());
        let left = processes_of(&place, "sleep 54321");
        if alone.ends_with("false") {
            assert_eq!(left, [] as [i32; 0], "its process group ends with it");
        }
        for pid in left {
            kill_process(Pid::from_raw(pid).unwrap(), Signal::KILL).unwrap();
        }
    }
}

fn what_an_environment_writes_costs_bounded_memory_and_commands_no_terminal() {
    let place = place();
    let flood = [&SHORT[..], &["--steps", "100000000", "--set", "environment.how=flood"]].concat();
    let running = place.start_in("flood", &format!("{OURS}Talks-v0"), &flood);
    // A megabyte a step: more than the launcher may have.
    comes_further(&running, 400);
    let status = std::fs::read_to_string(format!("/proc/{}/status", running.launcher())).unwrap();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    let kilobytes: u64 = peak.trim().trim_end_matches(" kB").parse().unwrap();
    assert!(kilobytes < 300_000, "the launcher had {kilobytes} kB");
    running.signal(Signal::TERM);
    assert_eq!(running.wait().0, Some(143), "{}", place.said());
    let log = std::fs::metadata(place.path().join("flood/shoal.log")).unwrap().len();
    assert!(log < 20_000_000, "{log} bytes of log");

    let escapes = [&SHORT[..], &["--steps", "300", "--set", "environment.how=escapes"]].concat();
    let running = place.start_in("escapes", &format!("{OURS}Talks-v0"), &escapes);
    assert_eq!(running.wait().0, Some(0), "{}", place.said());
    let log = std::fs::read_to_string(place.path().join("escapes/shoal.log")).unwrap();
    assert!(log.contains("owned") && !log.contains('\x1b') && !log.contains('\x07'));
}

fn a_server_that_is_stuck_ends_with_its_launcher_all_the_same() {
    let place = place();
    let arguments = [&SHORT[..], &["--steps", "100000000"]].concat();
    let running = place.start_in("run", &format!("{OURS}Sleeps-v0"), &arguments);
    running.learns_on();
    std::fs::write(place.path().join("sleep"), "").unwrap();
    until("a server is asleep in a step", || place.path().join("asleep").exists());
    running.signal(Signal::KILL);
    until("no process is left", || {
        running.leftovers().processes().is_empty() && processes_of(&place, "shoal_gym").is_empty()
    });
}

fn a_killed_probe_leaves_no_process_and_no_file() {
    let place = place();
    let asleep = format!("{OURS}Sleeps-v0");
    let arguments = ["train", &asleep, "--set", "environment.from_the_start=true"];
    let mut probe = place.shoal(&arguments).env("TMPDIR", place.path()).spawn().unwrap();
    until("the server starts", || !processes_of(&place, "shoal_gym").is_empty());
    probe.kill().unwrap();
    probe.wait().unwrap();
    until("the server is gone", || processes_of(&place, "shoal_gym").is_empty());
    let mut left: Vec<_> = std::fs::read_dir(place.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name())
        .collect();
    left.retain(|name| name != "shoal_test_environments.py" && name != "__pycache__");
    assert!(left.is_empty(), "{left:?}");
}

fn a_server_that_lives_and_does_not_hear_is_replaced() {
    let place = place();
    let server = "from shoal_test_environments import deaf_server; raise SystemExit(deaf_server())";
    let server = format!(
        "environment.server={}",
        serde_json::to_string(&["python3", "-c", server]).unwrap()
    );
    let arguments = ["--steps", "100000000", "--set", &server, "--set", "run.stall_seconds=3"];
    let running = place.start_in("run", "gym:Pendulum-v1", &[&SHORT[..], &arguments].concat());
    running.learns_on();
    std::fs::write(place.path().join("deaf"), "").unwrap();
    until("it is named", || running.log().contains("makes no progress"));
    until("the server is replaced", || running.pids("env-server-0").len() > 1);
    std::fs::remove_file(place.path().join("deaf")).unwrap();
    running.learns_on();
    running.learns_on();
    let log = running.log();
    assert!(
        log.contains("actor-0 makes no progress") && log.contains("env-server-0 makes no progress"),
        "{log}"
    );
    let incidents = std::fs::read_to_string(running.run.join("incidents.csv")).unwrap();
    assert!(incidents.contains("stalled"), "{incidents}");
}

fn an_environment_that_takes_its_time_over_a_step_is_left_alone() {
    let place = place();
    let arguments = [&SHORT[..], &["--steps", "100000000", "--set", "run.stall_seconds=3"]].concat();
    let running = place.start_in("run", &format!("{OURS}Sleeps-v0"), &arguments);
    running.learns_on();
    std::fs::write(place.path().join("sleep"), "").unwrap();
    // Far longer than a stall, but it is no stall.
    std::thread::sleep(Duration::from_secs(12));
    assert!(!running.log().contains("makes no progress"), "{}", running.log());
}
