//! Gymnasium environments, served from Python. Without the Python package shoal-gym these tests are ignored, or fail if
//! `SHOAL_REQUIRE_PYTHON` is set.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod answers;
#[path = "../support/suite.rs"]
mod suite;
#[path = "../support/mod.rs"]
mod support;

use std::path::Path;
use std::process::{Command, ExitCode, Stdio};
use std::time::Duration;

use answers::random_wrong_answers_are_survived_or_one_line_names_the_culprit;
use rustix::process::{Pid, Signal, kill_process};
use shoal_common::config::Config;
use shoal_common::numbers::are_finite;
use shoal_common::space::Space;
use shoal_learner::replay::{Replay, ReplayLayout};
use suite::{PYTHON, test};
use support::{Leftovers, QUICK, Workplace, error_line, final_result, output_of, parse, until, wait_for_rows};

fn main() -> ExitCode {
    suite::run(vec![
        test!(the_package_passes_its_own_tests, PYTHON),
        test!(a_gymnasium_pendulum_is_trained_while_its_servers_are_killed, PYTHON),
        test!(environments_receive_seeds_and_lockstep_runs_are_repeatable, PYTHON),
        test!(a_resumed_lockstep_run_begins_other_episodes, PYTHON),
        test!(termination_and_truncation_are_distinguished, PYTHON),
        test!(episodes_that_never_end_are_named, PYTHON),
        test!(a_lockstep_run_begins_another_episode_after_an_invalid_answer, PYTHON),
        test!(discrete_spaces_with_an_offset_are_learned_by_a_table, PYTHON),
        test!(a_failing_environment_ends_the_run_with_its_last_output, PYTHON),
        test!(
            an_unsupported_environment_is_refused_in_one_line_and_leaves_no_run,
            PYTHON
        ),
        test!(servers_end_with_their_launcher_and_the_run_can_be_resumed, PYTHON),
        test!(bench_gym_compares_with_gymnasiums_own_vectors, PYTHON),
        test!(a_child_process_of_an_environment_blocks_nothing, PYTHON),
        test!(
            an_environments_output_takes_bounded_memory_and_cannot_control_the_terminal,
            PYTHON
        ),
        test!(a_stuck_server_ends_with_its_launcher, PYTHON),
        test!(the_status_of_a_run_that_starts_says_so, PYTHON),
        test!(a_killed_start_leaves_no_process_and_no_file, PYTHON),
        test!(a_server_that_ignores_requests_is_replaced, PYTHON),
        test!(an_invalid_answer_ends_its_episodes_and_is_counted_and_named, PYTHON),
        test!(too_many_invalid_answers_end_a_run_that_can_be_resumed, PYTHON),
        test!(
            each_kind_of_wrong_answer_is_survived_or_one_line_names_the_server,
            PYTHON
        ),
        test!(random_wrong_answers_are_survived_or_one_line_names_the_culprit, PYTHON),
        test!(
            an_evaluator_killed_while_it_confirms_a_policy_repeats_nothing_it_reported,
            PYTHON
        ),
        test!(a_module_sees_no_arguments_and_no_input_and_prints_to_the_log, PYTHON),
        test!(a_slow_environment_is_not_replaced, PYTHON),
        test!(a_run_remembers_where_its_server_is_started_and_with_what, PYTHON),
        test!(a_run_with_another_program_may_lie_at_any_path, PYTHON),
        test!(a_failure_in_the_final_evaluation_costs_an_episode_or_a_line, PYTHON),
        test!(a_signal_ends_the_final_evaluation_in_order, PYTHON),
        test!(a_signal_ends_shoal_eval_in_order, PYTHON),
        test!(a_server_that_was_stopped_continues, PYTHON),
        test!(frames_are_filmed_and_played_in_the_report, PYTHON),
        test!(an_environment_without_frames_says_why, PYTHON),
    ])
}

/// Prefix of the environments of `shoal_test_environments.py`.
const OURS: &str = "gym:shoal_test_environments:";

/// A directory in which `python3` finds the environments of the tests.
fn place() -> Workplace {
    let place = Workplace::new();
    let module = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/gym/shoal_test_environments.py");
    // Python finds modules in its working directory.
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
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && !message.contains("Ran 0 tests"), "{message}");
}

