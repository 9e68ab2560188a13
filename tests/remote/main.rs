//! Two hosts on one machine: a run that others may join, and hosts that join it. Processes of both are killed and
//! stopped at any moment. Everything that the actors of a living host have sent is in the replay, once.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

#[path = "../support/mod.rs"]
mod support;

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rustix::process::{Pid, Signal, kill_process};
use shoal_common::config::Config;
use shoal_common::stream::Stream;
use support::{
    Leftovers, QUICK, Running, Workplace, check_stored_rows, committed, error_line, final_result, output_of, pids,
    sent, until, wait_for_rows,
};

/// Steps that no test reaches.
const ENDLESS: &str = "100000000";

/// A learner's host and its run, which others may join.
struct Run {
    place: Workplace,
    running: Running,
}

impl Run {
    fn start(arguments: &[&str]) -> Self {
        let place = Workplace::logging_chunks();
        let listens = arguments.contains(&"--listen");
        let listen: &[&str] = if listens { &[] } else { &["--listen", "tcp/127.0.0.1:0"] };
        let train = ["train", "pendulum", "--run", "run", "--steps", ENDLESS];
        let running = place.launch("run", &[&train[..], listen, &QUICK, arguments].concat());
        Self { place, running }
    }

    fn endpoint(&self) -> String {
        let file = std::fs::read_to_string(self.running.run.join("join.toml")).unwrap();
        let table: toml::Table = file.parse().unwrap();
        table["endpoint"].as_str().unwrap().to_owned()
    }

    /// What `status` says of the other hosts.
    fn hosts(&self) -> Vec<serde_json::Value> {
        self.place.status("run")["hosts"].as_array().unwrap().clone()
    }
}

/// Another host, which has joined a run.
struct Host {
    place: Workplace,
    running: Running,
}

impl Host {
    /// Joins with these arguments, and waits until all roles of the host are ready.
    fn join(run: &Run, arguments: &[&str]) -> Self {
        let place = Workplace::logging_chunks();
        let endpoint = run.endpoint();
        let arguments = [&["join", &endpoint, "--local", "host"], arguments].concat();
        let running = place.launch_command("host", &mut place.shoal(&arguments));
        Self { place, running }
    }

    /// Rows that its actors have sent.
    fn sent(&self, actors: &[u32]) -> u64 {
        actors.iter().map(|actor| sent(&self.running.run, *actor)).sum()
    }

    /// Waits until the host has ended with this exit code and has left nothing.
    fn ends_with(self, code: i32) {
        let (ended, _, leftovers) = self.running.wait();
        assert_eq!(ended, Some(code), "{}", self.place.stderr());
        assert!(leftovers.processes().is_empty(), "{:?}", leftovers.processes());
        assert!(leftovers.files().is_empty(), "{:?}", leftovers.files());
    }
}

fn stop(run: Run) -> std::path::PathBuf {
    let output = run.place.output(&["stop", "run"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let path = run.running.run.clone();
    let (code, _, leftovers) = run.running.wait();
    assert_eq!(code, Some(0), "{}", run.place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    // The run's directory must outlive its workplace.
    std::mem::forget(run.place);
    path
}

/// Waits for the end of this run, which `stop` asks for.
fn ends_as_stopped(run: Run, mut stop: std::process::Child) {
    until("the run is stopped", || stop.try_wait().unwrap().is_some());
    assert!(stop.wait().unwrap().success());
    let Run { place, running } = run;
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
}

/// Rows of these actors in the replay.
fn in_replay(run: &std::path::Path, actors: &[u32]) -> u64 {
    actors.iter().map(|actor| committed(run, *actor as usize)).sum()
}

/// Waits until the replay has more rows of each of these actors.
fn wait_for_actors(run: &Run, actors: &[u32]) {
    let rows = |actor: u32| committed(&run.running.run, actor as usize);
    let before: Vec<u64> = actors.iter().map(|actor| rows(*actor)).collect();
    until("every remote actor has more rows in the replay", || {
        actors.iter().zip(&before).all(|(actor, before)| rows(*actor) > *before)
    });
}

#[test]
fn a_host_that_joins_sends_rows_is_shown_and_ends_with_the_run() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "2", "--name", "node-2"]);
    wait_for_actors(&run, &[1, 2]);
    until("the host is shown", || run.hosts().len() == 1);
    let hosts = run.hosts();
    assert_eq!(
        (&hosts[0]["name"], &hosts[0]["state"]),
        (&"node-2".into(), &"connected".into())
    );
    assert_eq!(hosts[0]["actors"], 2);
    until("its roles are shown", || {
        run.hosts()[0]["roles"].as_array().is_some_and(|roles| roles.len() == 4)
    });
    // Remote and local actors have their own indices.
    let refused = run.place.output(&["scale", "run", "--actors", "15"]);
    assert!(error_line(&refused).contains("other hosts have 2"));
    let scaled = run.place.output(&["scale", "run", "--actors", "2"]);
    assert!(scaled.status.success());
    until("a second local actor works", || run.running.pids("actor-3").len() == 1);
    until("episodes of remote actors are recorded", || {
        let episodes = std::fs::read_to_string(run.running.run.join("episodes.csv")).unwrap_or_default();
        let mut rows = csv::Reader::from_reader(episodes.as_bytes());
        let actor = rows.headers().unwrap().iter().position(|name| name == "actor").unwrap();
        rows.records().flatten().any(|row| &row[actor] == "2")
    });
    let path = stop(run);
    let sent = host.sent(&[1, 2]);
    host.ends_with(0);
    assert_eq!(in_replay(&path, &[1, 2]), sent);
}

