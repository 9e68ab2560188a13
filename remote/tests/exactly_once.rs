//! One actor's chunks over a network that loses, repeats and reorders, while every process of both hosts is restarted
//! at any moment, and the learner's host loses power. Whatever happens, the learner never sees a gap, and commits each
//! chunk at most once and in order; once the network is good, all chunks are committed that no killed actor took with
//! it.

#![allow(clippy::expect_used, reason = "a test that panics has failed")]

use std::collections::VecDeque;
use std::time::Duration;

use proptest::prelude::*;
use shoal_common::commit::ChunkId;
use shoal_remote::forwarding::{ChunkOrder, Forwarding};
use shoal_remote::uncommitted::{ActorFollowUp, UncommittedChunks};

const WINDOW: usize = 3;
const TIMEOUT: Duration = Duration::from_millis(200);
/// No process has such an incarnation.
const LIMIT: u64 = u64::MAX;

/// What a chunk holds here: who made it, and its number among those of the same incarnation. A handshake holds nothing.
type Content = Option<(u64, u64)>;

#[derive(Clone, Copy, Debug)]
struct Sent {
    id: ChunkId,
    content: Content,
}

#[derive(Clone, Copy, Debug)]
struct Acknowledgement {
    gate: u64,
    number: u64,
    forwarded: ChunkId,
    committed: ChunkId,
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
    GateAcknowledges,
    AcknowledgementArrives(usize),
    AcknowledgementIsLost(usize),
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
    acknowledgements: u64,
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
    relay: UncommittedChunks<Content>,
    /// The relay's file: it lasts over its restarts, and the actor reads it.
    mirror: ChunkId,
    /// Of the newest acknowledgement that the relay has seen.
    seen: (u64, u64),
    up: Vec<Sent>,
    down: Vec<Acknowledgement>,
    gate: Gate,
    /// What the learner has not taken, from each gate that it was connected to.
    to_learner: Vec<(u64, VecDeque<Sent>)>,
    committed: ChunkId,
    log: Vec<(u64, u64)>,
    /// What was committed after each chunk; a power loss returns to one of these.
    past: Vec<(ChunkId, usize)>,
    /// Whether chunks may have been lost with a killed actor, or in a power loss.
    may_have_lost: bool,
    made: Vec<(u64, u64)>,
}

impl World {
    fn new() -> Self {
        let none = ChunkId::default();
        let mut world = Self {
            now: Duration::ZERO,
            started: 0,
            actor: Actor::default(),
            to_relay: VecDeque::new(),
            relay: UncommittedChunks::new(none),
            mirror: none,
            seen: (0, 0),
            up: Vec::new(),
            down: Vec::new(),
            gate: Gate {
                life: 0,
                acknowledgements: 0,
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
        let id = ChunkId {
            incarnation: self.actor.incarnation,
            sequence,
        };
        let sent = Sent { id, content };
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
            acknowledgements: 0,
            forwarding: Forwarding::new(self.committed, WINDOW as u32),
            history: VecDeque::new(),
        };
        self.to_learner.push((life, VecDeque::new()));
    }

    fn happens(&mut self, event: Event) {
        match event {
            Event::ActorWorks => self.actor_works(),
            Event::RelayReceives => {
                if let Some(Sent { id, content }) = self.to_relay.pop_front() {
                    let follow_up = self.relay.add(id, content, self.now);
                    self.follow_up_on(follow_up);
                    assert!(self.relay.len() <= 2 * WINDOW + 2, "too much is kept: {self:?}");
                }
            }
            Event::RelaySends => {
                if let Some(kept) = self.relay.next() {
                    self.up.push(Sent {
                        id: kept.id,
                        content: kept.chunk,
                    });
                    self.relay.note_sent();
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
            Event::GateAcknowledges => {
                self.gate.forwarding.commit(self.committed);
                self.gate.acknowledgements += 1;
                self.down.push(Acknowledgement {
                    gate: self.gate.life,
                    number: self.gate.acknowledgements,
                    forwarded: self.gate.forwarding.last_forwarded(),
                    committed: self.gate.forwarding.committed(),
                });
            }
            Event::AcknowledgementArrives(which) if !self.down.is_empty() => {
                let acknowledgement = self.down.remove(which % self.down.len());
                self.relay_learns(acknowledgement);
            }
            Event::AcknowledgementIsLost(which) if !self.down.is_empty() => {
                self.down.remove(which % self.down.len());
            }
            Event::TimePasses => {
                self.now += TIMEOUT / 2;
                self.relay.go_back_if_overdue(self.now, TIMEOUT);
            }
            Event::ActorIsKilled => {
                self.may_have_lost = true;
                self.start_actor();
            }
            Event::RelayIsKilled => {
                self.relay = UncommittedChunks::new(self.mirror);
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
        if self.gate.forwarding.offer(sent.id) != ChunkOrder::Next {
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
        let Some(Sent { id, content }) = self.to_learner[from].1.pop_front() else {
            return;
        };
        let id = ChunkId {
            sequence: if id.sequence == 0 {
                self.committed.sequence
            } else {
                id.sequence
            },
            ..id
        };
        if id <= self.committed {
            return;
        }
        assert!(
            id.is_next(self.committed),
            "the learner would fail: {id:?} after {:?}",
            self.committed
        );
        self.committed = id;
        self.log.extend(content);
        self.past.push((id, self.log.len()));
    }

    fn relay_learns(&mut self, acknowledgement: Acknowledgement) {
        if (acknowledgement.gate, acknowledgement.number) <= self.seen {
            return;
        }
        let other_gate = acknowledgement.gate != self.seen.0;
        self.seen = (acknowledgement.gate, acknowledgement.number);
        let follow_up = self
            .relay
            .acknowledge(acknowledgement.forwarded, acknowledgement.committed, LIMIT, self.now);
        self.mirror = acknowledgement.committed;
        self.follow_up_on(follow_up);
        if other_gate {
            self.relay.go_back(self.now);
        }
    }

    fn follow_up_on(&mut self, follow_up: ActorFollowUp) {
        match follow_up {
            ActorFollowUp::Restart(incarnation) if self.actor.incarnation <= incarnation => {
                assert!(self.may_have_lost);
                self.start_actor();
            }
            ActorFollowUp::Continue | ActorFollowUp::Restart(_) => {}
            ActorFollowUp::TakenOver => unreachable!("nobody else has this actor"),
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
                Event::GateAcknowledges,
                Event::AcknowledgementArrives(0),
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
        6 => Just(Event::GateAcknowledges),
        6 => any_of().prop_map(Event::AcknowledgementArrives),
        2 => any_of().prop_map(Event::AcknowledgementIsLost),
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
