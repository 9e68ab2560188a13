//! The processes of environment servers: how they are started, replaced and ended, and their output.

use std::path::Path;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};

use crate::helpers::{OURS, SHORT, place, processes_of};
use crate::support::{self, error_line, until, wait_for_rows};

pub(crate) fn servers_end_with_their_launcher_and_the_run_can_be_resumed() {
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

pub(crate) fn a_server_that_was_stopped_continues() {
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

pub(crate) fn a_child_process_of_an_environment_blocks_nothing() {
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

pub(crate) fn an_environments_output_takes_bounded_memory_and_cannot_control_the_terminal() {
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

pub(crate) fn a_stuck_server_ends_with_its_launcher() {
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
pub(crate) fn the_status_of_a_run_that_starts_says_so() {
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

pub(crate) fn a_killed_start_leaves_no_process_and_no_file() {
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

pub(crate) fn a_server_that_ignores_requests_is_replaced() {
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

pub(crate) fn a_slow_environment_is_not_replaced() {
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

pub(crate) fn a_module_sees_no_arguments_and_no_input_and_prints_to_the_log() {
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

pub(crate) fn a_run_remembers_where_its_server_is_started_and_with_what() {
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

pub(crate) fn a_run_with_another_program_may_lie_at_any_path() {
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
