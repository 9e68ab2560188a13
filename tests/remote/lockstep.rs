//! Lockstep runs that other hosts join.

use std::time::Duration;

use rustix::process::Signal;
use shoal_common::config::Config;

use crate::hosts::{Host, Run, stop, wait_for_actors};
use crate::support::{QUICK, Workplace, check_stored_rows, error_line, final_result, until, wait_for_rows};

/// The weights and evaluations of a lockstep run with three actors, of which another host takes over two, if `joined`.
fn lockstep(joined: bool) -> (serde_json::Value, Vec<String>) {
    let place = Workplace::new();
    let train = [
        "train",
        "pendulum",
        "--run",
        "run",
        "--lockstep",
        "--actors",
        "3",
        "--steps",
        "6000",
    ];
    let more = ["--listen", "tcp/127.0.0.1:0", "--set", "checkpoint.every_updates=500"];
    let running = place.launch("run", &[&train[..], &more, &QUICK].concat());
    let run = Run { place, running };
    if joined {
        let host = Host::join(&run, &["--actors", "2"]);
        wait_for_actors(&run, &[1, 2]);
        for (at_host, role) in [
            (true, "actor-1"),
            (true, "relay-0"),
            (false, "gate-0"),
            (true, "env-server-2"),
            (false, "learner-0"),
        ] {
            let running = if at_host { &host.running } else { &run.running };
            running.kill_if_alive(role);
            wait_for_rows(&run.running, 96);
        }
        // It gives its actors back, and another one takes one of them over.
        host.running.signal(Signal::TERM);
        host.ends_with(128 + 15);
        wait_for_rows(&run.running, 96);
        let host = Host::join(&run, &["--actors", "1"]);
        let too_many = run.place.output(&["join", &run.endpoint(), "--actors", "3"]);
        assert!(error_line(&too_many).contains("this lockstep run has 3 actors, of which other hosts have 1"));
        let result = final_result(run.running);
        host.ends_with(0);
        return result;
    }
    final_result(run.running)
}

#[test]
fn a_lockstep_run_has_the_same_bits_wherever_its_actors_are() {
    let (here, elsewhere) = (lockstep(false), lockstep(true));
    assert!(here.0.is_string());
    assert_eq!(here, elsewhere);
}

#[test]
fn in_lockstep_a_stopped_actor_of_another_host_is_waited_for() {
    let run = Run::start(&["--lockstep", "--actors", "2", "--set", "run.stall_seconds=6"]);
    let host = Host::join(&run, &["--actors", "1"]);
    wait_for_actors(&run, &[0, 1]);
    host.running.stop_role("actor-1");
    std::thread::sleep(Duration::from_secs(12));
    host.running.continue_role("actor-1");
    wait_for_actors(&run, &[0, 1]);
    let log = run.running.log();
    assert!(!log.contains("makes no progress"), "{log}");
    stop(run);
    host.ends_with(0);
}

/// In lockstep, the learner's host takes the actors of a silent host back, so their incarnations are newer when that host
/// returns.
#[test]
fn a_host_that_comes_back_too_late_joins_again() {
    let run = Run::start(&["--lockstep", "--actors", "3", "--set", "remote.lost_seconds=5"]);
    // It has more than half of them, so it must not be refused because of those that it is giving back.
    let host = Host::join(&run, &["--actors", "2"]);
    wait_for_actors(&run, &[1, 2]);
    host.running.stop_role("relay-0");
    until("the host has lost its actors", || run.hosts().is_empty());
    wait_for_rows(&run.running, 96);
    // An earlier `join` has left this.
    std::fs::create_dir(host.place.path().join("host-2")).unwrap();
    host.running.continue_role("relay-0");
    until("the host has joined again", || {
        host.place.path().join("host-3").exists()
    });
    until("it is shown", || {
        run.hosts().first().is_some_and(|host| host["state"] == "connected")
    });
    wait_for_actors(&run, &[0, 1, 2]);
    assert!(host.place.stderr().contains("joining again"), "{}", host.place.stderr());
    wait_for_rows(&run.running, 1_100);
    let path = stop(run);
    host.ends_with(0);
    check_stored_rows(&path, &Config::load(&path.join("config.toml")).unwrap());
}
