//! A run leaves nothing in shared memory or in the user's directory.

use std::time::Duration;

use shoal_common::channel::Domain;

use crate::process::Process;
use crate::run::{Run, eventually};

/// One working process of each kind.
fn one_of_each(run: &Run) -> Vec<Process> {
    let mut learner = run.start("learner 2");
    learner.tell("run");
    let mut actor = run.start("actor 0 1");
    actor.tell("send 100");
    let mut publisher = run.start("policy-publisher 0");
    publisher.tell("publish 1");
    let server = run.start("env-server");
    actor.expect_line("done");
    publisher.expect_line("published");
    vec![learner, actor, publisher, server]
}

#[test]
fn a_run_whose_processes_end_or_are_killed_leaves_nothing() {
    let run = Run::new();
    let domain = run.join();
    let mut processes = one_of_each(&run);
    processes.push(run.start("actor 1 1"));
    assert!(run.leftovers().len() > 5, "this test finds the run's files");
    for (i, mut process) in processes.into_iter().enumerate() {
        if i % 2 == 0 {
            process.kill();
        } else {
            process.end();
        }
    }
    domain.leave().unwrap();
    run.end_host();
    assert!(run.leftovers().is_empty(), "{:?}", run.leftovers());
}

#[test]
fn processes_killed_while_they_start_leave_nothing() {
    let run = Run::new();
    let domain = run.join();
    let roles = ["learner 1", "actor 0 1", "policy-publisher 0", "env-server"];
    for moment in 0..24 {
        let mut process = run.launch(roles[moment as usize % roles.len()]);
        // Each time at a different moment of its start.
        std::thread::sleep(Duration::from_micros(moment * 555));
        process.kill();
    }
    domain.leave().unwrap();
    run.end_host();
    assert!(run.leftovers().is_empty(), "{:?}", run.leftovers());
}

#[test]
fn an_abandoned_run_is_removed_and_a_running_one_continues() {
    let (dead, living) = (Run::new(), Run::new());
    let _domain = living.join();
    let _others = one_of_each(&living);
    let mut actor = living.start("actor 1 1");
    drop(one_of_each(&dead));
    dead.kill_host();
    // Another test may remove it at the same time.
    Domain::remove_abandoned().unwrap();
    assert!(dead.leftovers().is_empty(), "{:?}", dead.leftovers());
    assert!(living.leftovers().len() > 5);
    actor.tell("send 20");
    actor.expect_line("done");
    let commits = living.commits();
    eventually("the living run's chunks arrive", || {
        commits.committed(1).sequence == 20 && commits.committed(0).sequence == 100
    });
}

#[test]
fn a_living_run_whose_directory_is_removed_keeps_its_shared_memory() {
    let run = Run::new();
    let domain = run.join();
    let processes = one_of_each(&run);
    let directory = domain.directory().unwrap();
    assert!(domain.is_intact(5) && !domain.is_intact(1000));
    let above = std::fs::File::open(directory.parent().unwrap()).unwrap();
    assert!(above.try_lock().is_err(), "a program that tidies up skips it");
    std::fs::remove_dir_all(&directory).unwrap();
    assert!(!domain.is_intact(0));
    let before = run.leftovers();
    assert!(before.len() > 5, "this test finds the run's files");
    // As another run at its start, a terminal that asks, and a process that is started again.
    Domain::remove_abandoned().unwrap();
    Domain::join_as_client(domain.run_id(), 1).unwrap().leave().unwrap();
    run.join().leave().unwrap();
    Domain::remove_abandoned().unwrap();
    let after = run.leftovers();
    assert!(before.iter().all(|file| after.contains(file)), "{before:?}; {after:?}");
    let wait = Domain::wait_for_earlier_processes(domain.run_id(), Duration::from_millis(50));
    let said = wait.unwrap_err().to_string();
    assert!(said.contains(&std::process::id().to_string()), "{said}");

    let id = domain.run_id().to_owned();
    processes.into_iter().for_each(Process::end);
    domain.leave().unwrap();
    run.end_host();
    assert!(run.leftovers().is_empty(), "{:?}", run.leftovers());
    Domain::wait_for_earlier_processes(&id, Duration::ZERO).unwrap();
}
