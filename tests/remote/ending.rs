//! Hosts leave a run, or end with it.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::hosts::{Host, Run, ends_as_stopped, in_replay, stop, wait_for_actors};
use crate::support::{self, Workplace, error_line, output_of, pids, sent, until};

#[test]
fn a_host_that_is_ended_hands_over_what_it_has_and_frees_its_actors() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "2"]);
    wait_for_actors(&run, &[1, 2]);
    host.running.signal(Signal::TERM);
    until("the host has left", || run.hosts().is_empty());
    let sent = host.sent(&[1, 2]);
    host.ends_with(128 + 15);
    assert_eq!(in_replay(&run.running.run, &[1, 2]), sent);
    // Another host may have them, and continues their sequence numbers.
    let host = Host::join(&run, &["--actors", "2"]);
    wait_for_actors(&run, &[1, 2]);
    let path = stop(run);
    let more = host.sent(&[1, 2]);
    host.ends_with(0);
    assert_eq!(in_replay(&path, &[1, 2]), sent + more);
}

#[test]
fn hosts_end_with_a_run_whose_gate_dies_while_it_tells_them() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "1"]);
    wait_for_actors(&run, &[1]);
    // So that the gate has to wait.
    host.running.stop_role("relay-0");
    let actor = run.running.pids("actor-0")[0];
    let stop = run.place.shoal(&["stop", "run"]).spawn().unwrap();
    until("the actor has ended", || {
        !run.running.leftovers().processes().contains(&actor)
    });
    std::thread::sleep(Duration::from_millis(300));
    run.running.kill_if_alive("gate-0");
    until("there is another gate", || run.running.pids("gate-0").len() == 2);
    host.running.continue_role("relay-0");
    ends_as_stopped(run, stop);
    host.ends_with(0);
}

#[test]
fn a_host_whose_relay_has_just_died_hands_over_what_it_has() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "2"]);
    wait_for_actors(&run, &[1, 2]);
    // The launcher learns of the death and of the signal at the same time.
    host.running.signal(Signal::STOP);
    host.running.kill("relay-0");
    host.running.signal(Signal::TERM);
    host.running.signal(Signal::CONT);
    until("the host has left", || run.hosts().is_empty());
    let sent = host.sent(&[1, 2]);
    host.ends_with(128 + 15);
    assert_eq!(in_replay(&run.running.run, &[1, 2]), sent);
    stop(run);
}

#[test]
fn hosts_end_with_a_run_that_is_stopped_while_it_moves_to_new_shared_memory() {
    let run = Run::start(&["--actors", "2"]);
    let host = Host::join(&run, &["--actors", "1"]);
    wait_for_actors(&run, &[2]);
    // It does not end when asked to, so there is time for the request.
    run.running.stop_role("actor-1");
    run.running.kill_beyond_cleaning("actor-0");
    until("new shared memory is reported", || {
        run.running.log().contains("continues in new shared memory")
    });
    // The launcher learns of the request before the actors have ended.
    run.running.signal(Signal::STOP);
    let stop = run.place.shoal(&["stop", "run"]).spawn().unwrap();
    std::thread::sleep(Duration::from_millis(300));
    run.running.signal(Signal::CONT);
    ends_as_stopped(run, stop);
    host.ends_with(0);
}

#[test]
fn hosts_end_with_a_run_that_is_interrupted_while_it_moves_to_new_shared_memory() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "1"]);
    wait_for_actors(&run, &[1]);
    run.running.kill_beyond_cleaning("actor-0");
    until("new shared memory is reported", || {
        run.running.log().contains("continues in new shared memory")
    });
    run.running.signal(Signal::TERM);
    let Run { place, running } = run;
    assert_eq!(running.wait().0, Some(128 + 15), "{}", place.stderr());
    host.ends_with(0);
}

