//! Actors that die: what they had sent arrives, and before what their successors send.

use std::time::Duration;

use rustix::process::Signal;

use crate::children::MAX_ACTORS;
use crate::chunks::{ROWS, WINDOW, all, committed};
use crate::process::Process;
use crate::run::Run;

const FULL: u64 = WINDOW as u64;
/// More than the chunks that can be borrowed at a time, by far.
const LIVES: u64 = 50;

fn sends(actor: &mut Process, chunks: u64) {
    actor.told(&format!("send {chunks}"));
    actor.says("done");
}

fn finishes(actor: &mut Process) {
    actor.told("finish");
    actor.says("done");
}

#[test]
fn a_dead_actors_chunks_come_before_its_successors() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    let mut actor = run.start("actor 0 1");
    learner.told("take 2");
    sends(&mut actor, 2 + FULL);
    learner.says("took");
    actor.kill();
    let mut successor = run.start("actor 0 2");
    successor.told(&format!("send {FULL}"));
    assert_eq!(
        successor.says("full"),
        [0],
        "nothing is sent to a learner that may not have noticed"
    );
    learner.told("run");
    successor.says("done");
    finishes(&mut successor);
    learner.ends();
    let expected = [all(0, 1, 2 + FULL), all(0, 2, FULL)].concat();
    assert_eq!(committed(&run.replay(), MAX_ACTORS), expected);
}

#[test]
fn actors_that_die_while_the_learner_is_stopped_lose_nothing_they_sent() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    learner.told("run");
    let mut actor = run.start("actor 0 1");
    sends(&mut actor, 3);
    finishes(&mut actor);
    learner.stop();
    sends(&mut actor, FULL);
    actor.kill();
    // It lives and dies without the learner ever knowing of it.
    let mut unknown = run.start("actor 0 2");
    unknown.told("send 5");
    assert_eq!(unknown.says("full"), [0]);
    unknown.kill();
    let mut last = run.start("actor 0 3");
    last.told("send 5");
    last.says("full");
    learner.signal(Signal::CONT);
    last.says("done");
    finishes(&mut last);
    learner.ends();
    let expected = [all(0, 1, 3 + FULL), all(0, 3, 5)].concat();
    assert_eq!(committed(&run.replay(), MAX_ACTORS), expected);
}

#[test]
fn actors_killed_at_any_moment_lose_no_chunk_that_was_sent() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    learner.told("run");
    let mut sent = Vec::new();
    for incarnation in 1..9 {
        let mut actor = run.start(&format!("actor 0 {incarnation}"));
        actor.told("send 800");
        actor.says("sending 3");
        // Each time at another moment of its work.
        std::thread::sleep(Duration::from_micros(incarnation * 777));
        actor.kill();
        sent.push(actor.last_words("sending").unwrap_or(3));
    }
    let mut last = run.start("actor 0 9");
    sends(&mut last, 1);
    finishes(&mut last);
    learner.ends();
    let committed = committed(&run.replay(), MAX_ACTORS);
    let mut expected = Vec::new();
    for (incarnation, sent) in (1..).zip(sent) {
        let arrived = committed.iter().filter(|id| id.1 == incarnation).count() as u64;
        // It may have died after sending a chunk and before saying so.
        assert!(
            (sent..=sent + 1).contains(&arrived),
            "{arrived} of {sent} chunks of incarnation {incarnation}"
        );
        expected.extend(all(0, incarnation, arrived));
    }
    expected.extend(all(0, 9, 1));
    assert_eq!(committed, expected);
}

/// Dies with a chunk that it had borrowed and filled in part, or not at all, or wholly.
#[test]
fn a_chunk_that_a_dead_actor_held_is_nobodys_and_its_memory_is_free_again() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    learner.told("run");
    let (mut expected, mut traces) = (Vec::new(), Vec::new());
    for incarnation in 1..=LIVES {
        let mut actor = run.start(&format!("actor 0 {incarnation}"));
        let sent = incarnation % 3;
        if sent > 0 {
            sends(&mut actor, sent);
        }
        actor.told(&format!("hold {}", incarnation % (ROWS as u64 + 1)));
        actor.says("holding");
        actor.kill();
        expected.extend(all(0, incarnation, sent));
        traces.push(run.traces().len());
    }
    let mut last = run.start(&format!("actor 0 {}", LIVES + 1));
    sends(&mut last, 3 * FULL);
    finishes(&mut last);
    learner.ends();
    expected.extend(all(0, LIVES + 1, 3 * FULL));
    assert_eq!(committed(&run.replay(), MAX_ACTORS), expected);
    // The first lives fill what is kept for the learner.
    assert!(
        traces[LIVES as usize - 1] <= traces[9],
        "files of the run after each life: {traces:?}"
    );
}

#[test]
fn an_actor_that_dies_with_a_full_window_and_a_chunk_in_hand_loses_only_that_chunk() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    let (mut expected, mut traces) = (Vec::new(), Vec::new());
    for incarnation in 1..=LIVES {
        // It has borrowed and sent its first, empty chunk when it is ready, though nobody takes anything yet.
        let mut actor = run.start(&format!("actor 0 {incarnation}"));
        // What its predecessor left, and one of its own.
        let left = if incarnation == 1 { 0 } else { FULL };
        learner.told(&format!("take {}", left + 1));
        sends(&mut actor, 1 + FULL);
        learner.says("took");
        let before = (incarnation - 1) * (1 + FULL);
        assert_eq!(run.commits().committed(0).sequence, before + 1, "the window is full");
        actor.told(&format!("hold {}", incarnation % (ROWS as u64 + 1)));
        actor.says("holding");
        actor.kill();
        expected.extend(all(0, incarnation, 1 + FULL));
        traces.push(run.traces().len());
    }
    let mut last = run.start(&format!("actor 0 {}", LIVES + 1));
    learner.told("run");
    sends(&mut last, 3 * FULL);
    finishes(&mut last);
    learner.ends();
    expected.extend(all(0, LIVES + 1, 3 * FULL));
    assert_eq!(committed(&run.replay(), MAX_ACTORS), expected);
    assert!(
        traces[LIVES as usize - 1] <= traces[9],
        "files of the run after each life: {traces:?}"
    );
}