fn a_gymnasium_pendulum_is_trained_while_its_servers_are_killed() {
    let place = place();
    // Long enough for two kills, because a process that is killed while the run ends is not replaced.
    let steps = ["--steps", "20000"];
    let running = place.start_in("run", "gym:Pendulum-v1", &[&SHORT[..], &steps].concat());
    for who in ["env-server-0", "env-server-16"] {
        running.wait_for_learning();
        running.kill(who);
        until("it is replaced", || running.pids(who).len() >= 2);
    }
    running.wait_for_learning();
    let (code, printed, leftovers) = running.wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    assert_eq!(parse(&printed)["env_steps"], 20000);

    let spec = config(&place).spec;
    assert_eq!(spec.observation, Space::boxed(&[(-1.0, 1.0), (-1.0, 1.0), (-8.0, 8.0)]));
    assert_eq!(spec.action, Space::boxed(&[(-2.0, 2.0)]));
    assert_eq!((spec.time_limit, spec.state_width), (200, 0));

    let evaluated = || place.output(&["eval", "run", "--episodes", "3", "--json"]);
    let (first, second) = (evaluated(), evaluated());
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    assert_eq!(first.stdout, second.stdout, "evaluation episodes have the same starts");
    let output = place.output(&["report", "run", "--out", "page.html"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    assert!(page.contains("\"terminated\":false"), "the report has episodes");
}

fn environments_receive_seeds_and_lockstep_runs_are_repeatable() {
    let place = place();
    let environment = format!("{OURS}Ends-v0");
    let weights = |name: &str, seed: &str| {
        let arguments = ["--lockstep", "--steps", "400", "--seed", seed];
        final_result(place.start_in(name, &environment, &[&SHORT[..], &arguments].concat()))
    };
    let first = weights("run", "1");
    assert_eq!(weights("again", "1"), first);
    assert_ne!(weights("other", "2"), first);
    let spec = config(&place).spec;
    assert_eq!((spec.observation.width(), spec.action.width()), (4, 2), "flattened");
}

fn a_resumed_lockstep_run_begins_other_episodes() {
    let place = place();
    let steps = ["--lockstep", "--steps", "200", "--set", "environment.after=0"];
    let running = place.start_in("run", &format!("{OURS}Ends-v0"), &[&SHORT[..], &steps].concat());
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
    let output = place.output(&["resume", "run", "--steps", "400"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // Every episode has five steps, and the same reward in each, which depends on its seed.
    let mut episodes = csv::Reader::from_path(place.path().join("run/episodes.csv")).unwrap();
    let column = episodes
        .headers()
        .unwrap()
        .iter()
        .position(|name| name == "return")
        .unwrap();
    let mut returns: Vec<String> = episodes.records().map(|row| row.unwrap()[column].to_owned()).collect();
    let count = returns.len();
    assert!(count > 50, "{count} episodes");
    returns.sort();
    returns.dedup();
    assert_eq!(returns.len(), count, "some episodes came twice");
}

fn episodes_that_never_end_are_named() {
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

fn a_lockstep_run_begins_another_episode_after_an_invalid_answer() {
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

fn termination_and_truncation_are_distinguished() {
    let place = place();
    for (after, steps, terminated) in [("3", "3", "1"), ("0", "5", "0"), ("5", "5", "1")] {
        let name = format!("after-{after}");
        let after = format!("environment.after={after}");
        let arguments = ["--steps", "300", "--set", &after];
        let running = place.start_in(&name, &format!("{OURS}Ends-v0"), &[&SHORT[..], &arguments].concat());
        let episodes = running.run.join("episodes.csv");
        assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
        let mut episodes = csv::Reader::from_path(episodes).unwrap();
        let rows: Vec<_> = episodes.records().map(Result::unwrap).collect();
        assert!(rows.len() > 20);
        for row in rows {
            assert_eq!((&row[4], &row[5]), (steps, terminated), "{row:?}");
        }
    }
}

fn discrete_spaces_with_an_offset_are_learned_by_a_table() {
    let place = place();
    let arguments = ["--steps", "3000", "--set", "q-learning.epsilon=0.5"];
    let plain = ["train", &format!("{OURS}Offset-v0"), "--run", "run", "--json"];
    let output = place.output(&[&plain[..], &arguments].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let spec = config(&place).spec;
    assert_eq!(
        (spec.observation, spec.action),
        (Space::Discrete { n: 4, start: 5 }, Space::Discrete { n: 3, start: -1 })
    );
    assert_eq!(
        support::json(&output)["eval_return_mean"],
        3.0,
        "the policy reaches the end"
    );
}

fn a_failing_environment_ends_the_run_with_its_last_output() {
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

fn an_unsupported_environment_is_refused_in_one_line_and_leaves_no_run() {
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
        let message = error_line(&place.output(&[&["train"], &arguments[..]].concat()));
        assert!(message.contains(part), "{arguments:?}: {message}");
        assert!(!place.path().join("runs").exists(), "{arguments:?}");
    }
}

/// The arguments of a run whose environment fails in the final evaluation. No other evaluation is due.
fn with_a_finale(how: &str) -> Vec<&str> {
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
    assert_eq!(code, Some(0), "{}", place_of_one.stderr());
    assert!(place_of_one.path().join("final").exists(), "it has failed once");
    assert!(found(&place_of_one) && parse(&printed)["eval_episodes"] == 3);

    let place = place();
    let running = place.start_in("run", &environment, &with_a_finale("environment.how=always"));
    let (code, printed, leftovers) = running.wait();
    let said = place.stderr();
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
    for (signal, code) in [(Signal::TERM, 143), (Signal::INT, 130)] {
        let place = place();
        let environment = format!("{OURS}Finale-v0");
        let train = ["train", &environment, "--run", "run", "--json"];
        // Not `start_in`: so short a run may end before its evaluator was ready.
        let mut running = place
            .shoal(&[&train[..], &with_a_finale("environment.how=sleeps"), &QUICK].concat())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        until("the final evaluation is asleep", || place.path().join("final").exists());
        assert_eq!(place.status("run")["waiting"], "final evaluation");
        let refused = error_line(&place.output(&["stop", "run"]));
        assert!(refused.contains("its final evaluation is under way"), "{refused}");
        kill_process(Pid::from_child(&running), signal).unwrap();
        until("it has ended", || running.try_wait().unwrap().is_some());
        let output = running.wait_with_output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{said}");
        assert_eq!(support::json(&output)["env_steps"], 200);
        let leftovers = Leftovers::of(&place.path().join("run"));
        assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
        assert!(processes_of(&place, "shoal_gym").is_empty());
        let outcome = outcome_of(&place);
        assert_eq!(outcome["state"], "finished");
        let why = format!("signal {}", code - 128);
        assert!(outcome["reason"].to_string().contains(&why), "{outcome}");
        assert!(place.path().join("run/checkpoints/best.policy").exists());
    }
}

fn a_signal_ends_shoal_eval_in_order() {
    for (signal, code) in [(Signal::TERM, 143), (Signal::INT, 130)] {
        let place = place();
        let environment = format!("{OURS}Sleeps-v0");
        let arguments = [&SHORT[..], &["--steps", "200"]].concat();
        let (trained, _, leftovers) = place.start_in("run", &environment, &arguments).wait();
        assert_eq!(trained, Some(0), "{}", place.stderr());
        std::fs::write(place.path().join("sleep"), "").unwrap();
        let temporary = place.path().join("temporary");
        std::fs::create_dir(&temporary).unwrap();
        let mut evaluation = place
            .shoal(&["eval", "run", "--json"])
            .env("TMPDIR", &temporary)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        until("it is asleep", || place.path().join("asleep").exists());
        kill_process(Pid::from_child(&evaluation), signal).unwrap();
        until("it has ended", || evaluation.try_wait().unwrap().is_some());
        let output = evaluation.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(code));
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(said.lines().count() == 1 && said.contains("signal"), "{said}");
        assert!(output.stdout.is_empty());
        assert!(processes_of(&place, "shoal_gym").is_empty(), "its server has ended");
        assert_eq!(
            std::fs::read_dir(&temporary).unwrap().count(),
            0,
            "nothing of it is left"
        );
        assert!(leftovers.files().is_empty());
    }
}

/// Trains an environment of the tests for a moment.
fn trained(place: &Workplace, environment: &str, more: &[&str]) {
    let arguments = [&SHORT[..], &["--steps", "200"], more].concat();
    let (code, _, _) = place
        .start_in("run", &format!("{OURS}{environment}"), &arguments)
        .wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
}

/// The heights of the column in the pictures of a film of `Draws`, and how long each is seen.
fn columns(gif: &[u8]) -> Vec<(usize, u16)> {
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(gif).unwrap();
    let (width, height) = (usize::from(decoder.width()), usize::from(decoder.height()));
    assert_eq!((width, height), (60, 40));
    let mut canvas = vec![[0; 4]; width * height];
    let mut seen = Vec::new();
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        let [left, top, w] = [frame.left, frame.top, frame.width].map(usize::from);
        for (i, pixel) in frame
            .buffer
            .chunks_exact(4)
            .enumerate()
            .filter(|(_, pixel)| pixel[3] > 0)
        {
            canvas[(top + i / w) * width + left + i % w].copy_from_slice(pixel);
        }
        let red = canvas.iter().filter(|pixel| pixel[..3] == [200, 0, 0]).count();
        seen.push((red / 10, frame.delay));
    }
    seen
}

fn frames_are_filmed_and_played_in_the_report() {
    let place = place();
    let film = place.path().join("run/film.gif");
    trained(&place, "Draws-v0", &["--set", "environment.dies=once"]);
    let output = place.output(&["film", "run", "--episodes", "2"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stdout).ends_with("run/film.gif\n"));
    assert!(place.path().join("died").exists(), "a server was killed in an episode");
    let episode = [(6, 10), (12, 10), (18, 10), (24, 10), (30, 10), (36, 60)];
    let seen = columns(&std::fs::read(&film).unwrap());
    assert_eq!(
        seen,
        [episode, episode].concat(),
        "each state, five steps and the last one"
    );

    let output = place.output(&["film", "run", "--fps", "50", "--out", "fast.gif"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let seen = columns(&std::fs::read(place.path().join("fast.gif")).unwrap());
    assert_eq!(seen.iter().map(|(_, delay)| delay).sum::<u16>(), 5 * 2 + 60);

    let output = place.output(&["report", "run", "--out", "page.html"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    assert_eq!(
        page.matches("\"data:image/jpeg;base64,").count(),
        2 * 6,
        "two episodes of six states"
    );
    assert!(processes_of(&place, "shoal_gym").is_empty());
}

fn an_environment_without_frames_says_why() {
    let place = place();
    trained(&place, "Ends-v0", &[]);
    let message = error_line(&place.output(&["film", "run"]));
    assert!(
        message.contains("Ends-v0 cannot be filmed") && message.contains("render_mode"),
        "{message}"
    );
    assert!(!place.path().join("run/film.gif").exists() && !place.path().join("run/film.gif.new").exists());
    let output = place.output(&["report", "run", "--out", "page.html"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    assert!(page.contains("This environment cannot be shown:") && page.contains("\"why_not\":null"));

    // A server that dies in every film.
    let place = self::place();
    trained(&place, "Draws-v0", &["--set", "environment.dies=always"]);
    let message = error_line(&place.output(&["film", "run"]));
    assert!(message.contains("the episode was begun 5 times"), "{message}");
    assert!(!place.path().join("run/film.gif").exists() && !place.path().join("run/film.gif.new").exists());
}

fn servers_end_with_their_launcher_and_the_run_can_be_resumed() {
    let place = place();
    let endless = ["--steps", "100000000"];
    let running = place.start_in("run", "gym:Pendulum-v1", &[&SHORT[..], &endless].concat());
    running.wait_for_learning();
    running.signal(Signal::KILL);
    until("no process is left", || running.leftovers().processes().is_empty());
    let resumed = place.resume("run", &[]);
    resumed.wait_for_learning();
    assert!(place.output(&["stop", "run"]).status.success());
    let (code, _, leftovers) = resumed.wait();
    assert_eq!(code, Some(0));
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
}

fn bench_gym_compares_with_gymnasiums_own_vectors() {
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

/// Processes with `words` in their command line and the test's directory as working directory.
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

fn a_server_that_was_stopped_continues() {
    let place = place();
    // With so many updates, the server waits for requests most of the time.
    let slow = ["--steps", "100000000", "--set", "replay.updates_per_step=20"];
    let running = place.start_in("run", "gym:Pendulum-v1", &slow);
    running.wait_for_learning();
    let servers = processes_of(&place, "shoal_gym");
    assert!(servers.len() >= 2, "the actor's and the evaluator's");
    for _ in 0..20 {
        for signal in [Signal::STOP, Signal::CONT] {
            for pid in &servers {
                kill_process(Pid::from_raw(*pid).unwrap(), signal).unwrap();
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }
    running.wait_for_learning();
    assert_eq!(processes_of(&place, "shoal_gym"), servers);
    assert!(place.output(&["stop", "run"]).status.success());
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
}

fn a_child_process_of_an_environment_blocks_nothing() {
    let place = place();
    for alone in ["false", "true"] {
        let run = format!("run-{alone}");
        let alone = format!("environment.alone={alone}");
        let arguments = [&SHORT[..], &["--steps", "100000000", "--set", &alone]].concat();
        let running = place.start_in(&run, &format!("{OURS}Parent-v0"), &arguments);
        running.wait_for_learning();
        running.kill("env-server-0");
        until("it is replaced", || running.pids("env-server-0").len() >= 2);
        running.wait_for_learning();
        assert!(place.output(&["stop", &run]).status.success());
        assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
        let left = processes_of(&place, "sleep 54321");
        if alone.ends_with("false") {
            assert_eq!(left, [] as [i32; 0], "the server's process group ends with it");
        }
        for pid in left {
            kill_process(Pid::from_raw(pid).unwrap(), Signal::KILL).unwrap();
        }
    }
}

fn an_environments_output_takes_bounded_memory_and_cannot_control_the_terminal() {
    let place = place();
    let flood = [&SHORT[..], &["--steps", "100000000", "--set", "environment.how=flood"]].concat();
    let running = place.start_in("flood", &format!("{OURS}Talks-v0"), &flood);
    // A megabyte per step, in total more than the launcher's memory may grow to.
    wait_for_rows(&running, 400);
    let status = std::fs::read_to_string(format!("/proc/{}/status", running.launcher())).unwrap();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    let kilobytes: u64 = peak.trim().trim_end_matches(" kB").parse().unwrap();
    assert!(kilobytes < 300_000, "the launcher had {kilobytes} kB");
    running.signal(Signal::TERM);
    assert_eq!(running.wait().0, Some(143), "{}", place.stderr());
    let log = std::fs::metadata(place.path().join("flood/shoal.log")).unwrap().len();
    assert!(log < 20_000_000, "{log} bytes of log");

    let escapes = [&SHORT[..], &["--steps", "300", "--set", "environment.how=escapes"]].concat();
    let running = place.start_in("escapes", &format!("{OURS}Talks-v0"), &escapes);
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
    let log = std::fs::read_to_string(place.path().join("escapes/shoal.log")).unwrap();
    assert!(log.contains("owned") && !log.contains('\x1b') && !log.contains('\x07'));
}

fn a_stuck_server_ends_with_its_launcher() {
    let place = place();
    let arguments = [&SHORT[..], &["--steps", "100000000"]].concat();
    let running = place.start_in("run", &format!("{OURS}Sleeps-v0"), &arguments);
    running.wait_for_learning();
    std::fs::write(place.path().join("sleep"), "").unwrap();
    until("a server is asleep in a step", || place.path().join("asleep").exists());
    running.signal(Signal::KILL);
    until("no process is left", || {
        running.leftovers().processes().is_empty() && processes_of(&place, "shoal_gym").is_empty()
    });
}

/// The next launcher waits for the processes of the one before it, here for a stuck server, and answers no questions
/// yet.
fn the_status_of_a_run_that_starts_says_so() {
    let place = place();
    let arguments = [&SHORT[..], &["--steps", "100000000"]].concat();
    let running = place.start_in("run", &format!("{OURS}Sleeps-v0"), &arguments);
    running.wait_for_learning();
    std::fs::write(place.path().join("sleep"), "").unwrap();
    until("a server is asleep in a step", || place.path().join("asleep").exists());
    running.signal(Signal::KILL);
    std::fs::remove_file(place.path().join("sleep")).unwrap();
    let mut resume = place.shoal(&["resume", "run", "--quiet"]).spawn().unwrap();
    until("the status says that the run starts", || {
        let status = place.output(&["status", "run", "--json"]);
        status.status.code() == Some(0) && support::json(&status)["waiting"] == "starting"
    });
    until("its learner works", || {
        let roles = place.status("run")["roles"].clone();
        roles.as_array().unwrap().iter().any(|role| role["role"] == "learner")
    });
    let stopped = place.output(&["stop", "run"]);
    assert!(stopped.status.success(), "{}", String::from_utf8_lossy(&stopped.stderr));
    until("the launcher has ended", || resume.try_wait().unwrap().is_some());
}

fn a_killed_start_leaves_no_process_and_no_file() {
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

fn a_server_that_ignores_requests_is_replaced() {
    let place = place();
    let server = "from shoal_test_environments import deaf_server; raise SystemExit(deaf_server())";
    let server = format!(
        "environment.server={}",
        serde_json::to_string(&["python3", "-c", server]).unwrap()
    );
    let arguments = ["--steps", "100000000", "--set", &server, "--set", "run.stall_seconds=3"];
    let running = place.start_in("run", "gym:Pendulum-v1", &[&SHORT[..], &arguments].concat());
    running.wait_for_learning();
    std::fs::write(place.path().join("deaf"), "").unwrap();
    until("the stall is logged", || running.log().contains("makes no progress"));
    until("the server is replaced", || running.pids("env-server-0").len() > 1);
    std::fs::remove_file(place.path().join("deaf")).unwrap();
    running.wait_for_learning();
    running.wait_for_learning();
    let log = running.log();
    assert!(
        log.contains("actor-0 makes no progress") && log.contains("env-server-0 makes no progress"),
        "{log}"
    );
    let incidents = std::fs::read_to_string(running.run.join("incidents.csv")).unwrap();
    assert!(incidents.contains("stalled"), "{incidents}");
}

fn a_slow_environment_is_not_replaced() {
    let place = place();
    let arguments = [&SHORT[..], &["--steps", "100000000", "--set", "run.stall_seconds=3"]].concat();
    let running = place.start_in("run", &format!("{OURS}Sleeps-v0"), &arguments);
    running.wait_for_learning();
    std::fs::write(place.path().join("sleep"), "").unwrap();
    // Longer than `run.stall_seconds`, but the server is busy.
    until("it is named", || {
        running.log().contains("s in one step or reset of its environments")
    });
    assert!(!running.log().contains("makes no progress"), "{}", running.log());
    let named = running.log().matches("env-server-0 has spent ").count();
    assert!(named <= 1, "{}", running.log());
}

fn an_invalid_answer_ends_its_episodes_and_is_counted_and_named() {
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

fn layout_of(place: &Workplace, run: &str) -> ReplayLayout {
    let config = Config::load(&place.path().join(run).join("config.toml")).unwrap();
    shoal_learner::process::replay_layout(&config)
}

fn too_many_invalid_answers_end_a_run_that_can_be_resumed() {
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

fn each_kind_of_wrong_answer_is_survived_or_one_line_names_the_server() {
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

/// `environment.server` as a function of `shoal_test_environments.py`, which is called with this Python expression.
fn server_of(function: &str, argument: &str) -> String {
    let program = format!("from shoal_test_environments import {function}; raise SystemExit({function}({argument}))");
    let program = serde_json::to_string(&["python3", "-c", &program]).unwrap();
    format!("environment.server={program}")
}

fn an_evaluator_killed_while_it_confirms_a_policy_repeats_nothing_it_reported() {
    let place = place();
    let server = server_of("holding_server", "2");
    let arguments = [
        "--lockstep",
        "--steps",
        "1000",
        "--envs",
        "2",
        "--set",
        "evaluation.every=200",
    ];
    let running = place.start_in(
        "run",
        &format!("{OURS}Grows-v0"),
        &[&arguments[..], &["--set", &server]].concat(),
    );
    until("a policy is being confirmed", || place.path().join("held").exists());
    running.kill("evaluator-0");
    std::fs::write(place.path().join("go"), "").unwrap();
    let run = running.run.clone();
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let mut evaluations = csv::Reader::from_path(run.join("evaluations.csv")).unwrap();
    let column = |name: &str, row: &csv::StringRecord, headers: &csv::StringRecord| {
        row[headers.iter().position(|header| header == name).unwrap()].to_owned()
    };
    let headers = evaluations.headers().unwrap().clone();
    let rows: Vec<_> = evaluations.records().map(Result::unwrap).collect();
    let periods: Vec<u64> = rows
        .iter()
        .map(|row| column("env_steps", row, &headers).parse::<u64>().unwrap() / 200)
        .collect();
    assert_eq!(periods, (0..=5).collect::<Vec<_>>(), "each period once");
    assert!(rows.iter().all(|row| column("best", row, &headers) == "1"), "{rows:?}");
}

fn a_module_sees_no_arguments_and_no_input_and_prints_to_the_log() {
    let place = place();
    let environment = "gym:shoal_test_arguments:Plain-v0";
    let module = "import sys, gymnasium\n\
        from shoal_test_environments import Talks\n\
        print('arguments', len(sys.argv), 'input', repr(sys.stdin.read()))\n\
        gymnasium.register('Plain-v0', entry_point=lambda: Talks(how='escapes'), max_episode_steps=5)\n";
    std::fs::write(place.path().join("shoal_test_arguments.py"), module).unwrap();
    let running = place.start_in("run", environment, &[&SHORT[..], &["--steps", "300"]].concat());
    let log = running.run.join("shoal.log");
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
    let log = std::fs::read_to_string(log).unwrap();
    assert!(log.contains("arguments 1 input ''"), "{log}");
}

fn a_run_remembers_where_its_server_is_started_and_with_what() {
    let place = place();
    let python = std::env::split_paths(&std::env::var_os("PATH").unwrap())
        .map(|directory| directory.join("python3"))
        .find(|python| python.is_file())
        .unwrap();
    // A virtual environment is found by the link's own place, so there must be one.
    let venv = python.parent().and_then(Path::parent).unwrap();
    std::os::unix::fs::symlink(venv, place.path().join("vënv")).unwrap();
    let name = format!("{OURS}Tells-v0");
    let arguments = [
        &[
            "train",
            &name,
            "--run",
            "run",
            "--lockstep",
            "--seed",
            "4294967303",
            "--steps",
            "300",
        ],
        &SHORT[..],
        &["--set", r#"environment.server=["./vënv/bin/python3","-m","shoal_gym"]"#],
        &[
            "--set",
            "environment.parameters.name=x",
            "--set",
            "environment.day=1979-05-27",
        ],
        &[
            "--set",
            "environment.limit=inf",
            "--set",
            "evaluation.envs=1",
            "--quiet",
        ],
    ]
    .concat();
    let output = place.output(&arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let elsewhere = |arguments: &[&str]| {
        let mut command = place.shoal(arguments);
        command.current_dir("/").env_remove("PATH");
        support::output_of(&mut command)
    };
    let run = place.path().join("run").display().to_string();
    for arguments in [
        vec!["eval", &run, "--episodes", "2", "--json"],
        vec!["resume", &run, "--steps", "400", "--quiet"],
    ] {
        let output = elsewhere(&arguments);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    let told = std::fs::read_to_string(place.path().join("told")).unwrap();
    let threads = std::env::var("OMP_NUM_THREADS").unwrap_or_else(|_| "1".into());
    let expected = format!("7 {threads} [('day', '1979-05-27'), ('limit', inf), ('name', 'x')]");
    assert!(
        told.lines().count() > 6 && told.lines().all(|line| line == expected),
        "{told}"
    );

    std::fs::remove_file(place.path().join("vënv")).unwrap();
    let log = std::fs::read_to_string(place.path().join("run/shoal.log")).unwrap();
    for arguments in [vec!["eval", &run], vec!["resume", &run, "--steps", "500"]] {
        let said = error_line(&elsewhere(&arguments));
        assert!(
            said.contains("vënv/bin/python3") && said.contains("server.json"),
            "{said}"
        );
    }
    let after = std::fs::read_to_string(place.path().join("run/shoal.log")).unwrap();
    assert_eq!(after, log, "nothing was started");
}

fn a_run_with_another_program_may_lie_at_any_path() {
    let place = place();
    let long = format!("{}/{}", "a long name ".repeat(20), "实验 ü|?*".repeat(10));
    let arguments = [&SHORT[..], &["--steps", "300"]].concat();
    let running = place.start_in(&long, "gym:Pendulum-v1", &arguments);
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let output = place.output(&["eval", &long, "--episodes", "2", "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
