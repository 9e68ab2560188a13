//! Actors that are killed: the chunks they sent arrive, and arrive before their successors' chunks.

use std::time::Duration;

use rustix::process::Signal;

use crate::children::MAX_ACTORS;
use crate::chunks::{ROWS, WINDOW, chunk_ids, committed};
use crate::process::Process;
use crate::run::Run;

const FULL: u64 = WINDOW as u64;
/// Incarnations of an actor. Far more than the chunks that can be borrowed at a time.
const LIVES: u64 = 50;

fn send(actor: &mut Process, chunks: u64) {
    actor.tell(&format!("send {chunks}"));
    actor.expect_line("done");
}

fn finish(actor: &mut Process) {
    actor.tell("finish");
    actor.expect_line("done");
}

#[test]
fn a_dead_actors_chunks_arrive_before_its_successors() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    let mut actor = run.start("actor 0 1");
    learner.tell("take 2");
    send(&mut actor, 2 + FULL);
    learner.expect_line("took");
    actor.kill();
    let mut successor = run.start("actor 0 2");
    successor.tell(&format!("send {FULL}"));
    assert_eq!(
        successor.expect_line("full"),
        [0],
        "the successor sends nothing before its handshake is committed"
    );
    learner.tell("run");
    successor.expect_line("done");
    finish(&mut successor);
    learner.end();
    let expected = [chunk_ids(0, 1, 2 + FULL), chunk_ids(0, 2, FULL)].concat();
    assert_eq!(committed(&run.replay(), MAX_ACTORS), expected);
}

#[test]
fn actors_that_die_while_the_learner_is_stopped_lose_no_sent_chunk() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    learner.tell("run");
    let mut actor = run.start("actor 0 1");
    send(&mut actor, 3);
    finish(&mut actor);
    learner.stop();
    send(&mut actor, FULL);
    actor.kill();
    // It starts and dies while the learner is stopped.
    let mut unknown = run.start("actor 0 2");
    unknown.tell("send 5");
    assert_eq!(unknown.expect_line("full"), [0]);
    unknown.kill();
    let mut last = run.start("actor 0 3");
    last.tell("send 5");
    last.expect_line("full");
    learner.signal(Signal::CONT);
    last.expect_line("done");
    finish(&mut last);
    learner.end();
    let expected = [chunk_ids(0, 1, 3 + FULL), chunk_ids(0, 3, 5)].concat();
    assert_eq!(committed(&run.replay(), MAX_ACTORS), expected);
}

#[test]
fn actors_killed_at_any_moment_lose_no_sent_chunk() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    learner.tell("run");
    let mut sent = Vec::new();
    for incarnation in 1..9 {
        let mut actor = run.start(&format!("actor 0 {incarnation}"));
        actor.tell("send 800");
        actor.expect_line("sending 3");
        // Each incarnation dies at a different moment.
        std::thread::sleep(Duration::from_micros(incarnation * 777));
        actor.kill();
        sent.push(actor.last_number("sending").unwrap_or(3));
    }
    let mut last = run.start("actor 0 9");
    send(&mut last, 1);
    finish(&mut last);
    learner.end();
    let committed = committed(&run.replay(), MAX_ACTORS);
    let mut expected = Vec::new();
    for (incarnation, sent) in (1..).zip(sent) {
        let arrived = committed.iter().filter(|id| id.1 == incarnation).count() as u64;
        // It may have died after sending a chunk and before reporting it.
        assert!(
            (sent..=sent + 1).contains(&arrived),
            "{arrived} of {sent} chunks of incarnation {incarnation}"
        );
        expected.extend(chunk_ids(0, incarnation, arrived));
    }
    expected.extend(chunk_ids(0, 9, 1));
    assert_eq!(committed, expected);
}

/// The actor dies holding a borrowed chunk that is empty, partly filled or full.
#[test]
fn a_chunk_held_by_a_dead_actor_is_dropped_and_its_memory_freed() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    learner.tell("run");
    let (mut expected, mut leftovers) = (Vec::new(), Vec::new());
    for incarnation in 1..=LIVES {
        let mut actor = run.start(&format!("actor 0 {incarnation}"));
        let sent = incarnation % 3;
        if sent > 0 {
            send(&mut actor, sent);
        }
        actor.tell(&format!("hold {}", incarnation % (ROWS as u64 + 1)));
        actor.expect_line("holding");
        actor.kill();
        expected.extend(chunk_ids(0, incarnation, sent));
        leftovers.push(run.leftovers().len());
    }
    let mut last = run.start(&format!("actor 0 {}", LIVES + 1));
    send(&mut last, 3 * FULL);
    finish(&mut last);
    learner.end();
    expected.extend(chunk_ids(0, LIVES + 1, 3 * FULL));
    assert_eq!(committed(&run.replay(), MAX_ACTORS), expected);
    // During the first incarnations the buffers that are kept for the learner still grow. At the moment of a count, a
    // file may be missing.
    let half = leftovers.len() / 2;
    let most = |lives: &[usize]| lives.iter().max().copied();
    assert!(
        most(&leftovers[half..]) <= most(&leftovers[9..half]),
        "files of the run after each life: {leftovers:?}"
    );
}

#[test]
fn an_actor_that_dies_with_a_full_window_and_a_borrowed_chunk_loses_only_that_chunk() {
    let run = Run::new();
    let _domain = run.join();
    let mut learner = run.start("learner 1");
    let (mut expected, mut leftovers) = (Vec::new(), Vec::new());
    for incarnation in 1..=LIVES {
        // When it is ready it has sent its handshake, an empty chunk, although the learner receives nothing yet.
        let mut actor = run.start(&format!("actor 0 {incarnation}"));
        // The learner takes what the predecessor left, and one chunk of this actor.
        let left = if incarnation == 1 { 0 } else { FULL };
        learner.tell(&format!("take {}", left + 1));
        send(&mut actor, 1 + FULL);
        learner.expect_line("took");
        let before = (incarnation - 1) * (1 + FULL);
        assert_eq!(run.commits().committed(0).sequence, before + 1, "the window is full");
        actor.tell(&format!("hold {}", incarnation % (ROWS as u64 + 1)));
        actor.expect_line("holding");
        actor.kill();
        expected.extend(chunk_ids(0, incarnation, 1 + FULL));
        leftovers.push(run.leftovers().len());
    }
    let mut last = run.start(&format!("actor 0 {}", LIVES + 1));
    learner.tell("run");
    send(&mut last, 3 * FULL);
    finish(&mut last);
    learner.end();
    expected.extend(chunk_ids(0, LIVES + 1, 3 * FULL));
    assert_eq!(committed(&run.replay(), MAX_ACTORS), expected);
    assert!(
        leftovers[LIVES as usize - 1] <= leftovers[9],
        "files of the run after each life: {leftovers:?}"
    );
}
