//! Environment servers that die or pause between question and answer.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use rustix::process::Signal;
use shoal_common::channel::environment::{Begin, EnvironmentClient, Observed, Snapshot, Stepped};
use shoal_common::channel::{ChannelError, Domain, EventName, Listener};
use shoal_common::exit::Exit;
use shoal_common::report::Role;

use crate::children::{ENVS, pendulums};
use crate::run::{DEADLINE, Run, Watchdog};

const ACTIONS: [f32; ENVS as usize] = [0.5; ENVS as usize];

/// An actor's end of the conversation.
struct Asker {
    listener: Listener,
    client: EnvironmentClient,
    _watchdog: Watchdog,
}

impl Asker {
    fn new(domain: &Domain) -> Self {
        let watchdog = Watchdog::new();
        let environments = pendulums();
        let listener = Listener::bind(domain, EventName(Role::Actor, 0)).unwrap();
        let client = EnvironmentClient::open(domain, 0, environments.spec(), ENVS as usize, watchdog.stop.clone());
        Self {
            listener,
            client: client.unwrap(),
            _watchdog: watchdog,
        }
    }

    fn reset(&self) -> Observed {
        self.reset_while(|| ())
    }

    /// `idle` is called again and again while it waits.
    fn reset_while(&self, idle: impl FnMut()) -> Observed {
        self.client.reset(&self.listener, Begin::Next, idle).expect("no hang")
    }

    fn step(&self) -> Stepped {
        self.step_while(|| ())
    }

    fn step_while(&self, idle: impl FnMut()) -> Stepped {
        self.client.step(&self.listener, &ACTIONS, idle).expect("no hang")
    }

    fn snapshot(&self) -> Snapshot {
        self.client.snapshot(&self.listener, || ()).expect("no hang")
    }

    fn taken(&self) -> Vec<u64> {
        match self.snapshot() {
            Snapshot::Taken(words) => words,
            Snapshot::Lost => panic!("the server lives and was reset"),
        }
    }

    fn restore(&self, words: &[u64]) -> Result<Observed, Exit<ChannelError>> {
        self.restore_while(words, || ())
    }

    fn restore_while(&self, words: &[u64], idle: impl FnMut()) -> Result<Observed, Exit<ChannelError>> {
        self.client.restore(&self.listener, words, idle)
    }

    /// All that comes of so many steps, as bits.
    fn future(&self, steps: u32) -> Vec<u32> {
        let mut seen = Vec::new();
        for _ in 0..steps {
            let Stepped::Taken(observed) = self.step() else {
                panic!("the server lives and was reset")
            };
            for e in 0..ENVS as usize {
                seen.extend(observed.observation(e).iter().map(|x| x.to_bits()));
                seen.extend(observed.next_observation(e).iter().map(|x| x.to_bits()));
                seen.push(observed.reward(e).to_bits());
                seen.push(u32::from(observed.terminated(e)) << 1 | u32::from(observed.truncated(e)));
            }
        }
        seen
    }

    fn steps(&self, count: u32) {
        for _ in 0..count {
            let Stepped::Taken(observed) = self.step() else {
                panic!("the server lives and was reset")
            };
            assert!((0..ENVS as usize).all(|e| !observed.terminated(e) && observed.reward(e) < 0.0));
        }
    }
}

/// What a client does while it waits.
fn tells(waits: &Sender<()>) -> impl FnMut() {
    move || {
        // It may wait longer than anybody listens.
        let _ = waits.send(());
    }
}

/// Returns when a client has napped over its question several times.
fn waits_several_times(waiting: Receiver<()>) {
    for _ in 0..5 {
        waiting.recv_timeout(DEADLINE).expect("the client waits");
    }
}

#[test]
fn a_step_whose_server_is_killed_before_it_answers_is_lost_and_the_next_server_goes_on() {
    let run = Run::new();
    let domain = run.join();
    let mut doomed = run.start("env-server that-never-answers");
    let asker = Asker::new(&domain);
    let seen = asker.reset();
    let before = seen.observations().to_vec();
    std::thread::scope(|scope| {
        let killer = scope.spawn(|| {
            doomed.says("asked");
            doomed.kill();
            run.start("env-server")
        });
        assert!(matches!(asker.step(), Stepped::Lost));
        let _server = killer.join().unwrap();
        assert_eq!(seen.observations(), before, "what the dead server said stays readable");
        assert!(matches!(asker.step(), Stepped::Lost), "the new server knows no episode");
        asker.reset();
        asker.steps(10);
    });
}

#[test]
fn a_step_asked_while_no_server_lives_is_lost_and_a_reset_waits_for_one() {
    let run = Run::new();
    let domain = run.join();
    let mut server = run.start("env-server");
    let asker = Asker::new(&domain);
    asker.reset();
    asker.steps(10);
    server.kill();
    assert!(matches!(asker.step(), Stepped::Lost));
    std::thread::scope(|scope| {
        let (waits, waiting) = channel();
        let starter = scope.spawn(|| {
            waits_several_times(waiting);
            run.start("env-server")
        });
        asker.reset_while(tells(&waits));
        let _server = starter.join().unwrap();
        asker.steps(10);
    });
}