#[test]
fn hosts_end_with_a_run_that_ends_before_they_are_admitted_again() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "1"]);
    wait_for_actors(&run, &[1]);
    let endpoint = run.endpoint();
    host.running.stop_role("relay-0");
    run.running.signal(Signal::KILL);
    let Run { place, running } = run;
    running.wait_for_launcher();
    let running = place.resume("run", &["--listen", &endpoint]);
    let stop = place.shoal(&["stop", "run"]).spawn().unwrap();
    host.running.continue_role("relay-0");
    ends_as_stopped(Run { place, running }, stop);
    host.ends_with(0);
}

#[test]
fn a_host_whose_run_ends_before_it_has_begun_ends_with_it() {
    let run = Run::start(&["--actors", "1"]);
    let place = Workplace::new();
    let join = ["join", &run.endpoint(), "--actors", "1"];
    let mut host = place.shoal(&join).env("TMPDIR", place.path()).spawn().unwrap();
    until("it is admitted", || run.running.log().contains("is admitted"));
    kill_process(Pid::from_child(&host), Signal::STOP).unwrap();
    let stop = run.place.shoal(&["stop", "run"]).spawn().unwrap();
    until("the run is ending", || run.running.log().contains("ends the run"));
    kill_process(Pid::from_child(&host), Signal::CONT).unwrap();
    ends_as_stopped(run, stop);
    until("the host has ended", || host.try_wait().unwrap().is_some());
    assert_eq!(host.wait().unwrap().code(), Some(0));
}

#[test]
fn a_gate_that_cannot_be_started_at_the_end_does_not_keep_the_learner_from_saving() {
    let run = Run::start(&["--actors", "1"]);
    let _host = Host::join(&run, &["--actors", "1"]);
    wait_for_actors(&run, &[0, 1]);
    run.running.signal(Signal::STOP);
    run.running.kill("gate-0");
    let counter = run.running.run.join("incarnations");
    std::fs::remove_file(&counter).unwrap();
    std::fs::create_dir(&counter).unwrap();
    run.running.signal(Signal::TERM);
    run.running.signal(Signal::CONT);
    let Run { place, running } = run;
    let path = running.run.clone();
    assert_eq!(running.wait().0, Some(1), "{}", place.stderr());
    assert!(place.stderr().contains("incarnations"), "{}", place.stderr());
    assert_eq!(in_replay(&path, &[0]), sent(&path, 0));
    let saved = place.output(&["status", "run", "--json"]);
    let saved = support::parse(&String::from_utf8(saved.stdout).unwrap());
    assert_eq!(saved["env_steps"], in_replay(&path, &[0, 1]), "the learner has saved");
}

#[test]
fn hosts_end_with_a_run_whose_gate_has_just_died() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "1"]);
    wait_for_actors(&run, &[1]);
    // The launcher learns of the death and of the request at the same time.
    run.running.signal(Signal::STOP);
    run.running.kill_if_alive("gate-0");
    let stop = run.place.shoal(&["stop", "run"]).spawn().unwrap();
    std::thread::sleep(Duration::from_millis(300));
    run.running.signal(Signal::CONT);
    ends_as_stopped(run, stop);
    host.ends_with(0);
}

#[test]
fn a_host_that_cannot_work_gives_its_actors_back_and_its_name_is_shown_plainly() {
    let run = Run::start(&["--actors", "1", "--set", "actors.max=2"]);
    let endpoint = run.endpoint();
    std::fs::create_dir(run.place.path().join("taken")).unwrap();
    let failed = run
        .place
        .output(&["join", &endpoint, "--actors", "1", "--local", "taken"]);
    assert!(
        error_line(&failed).contains("exists already"),
        "{}",
        error_line(&failed)
    );
    // Sooner than after `remote.lost_seconds`.
    until("the host has left", || run.running.log().contains("has left"));
    let name = format!("node\u{1b}[31m-{}", "x".repeat(5000));
    let host = Host::join(&run, &["--actors", "1", "--name", &name]);
    wait_for_actors(&run, &[1]);
    until("the host is shown", || run.hosts().len() == 1);
    let shown = run.hosts()[0]["name"].as_str().unwrap().to_owned();
    assert!(shown.starts_with("node[31m-xx") && shown.len() == 64, "{shown}");
    stop(run);
    host.ends_with(0);
}

