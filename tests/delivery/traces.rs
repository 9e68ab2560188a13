//! What a run leaves in shared memory and in the user's directory: nothing.

use std::time::Duration;

use shoal_common::channel::Domain;

use crate::process::Process;
use crate::run::{Run, eventually};

/// One process of every kind, at work.
fn everybody(run: &Run) -> Vec<Process> {
    let mut learner = run.start("learner 2");
    learner.told("run");
    let mut actor = run.start("actor 0 1");
    actor.told("send 100");
    let mut publisher = run.start("policy-publisher 0");
    publisher.told("publish 1");
    let server = run.start("env-server");
    actor.says("done");
    publisher.says("published");
    vec![learner, actor, publisher, server]
}

#[test]
fn a_run_whose_processes_end_or_are_killed_leaves_nothing() {
    let run = Run::new();
    let domain = run.join();
    let mut processes = everybody(&run);
    processes.push(run.start("actor 1 1"));
    assert!(run.traces().len() > 5, "this test looks where the files are");
    for (i, mut process) in processes.into_iter().enumerate() {
        if i % 2 == 0 {
            process.kill();
        } else {
            process.ends();
        }
    }
    domain.leave().unwrap();
    run.end_host();
    assert!(run.traces().is_empty(), "{:?}", run.traces());
}

#[test]
fn processes_killed_while_they_start_leave_nothing() {
    let run = Run::new();
    let domain = run.join();
    let roles = ["learner 1", "actor 0 1", "policy-publisher 0", "env-server"];
    for moment in 0..24 {
        let mut process = run.launch(roles[moment as usize % roles.len()]);
        // Each time at another moment of its start.
        std::thread::sleep(Duration::from_micros(moment * 555));
        process.kill();
    }
    domain.leave().unwrap();
    run.end_host();
    assert!(run.traces().is_empty(), "{:?}", run.traces());
}

#[test]
fn an_abandoned_run_is_removed_and_a_living_one_goes_on() {
    let (dead, living) = (Run::new(), Run::new());
    let _domain = living.join();
    let _others = everybody(&living);
    let mut actor = living.start("actor 1 1");
    drop(everybody(&dead));
    dead.kill_host();
    // Another test may be the one that removes it.
    Domain::remove_abandoned().unwrap();
    assert!(dead.traces().is_empty(), "{:?}", dead.traces());
    assert!(living.traces().len() > 5);
    actor.told("send 20");
    actor.says("done");
    let commits = living.commits();
    eventually("the living run's chunks arrive", || {
        commits.committed(1).sequence == 20 && commits.committed(0).sequence == 100
    });
}
