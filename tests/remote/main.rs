//! Two hosts on one machine: a run that others may join, and hosts that join it. Processes of both are killed and
//! stopped at any moment. Everything that the actors of a living host have sent is in the replay, once.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod directories;
mod ending;
mod hosts;
mod keys;
mod kills;
mod lockstep;
mod resuming;
mod scaling;
mod scripts;
#[path = "../support/mod.rs"]
mod support;

use std::process::{Command, Stdio};

use hosts::{Host, Run, in_replay, stop, wait_for_actors};
use support::{Workplace, error_line, output_of, until};

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