#[test]
fn scale_changes_the_actors_of_joined_hosts_without_losing_a_row() {
    let run = Run::start(&["--actors", "1", "--set", "actors.max=8"]);
    let hosts = [("a", "2"), ("b", "1")].map(|(name, actors)| Host::join(&run, &["--actors", actors, "--name", name]));
    wait_for_actors(&run, &[1, 2, 3]);
    let scale = |arguments: &[&str]| run.place.output(&[&["scale", "run"], arguments].concat());
    let actors_of = |name: &str| {
        let hosts = run.hosts();
        hosts
            .iter()
            .find(|host| host["name"] == name)
            .map(|host| host["actors"].clone())
    };
    for (refused, why) in [
        (&["--host", "c=2"][..], "no host \"c\" has joined"),
        (&["--host", "b=7"], "that would be 10 actors"),
        (&["--total", "2"], "cannot be shared by 3 hosts"),
    ] {
        let output = scale(refused);
        assert_eq!(output.status.code(), Some(1));
        assert!(error_line(&output).contains(why), "{}", error_line(&output));
    }
    // Rows flow throughout.
    wait_for_actors(&run, &[1, 2, 3]);
    let scaled = scale(&["--host", "b=3"]);
    assert!(scaled.status.success(), "{}", error_line(&scaled));
    assert_eq!(
        String::from_utf8_lossy(&scaled.stdout),
        "run: actors: 6, of them 1 on this host\n"
    );
    assert_eq!((actors_of("a"), actors_of("b")), (Some(2.into()), Some(3.into())));
    wait_for_actors(&run, &[0, 1, 2, 3, 4, 5]);
    // The learner's host takes what the others give up. No more than eight exist at any time.
    let scaled = scale(&["--total", "8", "--host", "a=1", "--host", "b=1"]);
    assert!(scaled.status.success(), "{}", error_line(&scaled));
    assert_eq!((actors_of("a"), actors_of("b")), (Some(1.into()), Some(1.into())));
    wait_for_actors(&run, &[0, 1, 2, 3, 4, 5, 6, 7]);
    // All have as many cores.
    let scaled = scale(&["--total", "6"]);
    assert!(scaled.status.success(), "{}", error_line(&scaled));
    assert_eq!((actors_of("a"), actors_of("b")), (Some(2.into()), Some(2.into())));
    assert_eq!(run.place.status("run")["actors"], 2);
    assert!(scale(&["--actors", "1"]).status.success());
    assert_eq!((actors_of("a"), actors_of("b")), (Some(2.into()), Some(2.into())));
    let path = stop(run);
    let attempts = |host: &Host| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(host.place.path()).unwrap();
        let is_host = |path: &PathBuf| path.join("shoal.log").exists();
        entries.map(|entry| entry.unwrap().path()).filter(is_host).collect()
    };
    let directories: Vec<PathBuf> = hosts.iter().flat_map(attempts).collect();
    assert_eq!(directories.len(), 3 + 4);
    let all: Vec<u32> = (0..8).collect();
    let sent_by = |directory: &PathBuf| all.iter().map(|actor| sent(directory, *actor)).sum::<u64>();
    let everywhere = directories.iter().chain([&path]).map(sent_by).sum::<u64>();
    for directory in directories {
        Leftovers::of(&directory).wait_until_gone();
    }
    for host in hosts {
        host.ends_with(0);
    }
    assert_eq!(in_replay(&path, &all), everywhere);
}

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
fn hosts_wait_for_a_killed_launcher_and_continue_with_its_successor() {
    let run = Run::start(&["--actors", "1"]);
    let host = Host::join(&run, &["--actors", "2"]);
    wait_for_actors(&run, &[1, 2]);
    let endpoint = run.endpoint();
    run.running.signal(Signal::KILL);
    let Run { place, running } = run;
    let (code, ..) = running.wait_for_launcher();
    assert_eq!(code, None);
    // At once: the old gate may still be listening.
    let running = place.resume("run", &["--listen", &endpoint]);
    let run = Run { place, running };
    wait_for_actors(&run, &[1, 2]);
    assert!(
        host.running.pids("actor-1").len() == 1,
        "the host's actors need no restart"
    );
    let path = stop(run);
    let sent = host.sent(&[1, 2]);
    host.ends_with(0);
    assert_eq!(in_replay(&path, &[1, 2]), sent);
}

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
fn hosts_wait_for_a_run_that_a_scheduler_ends_and_resumes() {
    let run = Run::start(&["--actors", "1", "--hosts-wait"]);
    let host = Host::join(&run, &["--actors", "2"]);
    wait_for_actors(&run, &[1, 2]);
    let endpoint = run.endpoint();
    run.running.signal(Signal::TERM);
    let Run { place, running } = run;
    let (code, ..) = running.wait_for_launcher();
    assert_eq!(code, Some(128 + 15));
    let running = place.resume("run", &["--listen", &endpoint, "--hosts-wait"]);
    let run = Run { place, running };
    wait_for_actors(&run, &[1, 2]);
    assert_eq!(
        host.running.pids("actor-1").len(),
        1,
        "the host's actors need no restart"
    );
    let path = stop(run);
    let sent = host.sent(&[1, 2]);
    host.ends_with(0);
    assert_eq!(in_replay(&path, &[1, 2]), sent);
}

