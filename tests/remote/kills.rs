//! Processes of the hosts, or whole hosts, are killed or stopped while the run continues.

use std::time::{Duration, Instant};

use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rustix::process::Signal;
use shoal_common::config::Config;
use shoal_common::stream::Stream;

use crate::hosts::{Host, Run, in_replay, stop, wait_for_actors};
use crate::support::{check_stored_rows, error_line, until, wait_for_rows};

#[test]
fn what_a_host_sent_before_it_left_outlives_the_learner() {
    for (actors, setting) in [([1, 2], "actors.max=16"), ([256, 257], "actors.max=258")] {
        let run = Run::start(&["--actors", "1", "--set", setting]);
        let host = Host::join(&run, &["--actors", "2"]);
        wait_for_actors(&run, &actors);
        let path = run.running.run.clone();
        run.running.stop_role("learner-0");
        until("chunks are forwarded and not committed", || {
            host.sent(&actors) > in_replay(&path, &actors)
        });
        host.running.signal(Signal::TERM);
        until("the host has left", || run.hosts().is_empty());
        // Another one takes its actors before the learner has committed what the first one sent.
        let second = (setting != "actors.max=16").then(|| Host::join(&run, &["--actors", "2"]));
        let sent = host.sent(&actors);
        assert!(sent > in_replay(&path, &actors));
        host.ends_with(128 + 15);
        run.running.kill("learner-0");
        match second {
            None => until("all of it is in the replay", || in_replay(&path, &actors) == sent),
            Some(second) => {
                wait_for_actors(&run, &actors);
                let path = stop(run);
                let sent = sent + second.sent(&actors);
                second.ends_with(0);
                assert_eq!(in_replay(&path, &actors), sent);
                continue;
            }
        }
        stop(run);
    }
}

#[test]
fn actors_that_share_a_service_lose_no_row_when_gate_and_learner_are_killed() {
    // The learner's host can have the first 256 of them.
    let run = Run::start(&[
        "--actors",
        "1",
        "--set",
        "actors.max=260",
        "--set",
        "replay.updates_per_step=0.2",
        "--set",
        "replay.capacity=500000",
    ]);
    let host = Host::join(&run, &["--actors", "3"]);
    let actors = [256, 257, 258];
    wait_for_actors(&run, &actors);
    for _ in 0..4 {
        run.running.kill("gate-0");
        wait_for_actors(&run, &actors);
        run.running.kill("learner-0");
        wait_for_actors(&run, &actors);
        host.running.kill("relay-0");
        wait_for_actors(&run, &actors);
    }
    // There is one left that shares the service, so the second has one of its own.
    let second = Host::join(&run, &["--actors", "2"]);
    wait_for_actors(&run, &[0, 1, 256, 257, 258, 259]);
    let path = stop(run);
    let sent = host.sent(&actors) + second.sent(&[1, 259]);
    host.ends_with(0);
    second.ends_with(0);
    assert_eq!(in_replay(&path, &[1, 256, 257, 258, 259]), sent);
}

/// Two hosts join a run. Roles of all three hosts are killed, or stopped for a while, at random for this long. Every row
/// that the actors of the two have sent must be committed once. These actors are spared: one that is killed may take a
/// chunk with it that it has not logged.
fn chaos(length: Duration, seed: u64) {
    let run = Run::start(&[
        "--actors",
        "1",
        "--set",
        "replay.updates_per_step=0.2",
        "--set",
        "replay.capacity=500000",
    ]);
    let hosts = [(); 2].map(|()| Host::join(&run, &["--actors", "2"]));
    let actors = [[1, 2], [3, 4]];
    let at_learner = ["gate-0", "learner-0", "evaluator-0", "actor-0", "env-server-0"];
    let at_hosts = [
        ["relay-0", "env-server-1", "env-server-2"],
        ["relay-0", "env-server-3", "env-server-4"],
    ];
    let mut rng = Stream::seed_from_u64(seed);
    let (begun, mut events) = (Instant::now(), 0);
    while begun.elapsed() < length || events < 20 {
        std::thread::sleep(Duration::from_millis(rng.random_range(50..600)));
        let (running, roles) = match rng.random_range(0..4) {
            0 | 1 => (&run.running, &at_learner[..]),
            host => (&hosts[host - 2].running, &at_hosts[host - 2][..]),
        };
        let role = roles.choose(&mut rng).unwrap();
        if rng.random_bool(0.15) {
            running.pause_if_alive(role, Duration::from_millis(rng.random_range(100..3000)));
        } else {
            running.kill_if_alive(role);
        }
        events += 1;
    }
    wait_for_actors(&run, &actors.concat());
    let path = stop(run);
    for (host, actors) in hosts.into_iter().zip(actors) {
        let sent = host.sent(&actors);
        host.ends_with(0);
        assert!(sent > 0);
        assert_eq!(in_replay(&path, &actors), sent, "after {events} kills and pauses");
    }
    check_stored_rows(&path, &Config::load(&path.join("config.toml")).unwrap());
}

