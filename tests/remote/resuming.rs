//! Hosts wait for a run whose launcher ends, and continue with its successor.

use rustix::process::Signal;

use crate::hosts::{Host, Run, in_replay, stop, wait_for_actors};
use crate::support::Workplace;

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