#[test]
fn hosts_that_know_the_directory_follow_a_run_that_listens_elsewhere() {
    let run = Run::start(&["--actors", "1", "--hosts-wait"]);
    let place = Workplace::logging_chunks();
    let directory = run.running.run.display().to_string();
    let join = ["join", &directory, "--local", "host", "--actors", "2"];
    let host = Host {
        running: place.launch_command("host", &mut place.shoal(&join)),
        place,
    };
    wait_for_actors(&run, &[1, 2]);
    let before = run.endpoint();
    run.running.signal(Signal::TERM);
    let Run { place, running } = run;
    assert_eq!(running.wait_for_launcher().0, Some(128 + 15));
    let running = place.resume("run", &["--listen", "tcp/127.0.0.1:0", "--hosts-wait"]);
    let run = Run { place, running };
    assert_ne!(run.endpoint(), before, "a free port");
    wait_for_actors(&run, &[1, 2]);
    stop(run);
    let Host { place, running } = host;
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
    let moved = "the run listens on tcp/127.0.0.1:";
    assert!(place.stderr().contains(moved), "{}", place.stderr());
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
fn only_the_key_of_the_run_opens_an_encrypted_endpoint() {
    let run = Run::start(&["--actors", "1", "--listen", "tls/127.0.0.1:0"]);
    let other = Run::start(&["--actors", "1", "--listen", "tls/127.0.0.1:0"]);
    let key = |run: &Run| run.running.run.join("join.key").display().to_string();
    let (own, foreign, endpoint) = (key(&run), key(&other), run.endpoint());
    let mode = std::fs::metadata(&own).unwrap().permissions();
    assert_eq!(std::os::unix::fs::PermissionsExt::mode(&mode) & 0o777, 0o600);
    // None.
    let none = run.place.output(&["join", &endpoint, "--actors", "1"]);
    assert_eq!(none.status.code(), Some(2));
    assert!(error_line(&none).contains("needs the run's key"));
    // That of another run.
    let begun = Instant::now();
    let wrong = ["join", &endpoint, "--actors", "1", "--key", &foreign, "--give-up", "2s"];
    let wrong = run.place.output(&wrong);
    assert_eq!(wrong.status.code(), Some(4));
    assert!(error_line(&wrong).contains("is this its key"));
    assert!(begun.elapsed() < Duration::from_secs(60));
    until("the gate names the refusal", || {
        run.running.log().contains("a connection was refused")
    });
    // No encryption at all.
    let plain = endpoint.replace("tls/", "tcp/");
    let plain = run.place.output(&["join", &plain, "--actors", "1", "--give-up", "1s"]);
    assert_eq!(plain.status.code(), Some(4));
    // A file that is no key.
    let config = run.running.run.join("config.toml").display().to_string();
    let no_key = run
        .place
        .output(&["join", &endpoint, "--actors", "1", "--key", &config]);
    assert!(error_line(&no_key).contains("is damaged"));
    // The right one.
    let host = Host::join(&run, &["--actors", "1", "--key", &own]);
    wait_for_actors(&run, &[1]);
    stop(other);
    let path = stop(run);
    let sent = host.sent(&[1]);
    host.ends_with(0);
    assert_eq!(in_replay(&path, &[1]), sent);
}

#[test]
fn new_keys_replace_the_old_ones() {
    let run = Run::start(&["--actors", "1", "--listen", "tls/127.0.0.1:0"]);
    let endpoint = run.endpoint();
    let old = run.place.path().join("old.key");
    std::fs::copy(run.running.run.join("join.key"), &old).unwrap();
    assert!(run.place.output(&["stop", "run"]).status.success());
    let Run { place, running } = run;
    let (code, ..) = running.wait();
    assert_eq!(code, Some(0), "{}", place.stderr());

    let running = place.resume("run", &["--listen", "--new-keys"]);
    let run = Run { place, running };
    assert_eq!(run.endpoint(), endpoint);
    let old = old.display().to_string();
    let refused = ["join", &endpoint, "--actors", "1", "--key", &old, "--give-up", "2s"];
    let refused = run.place.output(&refused);
    assert_eq!(refused.status.code(), Some(4));
    assert!(error_line(&refused).contains("is this its key"));
    let new = run.running.run.join("join.key").display().to_string();
    let host = Host::join(&run, &["--actors", "1", "--key", &new]);
    wait_for_actors(&run, &[1]);
    stop(run);
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
fn the_directory_of_a_killed_host_is_removed_and_the_log_of_a_failed_one_is_kept() {
    let run = Run::start(&["--actors", "1", "--listen", "tls/127.0.0.1:0"]);
    let endpoint = run.endpoint();
    let key = run.running.run.join("join.key").display().to_string();
    let place = Workplace::new();
    let temporary = place.path().join("temporary");
    std::fs::create_dir(&temporary).unwrap();
    let entries = |directory: &Path| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(directory).unwrap();
        entries.map(|entry| entry.unwrap().path()).collect()
    };
    // What only looks like the directory of a killed host, or is not this user's.
    let other = |name: &str| {
        std::fs::create_dir(temporary.join(name)).unwrap();
        std::fs::write(temporary.join(name).join("config.toml"), "").unwrap();
        temporary.join(name)
    };
    let linked = other("elsewhere");
    std::os::unix::fs::symlink(&linked, temporary.join("shoal-join-0000000000000001")).unwrap();
    other("shoal-join-notes");
    let just_made = temporary.join("shoal-join-0000000000000002");
    std::fs::create_dir(&just_made).unwrap();
    if rustix::process::getuid().is_root() {
        let foreign = other("shoal-join-0000000000000003");
        std::os::unix::fs::chown(foreign, Some(65534), None).unwrap();
    }
    let others = entries(&temporary);
    // Starts a host, and waits until its processes work in its directory.
    let join = || {
        let before = entries(&temporary);
        let mut command = place.shoal(&["join", &endpoint, "--actors", "1", "--key", &key]);
        let joined = command
            .env("TMPDIR", &temporary)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let is_ready = |path: &PathBuf| {
            let log = std::fs::read_to_string(path.join("shoal.log")).unwrap_or_default();
            !before.contains(path) && log.contains("every role is ready")
        };
        let mut found = None;
        until("every role is ready", || {
            found = entries(&temporary).into_iter().find(is_ready);
            found.is_some()
        });
        (joined, found.unwrap())
    };
    let (mut killed, its_directory) = join();
    assert!(its_directory.join("join.key").exists());
    killed.kill().unwrap();
    killed.wait().unwrap();
    let (mut living, at_work) = join();
    assert!(!its_directory.exists());
    let (mut failing, with_log) = join();
    std::fs::remove_file(with_log.join("config.toml")).unwrap();
    until("the host has failed", || failing.try_wait().unwrap().is_some());
    let failed = failing.wait_with_output().unwrap();
    assert_eq!(failed.status.code(), Some(1));
    let log = with_log.join("shoal.log");
    assert!(String::from_utf8_lossy(&failed.stderr).contains(&log.display().to_string()));
    assert_eq!(entries(&with_log), [log]);
    let (mut last, _) = join();
    assert!(at_work.join("join.key").exists());
    stop(run);
    for host in [&mut living, &mut last] {
        until("the host has ended", || host.try_wait().unwrap().is_some());
        assert!(host.wait().unwrap().success());
    }
    let left: HashSet<PathBuf> = entries(&temporary).into_iter().collect();
    assert_eq!(left, others.into_iter().chain([with_log]).collect());
    assert!(linked.join("config.toml").exists());
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

#[test]
fn the_rates_of_joined_hosts_are_measured_and_nothing_is_left() {
    let temporary = tempfile::TempDir::new().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_shoal"));
    command.args(["bench", "remote", "--json"]).stdin(Stdio::null());
    command.env("SHOAL_BENCH_SECONDS", "2").env("TMPDIR", temporary.path());
    let output = output_of(&mut command);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let figures: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let positive = |figure: &serde_json::Value| figure.as_f64().is_some_and(|number| number > 0.0);
    let links = ["loopback", "cable", "gigabit"].map(|link| &figures[link]);
    // Only root can make cables.
    for link in links.into_iter().filter(|link| !link.is_null()) {
        for field in ["rows_per_second", "gate_cores", "relay_cores", "learner_cores"] {
            assert!(positive(&link[field]), "{field} in {figures}");
        }
    }
    assert!(positive(&figures["loopback"]["rows_per_second"]), "{figures}");
    let many = &figures["many"];
    assert_eq!((&many["hosts"], &many["actors"]), (&32.into(), &256.into()));
    for field in ["rows_per_second", "gate_open_files", "rejoined_s"] {
        assert!(positive(&many[field]), "{field} in {figures}");
    }
    // On a busy machine a host may have sent nothing in so short a time.
    let fairness = many["fairness"].as_f64();
    assert!(fairness.is_some_and(|share| (0.0..=1.0).contains(&share)), "{figures}");
    assert_eq!(std::fs::read_dir(temporary.path()).unwrap().count(), 0);
}

/// The template as an executable file, with this text replaced.
fn template(place: &Workplace, name: &str, replaced: (&str, &str)) -> std::path::PathBuf {
    let printed = place.output(&["join", "--template", name]);
    assert!(printed.status.success());
    let text = String::from_utf8(printed.stdout).unwrap();
    assert!(text.contains(replaced.0), "{text}");
    let path = place.path().join(format!("{name}.sh"));
    std::fs::write(&path, text.replacen(replaced.0, replaced.1, 1)).unwrap();
    path
}

#[test]
fn the_script_for_slurm_trains_joins_and_resumes() {
    let place = Workplace::new();
    let quick = place.path().join("quick.toml");
    let text = "[environment]\nname = \"pendulum\"\n[ddpg]\nhidden = [24, 16]\n\
                [replay]\nwarmup = 64\ncapacity = 5000\n[evaluation]\nepisodes = 2\nfinal_episodes = 3\n";
    std::fs::write(&quick, text).unwrap();
    let script = template(&place, "slurm", ("what=pendulum", &format!("what={}", quick.display())));
    let bin = std::path::Path::new(env!("CARGO_BIN_EXE_shoal")).parent().unwrap();
    let path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap());
    let job = |role: &str| {
        let mut command = Command::new("bash");
        command
            .arg(&script)
            .arg(role)
            .current_dir(place.path())
            .env("PATH", &path);
        command
            .env("RUN", place.path().join("run"))
            .env("SLURM_CPUS_PER_TASK", "2");
        command.env("TMPDIR", place.path());
        command
    };
    let run = place.path().join("run");
    let rows = || {
        let commits = shoal_common::commit::CommitReader::open(&run.join("replay.bin"));
        commits.map_or([0; 3], |commits| [0, 2, 3].map(|actor| commits.actor(actor).rows))
    };
    // The array may start before the learner. The second round is that of jobs that are requeued during the run.
    for _ in 0..2 {
        let before = rows();
        let actors = job("actors").spawn().unwrap();
        let learner = job("learner").spawn().unwrap();
        until("every actor has more rows in the replay", || {
            rows().iter().zip(before).all(|(now, before)| *now > before)
        });
        let stopped = place.output(&["stop", "run"]);
        assert!(stopped.status.success(), "{}", error_line(&stopped));
        for mut job in [learner, actors] {
            until("the job has ended", || job.try_wait().unwrap().is_some());
            assert!(job.wait().unwrap().success());
        }
    }
    let steps =
        support::parse(&String::from_utf8(place.output(&["status", "run", "--json"]).stdout).unwrap())["env_steps"]
            .as_u64()
            .unwrap();
    let last = format!("run.steps={}", steps + 100);
    let finished = place.output(&["resume", "run", "--set", &last, "--quiet"]);
    assert!(finished.status.success(), "{}", error_line(&finished));
    // Jobs that are requeued after the end find nothing left to do.
    assert!(support::output_of(&mut job("actors")).status.success());
    let again = support::output_of(&mut job("learner"));
    assert!(error_line(&again).contains("already"));
    assert_eq!(support::output_of(&mut job("neither")).status.code(), Some(2));
}

#[test]
fn the_script_for_ssh_joins_with_the_key_from_standard_input() {
    let run = Run::start(&["--actors", "1", "--listen", "tls/127.0.0.1:0"]);
    let place = Workplace::new();
    let script = template(&place, "ssh", ("ACTORS:-4", "ACTORS:-1"));
    // Instead of going to a host, its command is run here.
    let bin = place.path().join("bin");
    std::fs::create_dir(&bin).unwrap();
    let shoal = env!("CARGO_BIN_EXE_shoal");
    std::fs::write(bin.join("ssh"), format!("#!/bin/sh\nshift 2\nexec {shoal} \"$@\"\n")).unwrap();
    let executable = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    std::fs::set_permissions(bin.join("ssh"), executable).unwrap();
    let mut command = Command::new("bash");
    command
        .arg(&script)
        .env("RUN", &run.running.run)
        .env("HOSTS", "one two")
        .env("TMPDIR", place.path());
    command.env("PATH", format!("{}:{}", bin.display(), std::env::var("PATH").unwrap()));
    let mut joined = command.spawn().unwrap();
    until("both hosts are there", || run.hosts().len() == 2);
    wait_for_actors(&run, &[1, 2]);
    stop(run);
    until("the script has ended", || joined.try_wait().unwrap().is_some());
    assert!(joined.wait().unwrap().success());
}

#[test]
fn what_cannot_be_joined_is_refused_in_one_line() {
    let place = Workplace::new();
    let output = |arguments: &[&str]| support::output_of(place.shoal(arguments).env("TMPDIR", place.path()));
    let code = |arguments: &[&str]| output(arguments).status.code();
    // Nobody is there.
    let nobody = ["join", "tcp/127.0.0.1:9", "--actors", "1", "--give-up", "1s"];
    assert_eq!(code(&nobody), Some(4));
    assert!(error_line(&output(&nobody)).contains("nobody answers at tcp/127.0.0.1:9"));
    // No endpoints.
    for (endpoint, why) in [
        ("here", "is not an endpoint"),
        ("tcp/10.1.2.3:7447", "without encryption"),
    ] {
        let join = ["join", endpoint, "--actors", "1"];
        assert_eq!(code(&join), Some(2));
        assert!(error_line(&output(&join)).contains(why));
        let train = ["train", "pendulum", "--run", "none", "--listen", endpoint];
        assert_eq!(code(&train), Some(2));
        assert!(error_line(&output(&train)).contains(why));
        assert!(!place.path().join("none").exists());
    }
    // A run that nobody can join, and one that has no more actors.
    place.train(&["pendulum", "--run", "closed", "--steps", "200"]);
    assert!(error_line(&output(&["join", "closed", "--actors", "1"])).contains("was it started with --listen?"));
    let run = Run::start(&["--actors", "1", "--set", "actors.max=2"]);
    let endpoint = run.endpoint();
    let too_many = output(&["join", &endpoint, "--actors", "2"]);
    assert!(error_line(&too_many).contains("2 actors on all hosts together"));
    let left = std::fs::read_dir(place.path()).unwrap().flatten();
    let left: Vec<_> = left
        .filter(|entry| entry.file_name().to_string_lossy().contains("shoal-join"))
        .collect();
    assert!(left.is_empty(), "a refused host leaves nothing: {left:?}");
    stop(run);
}
