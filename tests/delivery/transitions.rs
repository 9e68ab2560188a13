//! Learners that are killed and replaced: every chunk is in the replay exactly once.

use std::time::Duration;

use shoal_learner::replay::WriteStep;

use crate::children::MAX_ACTORS;
use crate::chunks::{Id, WINDOW, chunk_ids, committed};
use crate::process::Process;
use crate::run::{Run, eventually};

const FULL: u64 = WINDOW as u64;

/// Waits until the actor waits because its window is full. The learner has committed nothing of it.
fn wait_for_full_window(actor: &Process, run: &Run) {
    let commits = run.commits();
    while actor.expect_line("full")[0] != commits.committed(0).sequence + FULL {}
}

fn finish(actor: &mut Process) -> u64 {
    actor.tell("finish");
    actor.expect_line("done")[0]
}

fn chunks_of(run: &Run, actor: u32) -> Vec<Id> {
    committed(&run.replay(), MAX_ACTORS)
        .into_iter()
        .filter(|id| id.0 == actor)
        .collect()
}

#[test]
fn a_learner_killed_at_each_step_of_a_write_commits_each_chunk_once() {
    let run = Run::new();
    let _domain = run.join();
    let mut actor = run.launch("actor 0 1");
    actor.tell("send 120");
    for step in [
        WriteStep::WriteHorizonSet,
        WriteStep::RowsBeforeWrap,
        WriteStep::Rows,
        WriteStep::Checks,
        WriteStep::SealCleared,
        WriteStep::RecordWritten,
        WriteStep::Sealed,
        WriteStep::Published,
    ] {
        let mut learner = run.start(&format!("learner 1 stalls-at {step:?} 5"));
        learner.expect_line("stalled");
        wait_for_full_window(&actor, &run);
        learner.kill();
    }
    let mut learner = run.start("learner 1");
    learner.tell("run");
    let sent = actor.expect_line("done");
    eprintln!("the slowest send took {} µs", sent[1]);
    assert_eq!(finish(&mut actor), 120);
    learner.end();
    assert_eq!(chunks_of(&run, 0), chunk_ids(0, 1, 120));
}

#[test]
fn a_learner_killed_at_any_moment_commits_each_chunk_once() {
    let run = Run::new();
    let _domain = run.join();
    let mut actor = run.launch("actor 0 1");
    actor.tell("send 4000");
    for kill in 0..12 {
        let mut learner = run.launch("learner 1");
        learner.tell("run");
        // Half of them are killed before they are ready.
        if kill % 2 == 0 {
            learner.expect_line("ready");
        }
        // Each learner dies at a different moment.
        std::thread::sleep(Duration::from_micros(kill * 777));
        learner.kill();
    }
    let mut learner = run.start("learner 1");
    learner.tell("run");
    actor.expect_line("done");
    assert_eq!(finish(&mut actor), 4000);
    learner.end();
    assert_eq!(chunks_of(&run, 0), chunk_ids(0, 1, 4000));
}

#[test]
fn send_does_not_block_while_a_new_learner_with_a_full_history_receives_nothing() {
    for taken in [FULL, FULL - 3] {
        let run = Run::new();
        let _domain = run.join();
        let mut learner = run.start("learner 1");
        let mut actor = run.start("actor 0 1");
        learner.tell(&format!("take {taken}"));
        actor.tell(&format!("send {FULL}"));
        learner.expect_line("took");
        actor.expect_line("done");
        learner.kill();

        let mut learner = run.start("learner 1");
        actor.tell(&format!("send {taken}"));
        let sent = actor.expect_line("done");
        eprintln!("the slowest send took {} µs", sent[1]);
        learner.tell("run");
        assert_eq!(finish(&mut actor), FULL + taken);
        learner.end();
        assert_eq!(chunks_of(&run, 0), chunk_ids(0, 1, FULL + taken));
    }
}

#[test]
fn a_slow_learner_serves_all_actors() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 3");
    let mut actors: Vec<_> = (0..3).map(|index| run.start(&format!("actor {index} 1"))).collect();
    for actor in &mut actors {
        actor.tell("send 100000");
        actor.expect_line("full");
    }
    learner.tell("crawl");
    let commits = run.commits();
    let counts = || {
        (0..3)
            .map(|actor| commits.committed(actor).sequence)
            .collect::<Vec<_>>()
    };
    eventually("the learner has taken 100 chunks of each", || {
        counts().iter().all(|count| *count >= 100)
    });
    let counts = counts();
    // The bound is generous, because an actor may not get a core for a while on a busy machine.
    assert!(counts.iter().sum::<u64>() < 3_000, "chunks of each actor: {counts:?}");
    drop(actors);
    learner.kill();
    for (actor, count) in (0..3).zip(counts) {
        let chunks = chunks_of(&run, actor);
        assert!(chunks.len() as u64 >= count);
        assert_eq!(chunks, chunk_ids(actor, 1, chunks.len() as u64));
    }
}

#[test]
fn a_new_learner_connects_to_actors_that_are_waiting() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 2");
    let mut actors: Vec<_> = (0..2).map(|index| run.start(&format!("actor {index} 1"))).collect();
    learner.tell("take 6");
    actors.iter_mut().for_each(|actor| actor.tell("send 20"));
    learner.expect_line("took");
    learner.kill();
    // Once all actors wait, none of them sends a chunk or an event any more.
    let commits = run.commits();
    for (index, actor) in actors.iter().enumerate() {
        while actor.expect_line("full")[0] != commits.committed(index).sequence + FULL {}
    }
    let mut learner = run.start("learner 2");
    learner.tell("run");
    for actor in &mut actors {
        actor.expect_line("done");
        assert_eq!(finish(actor), 20);
    }
    learner.end();
    for index in 0..2 {
        assert_eq!(chunks_of(&run, index), chunk_ids(index, 1, 20));
    }
}