#[test]
fn a_host_that_ends_before_its_relay_runs_gives_its_actors_back() {
    let run = Run::start(&["--actors", "1"]);
    let (place, endpoint) = (Workplace::new(), run.endpoint());
    let join = ["join", &endpoint, "--actors", "1"];
    let all_have_left = || {
        let log = run.running.log();
        let count = |what| log.matches(what).count();
        count("is admitted with actors") == count("has left")
    };
    // It may not open as many files as its processes need.
    let mut limited = Command::new("sh");
    limited.args(["-c", "ulimit -n 300; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_shoal")]);
    limited.args(join).env("TMPDIR", place.path()).stdin(Stdio::null());
    let failed = output_of(&mut limited);
    let why = String::from_utf8_lossy(&failed.stderr);
    assert_eq!(failed.status.code(), Some(1));
    assert!(why.contains("open files in one process"), "{why}");
    assert!(run.running.log().contains("is admitted with actors"));
    // Sooner than after `remote.lost_seconds`.
    until("the host has left", all_have_left);
    // A signal comes before the answer of the run.
    run.running.signal(Signal::STOP);
    let mut ended = place.shoal(&join).env("TMPDIR", place.path()).spawn().unwrap();
    until("it receives signals", || {
        let status = std::fs::read_to_string(format!("/proc/{}/status", ended.id())).unwrap_or_default();
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:\t"));
        caught.is_some_and(|mask| u64::from_str_radix(mask, 16).unwrap() & 1 << (15 - 1) != 0)
    });
    std::thread::sleep(Duration::from_secs(1));
    kill_process(Pid::from_child(&ended), Signal::TERM).unwrap();
    run.running.signal(Signal::CONT);
    until("join has ended", || ended.try_wait().unwrap().is_some());
    assert_eq!(ended.wait().unwrap().code(), Some(128 + 15));
    until("the host has left", all_have_left);
    assert_eq!(std::fs::read_dir(place.path()).unwrap().count(), 0);
    stop(run);
}

#[test]
fn a_host_whose_run_ends_while_its_relay_starts_ends_too() {
    for _ in 0..10 {
        let run = Run::start(&["--actors", "1"]);
        let place = Workplace::new();
        let join = ["join", &run.endpoint(), "--actors", "1", "--local", "host"];
        let mut host = place.shoal(&join).stdin(Stdio::null()).spawn().unwrap();
        let log = || std::fs::read_to_string(place.path().join("host/shoal.log")).unwrap_or_default();
        let (mut relay, begun) = (None, Instant::now());
        while relay.is_none() && begun.elapsed() < Duration::from_secs(60) {
            let started = pids(&log()).into_iter().find(|(who, _)| who == "relay-0");
            relay = started.and_then(|(_, pid)| Pid::from_raw(pid));
            std::thread::sleep(Duration::from_millis(1));
        }
        let relay = relay.unwrap();
        kill_process(relay, Signal::STOP).unwrap();
        let is_ready = |line: &str| line.starts_with("relay-0 ") && line.contains("ready after");
        let is_late = log().lines().any(is_ready);
        if is_late {
            kill_process(relay, Signal::CONT).unwrap();
            stop(run);
        } else {
            stop(run);
            // Now nobody answers it.
            kill_process(relay, Signal::CONT).unwrap();
        }
        until("the host has ended", || host.try_wait().unwrap().is_some());
        assert_eq!(host.wait().unwrap().code(), Some(0));
        if !is_late {
            return;
        }
    }
    panic!("the relay was ready each time before it was stopped");
}