#[test]
fn servers_killed_at_any_moment_never_hold_the_client_up() {
    let run = Run::new();
    let domain = run.join();
    let asker = Asker::new(&domain);
    let mut server = run.start("env-server");
    for kill in 0..6 {
        asker.reset();
        let killer = std::thread::spawn(move || {
            // Each time at another moment of a step.
            std::thread::sleep(Duration::from_micros(kill * 1_777));
            server.kill();
        });
        while matches!(asker.step(), Stepped::Taken(_)) {}
        killer.join().unwrap();
        server = run.launch("env-server");
    }
    asker.reset();
    asker.steps(3);
    server.ends();
}

#[test]
fn a_server_that_is_stopped_for_a_while_answers_when_it_goes_on() {
    let run = Run::new();
    let domain = run.join();
    let server = run.start("env-server");
    let asker = Asker::new(&domain);
    asker.reset();
    asker.steps(3);
    server.stop();
    let (waits, waiting) = channel();
    let waker = std::thread::spawn(move || {
        waits_several_times(waiting);
        server.signal(Signal::CONT);
        server
    });
    assert!(matches!(asker.step_while(tells(&waits)), Stepped::Taken(_)));
    let server = waker.join().unwrap();
    asker.steps(3);
    server.ends();
}

/// Steps beyond the ends of two episodes.
const FUTURE: u32 = 450;

#[test]
fn a_new_server_goes_on_where_a_killed_one_was_bit_for_bit() {
    let run = Run::new();
    let domain = run.join();
    let mut server = run.start("env-server");
    let asker = Asker::new(&domain);
    assert_eq!(asker.snapshot(), Snapshot::Lost, "no episode is under way");
    asker.reset();
    asker.steps(237);
    let words = asker.taken();
    let whole = asker.future(FUTURE);
    server.kill();
    assert_eq!(asker.snapshot(), Snapshot::Lost);
    let _server = run.start("env-server");
    assert_eq!(asker.snapshot(), Snapshot::Lost, "the new server knows no episode");
    assert!(matches!(asker.step(), Stepped::Lost));
    let observed = asker.restore(&words).unwrap().observations().to_vec();
    assert_eq!(asker.taken(), words);
    assert_eq!(asker.future(FUTURE), whole);
    let again = asker.restore(&words).unwrap();
    assert_eq!(again.observations(), observed, "the same server can go back too");
    assert_eq!(asker.future(FUTURE), whole);
}

#[test]
fn a_snapshot_whose_server_is_killed_before_it_answers_is_lost_and_a_restore_waits_for_the_next() {
    let run = Run::new();
    let domain = run.join();
    let asker = Asker::new(&domain);
    let mut server = run.start("env-server");
    asker.reset();
    asker.steps(10);
    let words = asker.taken();
    let whole = asker.future(10);
    server.kill();
    let mut doomed = run.start("env-server that-never-answers");
    asker.reset();
    std::thread::scope(|scope| {
        let killer = scope.spawn(|| {
            doomed.says("asked");
            doomed.kill();
        });
        assert_eq!(asker.snapshot(), Snapshot::Lost);
        killer.join().unwrap();
        let (waits, waiting) = channel();
        let starter = scope.spawn(|| {
            waits_several_times(waiting);
            run.start("env-server")
        });
        asker.restore_while(&words, tells(&waits)).unwrap();
        let _server = starter.join().unwrap();
        assert_eq!(asker.future(10), whole);
    });
}

#[test]
fn words_that_are_no_snapshot_are_refused_and_the_server_goes_on() {
    let run = Run::new();
    let domain = run.join();
    let _server = run.start("env-server");
    let asker = Asker::new(&domain);
    let garbage = [u64::MAX; ENVS as usize * 5];
    let refusal = |words: &[u64]| asker.restore(words).unwrap_err().to_string();
    assert!(refusal(&garbage).contains("refused"));
    assert!(matches!(asker.step(), Stepped::Lost), "what is refused starts nothing");
    asker.reset();
    let words = asker.taken();
    assert!(refusal(&garbage).contains("refused"));
    assert!(refusal(&garbage[1..]).contains("9 words for a snapshot of 10"));
    assert_eq!(asker.taken(), words);
    asker.steps(3);
}

#[test]
fn a_training_episode_is_begun_by_its_number_whatever_came_before() {
    let run = Run::new();
    let domain = run.join();
    let _server = run.start("env-server");
    let asker = Asker::new(&domain);
    let begin = |begin| {
        let observed = asker.client.reset(&asker.listener, begin, || ()).expect("no hang");
        observed.observations().to_vec()
    };
    let [first, second] = [begin(Begin::Next), begin(Begin::Next)];
    assert_ne!(first, second);
    asker.steps(10);
    assert_eq!(begin(Begin::Training(0)), first);
    assert_eq!(begin(Begin::Next), second, "it counts on from there");
    assert_eq!(begin(Begin::Training(1)), second);
}
