//! Learners that die and come back: every chunk is in the replay exactly once.

use std::time::Duration;

use crate::children::MAX_ACTORS;
use crate::chunks::{Id, WINDOW, all, committed};
use crate::process::Process;
use crate::run::{Run, eventually};

const FULL: u64 = WINDOW as u64;

/// Waits until the actor naps before a full window that nothing is taken from.
fn waits_before_a_full_window(actor: &Process, run: &Run) {
    let commits = run.commits();
    while actor.says("full")[0] != commits.committed(0).sequence + FULL {}
}

fn finishes(actor: &mut Process) -> u64 {
    actor.told("finish");
    actor.says("done")[0]
}

fn chunks_of(run: &Run, actor: u32) -> Vec<Id> {
    committed(&run.replay(), MAX_ACTORS)
        .into_iter()
        .filter(|id| id.0 == actor)
        .collect()
}

#[test]
fn a_learner_killed_at_every_step_while_the_window_is_full_commits_each_chunk_once() {
    let run = Run::new();
    let _domain = run.join();
    let mut actor = run.launch("actor 0 1");
    actor.told("send 120");
    for step in [
        "ReachSet",
        "RowsBeforeWrap",
        "Rows",
        "Checks",
        "SealBroken",
        "RecordWritten",
        "Sealed",
        "Published",
    ] {
        let mut learner = run.start(&format!("learner 1 stalls-at {step} 5"));
        learner.says("stalled");
        waits_before_a_full_window(&actor, &run);
        learner.kill();
    }
    let mut learner = run.start("learner 1");
    learner.told("run");
    let sent = actor.says("done");
    eprintln!("the slowest send took {} µs", sent[1]);
    assert_eq!(finishes(&mut actor), 120);
    learner.ends();
    assert_eq!(chunks_of(&run, 0), all(0, 1, 120));
}

#[test]
fn a_learner_killed_at_any_moment_commits_each_chunk_once() {
    let run = Run::new();
    let _domain = run.join();
    let mut actor = run.launch("actor 0 1");
    actor.told("send 4000");
    for kill in 0..12 {
        let mut learner = run.launch("learner 1");
        learner.told("run");
        // Half of them before they are ready.
        if kill % 2 == 0 {
            learner.says("ready");
        }
        // Each time at another moment of its work.
        std::thread::sleep(Duration::from_micros(kill * 777));
        learner.kill();
    }
    let mut learner = run.start("learner 1");
    learner.told("run");
    actor.says("done");
    assert_eq!(finishes(&mut actor), 4000);
    learner.ends();
    assert_eq!(chunks_of(&run, 0), all(0, 1, 4000));
}

#[test]
fn send_finds_room_though_a_new_learner_finds_a_history_and_takes_nothing() {
    for taken in [FULL, FULL - 3] {
        let run = Run::new();
        let _domain = run.join();
        let mut learner = run.start("learner 1");
        let mut actor = run.start("actor 0 1");
        learner.told(&format!("take {taken}"));
        actor.told(&format!("send {FULL}"));
        learner.says("took");
        actor.says("done");
        learner.kill();

        let mut learner = run.start("learner 1");
        actor.told(&format!("send {taken}"));
        let sent = actor.says("done");
        eprintln!("the slowest send took {} µs", sent[1]);
        learner.told("run");
        assert_eq!(finishes(&mut actor), FULL + taken);
        learner.ends();
        assert_eq!(chunks_of(&run, 0), all(0, 1, FULL + taken));
    }
}

#[test]
fn actors_on_a_slow_learner_share_it() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 3");
    let mut actors: Vec<_> = (0..3).map(|index| run.start(&format!("actor {index} 1"))).collect();
    for actor in &mut actors {
        actor.told("send 100000");
        actor.says("full");
    }
    learner.told("crawl");
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
    // A busy machine may not let an actor run for a while.
    assert!(counts.iter().sum::<u64>() < 3_000, "chunks of each actor: {counts:?}");
    drop(actors);
    learner.kill();
    for (actor, count) in (0..3).zip(counts) {
        let chunks = chunks_of(&run, actor);
        assert!(chunks.len() as u64 >= count);
        assert_eq!(chunks, all(actor, 1, chunks.len() as u64));
    }
}

#[test]
fn a_new_learner_and_actors_that_wait_for_one_find_each_other() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 2");
    let mut actors: Vec<_> = (0..2).map(|index| run.start(&format!("actor {index} 1"))).collect();
    learner.told("take 6");
    actors.iter_mut().for_each(|actor| actor.told("send 20"));
    learner.says("took");
    learner.kill();
    // All of them wait: nobody sends or rings any more.
    let commits = run.commits();
    for (index, actor) in actors.iter().enumerate() {
        while actor.says("full")[0] != commits.committed(index).sequence + FULL {}
    }
    let mut learner = run.start("learner 2");
    learner.told("run");
    for actor in &mut actors {
        actor.says("done");
        assert_eq!(finishes(actor), 20);
    }
    learner.ends();
    for index in 0..2 {
        assert_eq!(chunks_of(&run, index), all(index, 1, 20));
    }
}
