//! One actor's chunks over a network that loses, repeats and reorders, while every process of both hosts is restarted at
//! any moment, and the learner's host loses power. Whatever happens, the learner never sees a gap, and commits each chunk
//! at most once and in order; once the network is good, all chunks are committed that no killed actor took with it.

#![allow(clippy::expect_used, reason = "a test that panics has failed")]

use std::collections::VecDeque;
use std::time::Duration;

use proptest::prelude::*;
use shoal_common::commit::ChunkMark;
use shoal_remote::forwarding::{Forwarding, Offer};
use shoal_remote::unconfirmed::{Consequence, Unconfirmed};

const WINDOW: usize = 3;
const PATIENCE: Duration = Duration::from_millis(200);
/// No process has such an incarnation.
const LIMIT: u64 = u64::MAX;

/// What a chunk holds here: who made it, and its number among those of the same incarnation. A handshake holds nothing.
type Content = Option<(u64, u64)>;

#[derive(Clone, Copy, Debug)]
struct Sent {
    mark: ChunkMark,
    content: Content,
}

#[derive(Clone, Copy, Debug)]
struct Marks {
    gate: u64,
    number: u64,
    got: ChunkMark,
    committed: ChunkMark,
}

#[derive(Clone, Copy, Debug)]
enum Event {
    ActorWorks,
    RelayReceives,
    RelaySends,
    ChunkArrives(usize),
    ChunkIsLost(usize),
    ChunkIsRepeated(usize),
    LearnerTakes(usize),
    GateMarks,
    MarksArrive(usize),
    MarksAreLost(usize),
    TimePasses,
    ActorIsKilled,
    RelayIsKilled,
    GateIsKilled,
    LearnerIsKilled,
    PowerFails(usize),
}

#[derive(Debug, Default)]
struct Actor {
    incarnation: u64,
    /// The number of the last chunk; `None` before the handshake is committed.
    sequence: Option<u64>,
    made: u64,
    /// What a new relay receives: the newest chunks.
    history: VecDeque<Sent>,
}

#[derive(Debug)]
struct Gate {
    life: u64,
    marks: u64,
    forwarding: Forwarding,
    history: VecDeque<Sent>,
}

#[derive(Debug)]
struct World {
    now: Duration,
    started: u64,
    actor: Actor,
    /// On its way from actor to relay.
    to_relay: VecDeque<Sent>,
    relay: Unconfirmed<Content>,
    /// The relay's file: it lasts over its restarts, and the actor reads it.
    mirror: ChunkMark,
    /// Of the newest marks that the relay has seen.
    seen: (u64, u64),
    up: Vec<Sent>,
    down: Vec<Marks>,
    gate: Gate,
    /// What the learner has not taken, from each gate that it was connected to.
    to_learner: Vec<(u64, VecDeque<Sent>)>,
    committed: ChunkMark,
    log: Vec<(u64, u64)>,
    /// What was committed after each chunk; a power loss returns to one of these.
    past: Vec<(ChunkMark, usize)>,
    /// Whether chunks may have been lost with a killed actor, or in a power loss.
    may_have_lost: bool,
    made: Vec<(u64, u64)>,
}

impl World {
    fn new() -> Self {
        let none = ChunkMark::default();
        let mut world = Self {
            now: Duration::ZERO,
            started: 0,
            actor: Actor::default(),
            to_relay: VecDeque::new(),
            relay: Unconfirmed::new(none),
            mirror: none,
            seen: (0, 0),
            up: Vec::new(),
            down: Vec::new(),
            gate: Gate {
                life: 0,
                marks: 0,
                forwarding: Forwarding::new(none, WINDOW as u32),
                history: VecDeque::new(),
            },
            to_learner: Vec::new(),
            committed: none,
            log: Vec::new(),
            past: vec![(none, 0)],
            may_have_lost: false,
            made: Vec::new(),
        };
        world.start_gate();
        world.start_actor();
        world
    }

    fn start(&mut self) -> u64 {
        self.started += 1;
        self.started
    }

    fn start_actor(&mut self) {
        let incarnation = self.start();
        self.actor = Actor {
            incarnation,
            ..Actor::default()
        };
        self.send(0, None);
    }

    fn send(&mut self, sequence: u64, content: Content) {
        let mark = ChunkMark {
            incarnation: self.actor.incarnation,
            sequence,
        };
        let sent = Sent { mark, content };
        self.to_relay.push_back(sent);
        self.actor.history.push_back(sent);
        if self.actor.history.len() > WINDOW {
            self.actor.history.pop_front();
        }
    }