#[test]
fn three_hosts_under_chaos_lose_and_repeat_no_row() {
    chaos(Duration::from_secs(12), 3);
}

#[test]
#[ignore = "takes ten minutes"]
fn three_hosts_under_ten_minutes_of_chaos_lose_and_repeat_no_row() {
    for seed in 0..5 {
        chaos(Duration::from_secs(120), seed);
    }
}

#[test]
fn actors_are_replaced_and_lose_at_most_what_they_have_not_sent() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "1"]);
    let mut kills = 0;
    for pause in [0, 120, 40, 300, 10, 200] {
        wait_for_actors(&run, &[1]);
        std::thread::sleep(Duration::from_millis(pause));
        host.running.kill("actor-1");
        kills += 1;
        let successor = || host.running.pids("actor-1").len() == kills + 1;
        until("the actor is replaced", successor);
    }
    wait_for_actors(&run, &[1]);
    let chunk = 8;
    let path = stop(run);
    let sent = host.sent(&[1]);
    host.ends_with(0);
    let committed = in_replay(&path, &[1]);
    // It may be killed between sending a chunk and logging that.
    assert!(
        (sent..=sent + chunk * kills as u64).contains(&committed),
        "{sent} rows sent, {committed} committed"
    );
}

#[test]
fn a_stopped_gate_or_relay_delays_only_its_hosts() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "1"]);
    wait_for_actors(&run, &[1]);
    host.running.stop_role("relay-0");
    until("the host is shown as cut off", || run.hosts()[0]["state"] == "cut-off");
    // The others go on.
    wait_for_rows(&run.running, 100);
    host.running.continue_role("relay-0");
    wait_for_actors(&run, &[1]);
    until("the host is shown as connected", || {
        run.hosts()[0]["state"] == "connected"
    });
    run.running.stop_role("gate-0");
    std::thread::sleep(Duration::from_secs(4));
    wait_for_rows(&run.running, 100);
    run.running.continue_role("gate-0");
    wait_for_actors(&run, &[1]);
    let path = stop(run);
    let sent = host.sent(&[1]);
    host.ends_with(0);
    assert_eq!(in_replay(&path, &[1]), sent);
}

#[test]
fn the_actors_of_a_host_that_vanishes_are_free_although_the_gate_dies_again_and_again() {
    let run = Run::start(&["--actors", "1", "--set", "remote.lost_seconds=5"]);
    let host = Host::join(&run, &["--actors", "2"]);
    wait_for_actors(&run, &[1, 2]);
    host.running.kill_all();
    until("the host has lost its actors", || {
        run.running.kill_if_alive("gate-0");
        std::thread::sleep(Duration::from_secs(2));
        run.running.log().contains("its actors are free")
    });
    stop(run);
}

#[test]
fn the_actors_of_a_host_that_vanishes_are_free_after_a_while() {
    let run = Run::start(&[
        "--actors",
        "1",
        "--set",
        "actors.max=3",
        "--set",
        "remote.lost_seconds=6",
    ]);
    let host = Host::join(&run, &["--actors", "2", "--name", "vanishing"]);
    wait_for_actors(&run, &[1, 2]);
    host.running.kill_all();
    until("the host is shown as cut off", || run.hosts()[0]["state"] == "cut-off");
    // Its actors are still its own.
    let refused = run.place.output(&["join", &run.endpoint(), "--actors", "2"]);
    assert!(error_line(&refused).contains("0 are free"), "{}", error_line(&refused));
    until("the host has lost its actors", || run.hosts().is_empty());
    assert!(run.running.log().contains("host vanishing was silent for 6 s"));
    let host = Host::join(&run, &["--actors", "2", "--name", "next"]);
    wait_for_actors(&run, &[1, 2]);
    let path = stop(run);
    host.ends_with(0);
    let records = std::fs::read_to_string(path.join("hosts.csv")).unwrap();
    let has = |name: &str, state: &str| records.lines().any(|row| row.contains(&format!(",{name},{state},")));
    assert!(
        has("vanishing", "connected") && has("vanishing", "cut-off") && has("vanishing", "gone"),
        "{records}"
    );
    assert!(has("next", "connected"), "{records}");
}
