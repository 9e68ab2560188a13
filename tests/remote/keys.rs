//! The keys of encrypted endpoints.

use std::time::{Duration, Instant};

use crate::hosts::{Host, Run, in_replay, stop, wait_for_actors};
use crate::support::{error_line, until};

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