    fn start_gate(&mut self) {
        let life = self.start();
        self.gate = Gate {
            life,
            marks: 0,
            forwarding: Forwarding::new(self.committed, WINDOW as u32),
            history: VecDeque::new(),
        };
        self.to_learner.push((life, VecDeque::new()));
    }

    fn happens(&mut self, event: Event) {
        match event {
            Event::ActorWorks => self.actor_works(),
            Event::RelayReceives => {
                if let Some(Sent { mark, content }) = self.to_relay.pop_front() {
                    let consequence = self.relay.add(mark, content, self.now);
                    self.follow(consequence);
                    assert!(self.relay.len() <= 2 * WINDOW + 2, "too much is kept: {self:?}");
                }
            }
            Event::RelaySends => {
                if let Some(kept) = self.relay.next() {
                    self.up.push(Sent {
                        mark: kept.mark,
                        content: kept.chunk,
                    });
                    self.relay.sent();
                }
            }
            Event::ChunkArrives(which) if !self.up.is_empty() => {
                let sent = self.up.remove(which % self.up.len());
                self.gate_gets(sent);
            }
            Event::ChunkIsLost(which) if !self.up.is_empty() => {
                self.up.remove(which % self.up.len());
            }
            Event::ChunkIsRepeated(which) if !self.up.is_empty() => {
                let sent = self.up[which % self.up.len()];
                self.gate_gets(sent);
            }
            Event::LearnerTakes(which) => {
                let waiting: Vec<usize> = (0..self.to_learner.len())
                    .filter(|i| !self.to_learner[*i].1.is_empty())
                    .collect();
                if !waiting.is_empty() {
                    self.learner_takes(waiting[which % waiting.len()]);
                }
            }
            Event::GateMarks => {
                self.gate.forwarding.commit(self.committed);
                self.gate.marks += 1;
                self.down.push(Marks {
                    gate: self.gate.life,
                    number: self.gate.marks,
                    got: self.gate.forwarding.got(),
                    committed: self.gate.forwarding.committed(),
                });
            }
            Event::MarksArrive(which) if !self.down.is_empty() => {
                let marks = self.down.remove(which % self.down.len());
                self.relay_learns(marks);
            }
            Event::MarksAreLost(which) if !self.down.is_empty() => {
                self.down.remove(which % self.down.len());
            }
            Event::TimePasses => {
                self.now += PATIENCE / 2;
                self.relay.go_back_if_overdue(self.now, PATIENCE);
            }
            Event::ActorIsKilled => {
                self.may_have_lost = true;
                self.start_actor();
            }
            Event::RelayIsKilled => {
                self.relay = Unconfirmed::new(self.mirror);
                self.to_relay = self.actor.history.clone();
            }
            Event::GateIsKilled => self.start_gate(),
            Event::LearnerIsKilled => {
                self.to_learner = vec![(self.gate.life, self.gate.history.clone())];
            }
            Event::PowerFails(to) => {
                self.may_have_lost = true;
                self.past.truncate(1 + to % self.past.len());
                let (committed, rows) = self.past[self.past.len() - 1];
                self.committed = committed;
                self.log.truncate(rows);
                self.to_learner.clear();
                self.start_gate();
            }
            _ => {}
        }
    }

    fn actor_works(&mut self) {
        let Some(sequence) = self.actor.sequence else {
            if self.mirror.incarnation == self.actor.incarnation {
                self.actor.sequence = Some(self.mirror.sequence);
            }
            return;
        };
        if sequence.saturating_sub(self.mirror.sequence) < WINDOW as u64 {
            self.actor.sequence = Some(sequence + 1);
            self.actor.made += 1;
            let content = (self.actor.incarnation, self.actor.made);
            self.made.push(content);
            self.send(sequence + 1, Some(content));
        }
    }

    fn gate_gets(&mut self, sent: Sent) {
        if self.gate.forwarding.offer(sent.mark) != Offer::Next {
            return;
        }
        let history = &mut self.gate.history;
        history.push_back(sent);
        if history.len() > WINDOW {
            history.pop_front();
        }
        let life = self.gate.life;
        let connection = self.to_learner.iter_mut().find(|(gate, _)| *gate == life);
        let (_, queue) = connection.expect("the learner is connected to the living gate");
        queue.push_back(sent);
        assert!(queue.len() <= 2 * WINDOW, "the learner's buffer would overflow");
    }

    /// As the learner's intake and replay do.
    fn learner_takes(&mut self, from: usize) {
        let Some(Sent { mark, content }) = self.to_learner[from].1.pop_front() else {
            return;
        };
        let mark = ChunkMark {
            sequence: if mark.sequence == 0 {
                self.committed.sequence
            } else {
                mark.sequence
            },
            ..mark
        };
        if mark <= self.committed {
            return;
        }
        assert!(
            mark.is_next(self.committed),
            "the learner would fail: {mark:?} after {:?}",
            self.committed
        );
        self.committed = mark;
        self.log.extend(content);
        self.past.push((mark, self.log.len()));
    }

    fn relay_learns(&mut self, marks: Marks) {
        if (marks.gate, marks.number) <= self.seen {
            return;
        }
        let other_gate = marks.gate != self.seen.0;
        self.seen = (marks.gate, marks.number);
        let consequence = self.relay.confirm(marks.got, marks.committed, LIMIT, self.now);
        self.mirror = marks.committed;
        self.follow(consequence);
        if other_gate {
            self.relay.go_back(self.now);
        }
    }

    fn follow(&mut self, consequence: Consequence) {
        match consequence {
            Consequence::StartAgain(incarnation) if self.actor.incarnation <= incarnation => {
                assert!(self.may_have_lost);
                self.start_actor();
            }
            Consequence::Continue | Consequence::StartAgain(_) => {}
            Consequence::TakenOver => unreachable!("nobody else has this actor"),
        }
    }

    /// From now on nothing is lost. Returns whether everything arrives.
    fn settles(&mut self) -> bool {
        for _ in 0..200 {
            for event in [
                Event::RelayReceives,
                Event::RelaySends,
                Event::ChunkArrives(0),
                Event::LearnerTakes(0),
                Event::GateMarks,
                Event::MarksArrive(0),
                Event::TimePasses,
            ] {
                self.happens(event);
            }
            if self.actor.sequence.is_none() {
                self.actor_works();
            }
            let handshake_done = self.actor.sequence == Some(self.mirror.sequence);
            if handshake_done && self.relay.is_empty() && self.to_relay.is_empty() {
                return true;
            }
        }
        false
    }
}

fn event() -> impl Strategy<Value = Event> {
    let any_of = || any::<usize>();
    prop_oneof![
        12 => Just(Event::ActorWorks),
        12 => Just(Event::RelayReceives),
        12 => Just(Event::RelaySends),
        12 => any_of().prop_map(Event::ChunkArrives),
        3 => any_of().prop_map(Event::ChunkIsLost),
        3 => any_of().prop_map(Event::ChunkIsRepeated),
        12 => any_of().prop_map(Event::LearnerTakes),
        6 => Just(Event::GateMarks),
        6 => any_of().prop_map(Event::MarksArrive),
        2 => any_of().prop_map(Event::MarksAreLost),
        3 => Just(Event::TimePasses),
        1 => Just(Event::ActorIsKilled),
        1 => Just(Event::RelayIsKilled),
        1 => Just(Event::GateIsKilled),
        1 => Just(Event::LearnerIsKilled),
        1 => any_of().prop_map(Event::PowerFails),
    ]
}

fn without(events: Vec<Event>, excluded: impl Fn(&Event) -> bool) -> Vec<Event> {
    events.into_iter().filter(|event| !excluded(event)).collect()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_gap_and_no_repetition_whatever_happens(events in prop::collection::vec(event(), 0..400)) {
        let mut world = World::new();
        events.into_iter().for_each(|event| world.happens(event));
        prop_assert!(world.settles(), "chunks never arrive: {:?}", world);
        // Of each incarnation the first chunks, in order, each once; incarnations in order.
        for pair in world.log.windows(2) {
            let ((before, number), (after, next)) = (pair[0], pair[1]);
            let follows = if before == after { next == number + 1 } else { before < after && next == 1 };
            prop_assert!(follows, "{:?} in {:?}", pair, world.log);
        }
    }

    #[test]
    fn all_chunks_of_living_actors_are_committed(events in prop::collection::vec(event(), 0..400)) {
        let events = without(events, |event| matches!(event, Event::ActorIsKilled | Event::PowerFails(_)));
        let mut world = World::new();
        events.into_iter().for_each(|event| world.happens(event));
        prop_assert!(world.settles(), "chunks never arrive");
        prop_assert!(!world.may_have_lost);
        prop_assert_eq!(&world.log, &world.made);
    }

    #[test]
    fn what_the_relay_has_received_outlives_its_actor(events in prop::collection::vec(event(), 0..400)) {
        let events = without(events, |event| matches!(event, Event::RelayIsKilled | Event::PowerFails(_)));
        let mut world = World::new();
        let mut received = Vec::new();
        for event in events {
            if matches!(event, Event::RelayReceives) {
                received.extend(world.to_relay.front().and_then(|sent| sent.content));
            }
            world.happens(event);
        }
        prop_assert!(world.settles(), "chunks never arrive");
        for content in received {
            prop_assert!(world.log.contains(&content), "{:?} is lost", content);
        }
    }
}
