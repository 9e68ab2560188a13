//! Environment servers that die or are stopped between a request and its answer.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use rustix::process::Signal;
use shoal_common::channel::environment::{
    EnvironmentClient, EnvironmentResponse, ResetRequest, SnapshotResult, StepResult,
};
use shoal_common::channel::{ChannelError, Domain, EventName, Listener};
use shoal_common::exit::Exit;
use shoal_common::role::Role;

use crate::children::{ENVS, pendulums};
use crate::run::{Run, TIMEOUT, Watchdog};

const ACTIONS: [f32; ENVS as usize] = [0.5; ENVS as usize];

/// A client of an environment server, as an actor has it.
struct TestClient {
    listener: Listener,
    inner: EnvironmentClient,
    _watchdog: Watchdog,
}

impl TestClient {
    fn new(domain: &Domain) -> Self {
        let watchdog = Watchdog::new();
        let environments = pendulums();
        let listener = Listener::bind(domain, EventName(Role::Actor, 0)).unwrap();
        let client = EnvironmentClient::open(domain, 0, environments.spec(), ENVS as usize, watchdog.stop.clone());
        Self {
            listener,
            inner: client.unwrap(),
            _watchdog: watchdog,
        }
    }

    fn reset(&self) -> EnvironmentResponse {
        self.reset_while(|| ())
    }

    /// `idle` is called repeatedly during the wait.
    fn reset_while(&self, idle: impl FnMut()) -> EnvironmentResponse {
        self.inner
            .reset(&self.listener, ResetRequest::Next, idle)
            .expect("no hang")
    }

    fn step(&self) -> StepResult {
        self.step_while(|| ())
    }

    fn step_while(&self, idle: impl FnMut()) -> StepResult {
        self.inner.step(&self.listener, &ACTIONS, idle).expect("no hang")
    }

    fn snapshot(&self) -> SnapshotResult {
        self.inner.snapshot(&self.listener, || ()).expect("no hang")
    }

    fn take_snapshot(&self) -> Vec<u64> {
        match self.snapshot() {
            SnapshotResult::Taken(words) => words,
            SnapshotResult::Lost => panic!("the server is running and was reset"),
        }
    }

    fn restore(&self, words: &[u64]) -> Result<EnvironmentResponse, Exit<ChannelError>> {
        self.restore_while(words, || ())
    }

    fn restore_while(&self, words: &[u64], idle: impl FnMut()) -> Result<EnvironmentResponse, Exit<ChannelError>> {
        self.inner.restore(&self.listener, words, idle)
    }

    /// The results of the next `steps` steps, as bits.
    fn future(&self, steps: u32) -> Vec<u32> {
        let mut seen = Vec::new();
        for _ in 0..steps {
            let StepResult::Taken(observed) = self.step() else {
                panic!("the server is running and was reset")
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
            let StepResult::Taken(observed) = self.step() else {
                panic!("the server is running and was reset")
            };
            assert!((0..ENVS as usize).all(|e| !observed.terminated(e) && observed.reward(e) < 0.0));
        }
    }
}

/// An `idle` function that signals each of its calls.
fn notify(waits: &Sender<()>) -> impl FnMut() {
    move || {
        // The receiver may be gone.
        let _ = waits.send(());
    }
}

/// Returns once a client has polled several times for its answer.
fn expect_several_polls(waiting: Receiver<()>) {
    for _ in 0..5 {
        waiting.recv_timeout(TIMEOUT).expect("the client waits");
    }
}

#[test]
fn a_step_is_lost_if_its_server_is_killed_and_the_next_server_takes_over() {
    let run = Run::new();
    let domain = run.join();
    let mut mute = run.start("env-server mute");
    let client = TestClient::new(&domain);
    let seen = client.reset();
    let before = seen.observations().to_vec();
    std::thread::scope(|scope| {
        let killer = scope.spawn(|| {
            mute.expect_line("asked");
            mute.kill();
            run.start("env-server")
        });
        assert!(matches!(client.step(), StepResult::Lost));
        let _server = killer.join().unwrap();
        assert_eq!(seen.observations(), before, "the dead server's answer stays readable");
        assert!(
            matches!(client.step(), StepResult::Lost),
            "the new server has no episode"
        );
        client.reset();
        client.steps(10);
    });
}

#[test]
fn without_a_server_a_step_is_lost_and_a_reset_waits_for_one() {
    let run = Run::new();
    let domain = run.join();
    let mut server = run.start("env-server");
    let client = TestClient::new(&domain);
    client.reset();
    client.steps(10);
    server.kill();
    assert!(matches!(client.step(), StepResult::Lost));
    std::thread::scope(|scope| {
        let (waits, waiting) = channel();
        let starter = scope.spawn(|| {
            expect_several_polls(waiting);
            run.start("env-server")
        });
        client.reset_while(notify(&waits));
        let _server = starter.join().unwrap();
        client.steps(10);
    });
}

#[test]
fn servers_killed_at_any_moment_never_block_the_client() {
    let run = Run::new();
    let domain = run.join();
    let client = TestClient::new(&domain);
    let mut server = run.start("env-server");
    for kill in 0..6 {
        client.reset();
        let killer = std::thread::spawn(move || {
            // Each time at a different moment of a step.
            std::thread::sleep(Duration::from_micros(kill * 1_777));
            server.kill();
        });
        while matches!(client.step(), StepResult::Taken(_)) {}
        killer.join().unwrap();
        server = run.launch("env-server");
    }
    client.reset();
    client.steps(3);
    server.end();
}

#[test]
fn a_stopped_server_answers_when_it_continues() {
    let run = Run::new();
    let domain = run.join();
    let server = run.start("env-server");
    let client = TestClient::new(&domain);
    client.reset();
    client.steps(3);
    server.stop();
    let (waits, waiting) = channel();
    let waker = std::thread::spawn(move || {
        expect_several_polls(waiting);
        server.signal(Signal::CONT);
        server
    });
    assert!(matches!(client.step_while(notify(&waits)), StepResult::Taken(_)));
    let server = waker.join().unwrap();
    client.steps(3);
    server.end();
}

/// Enough steps to pass the ends of two episodes.
const FUTURE: u32 = 450;

#[test]
fn a_new_server_continues_a_killed_ones_episodes_bit_for_bit() {
    let run = Run::new();
    let domain = run.join();
    let mut server = run.start("env-server");
    let client = TestClient::new(&domain);
    assert_eq!(client.snapshot(), SnapshotResult::Lost, "no episode has begun");
    client.reset();
    client.steps(237);
    let words = client.take_snapshot();
    let whole = client.future(FUTURE);
    server.kill();
    assert_eq!(client.snapshot(), SnapshotResult::Lost);
    let _server = run.start("env-server");
    assert_eq!(client.snapshot(), SnapshotResult::Lost, "the new server has no episode");
    assert!(matches!(client.step(), StepResult::Lost));
    let observed = client.restore(&words).unwrap().observations().to_vec();
    assert_eq!(client.take_snapshot(), words);
    assert_eq!(client.future(FUTURE), whole);
    let again = client.restore(&words).unwrap();
    assert_eq!(again.observations(), observed, "the same server can be restored too");
    assert_eq!(client.future(FUTURE), whole);
}

#[test]
fn a_snapshot_is_lost_if_its_server_is_killed_and_a_restore_waits_for_the_next() {
    let run = Run::new();
    let domain = run.join();
    let client = TestClient::new(&domain);
    let mut server = run.start("env-server");
    client.reset();
    client.steps(10);
    let words = client.take_snapshot();
    let whole = client.future(10);
    server.kill();
    let mut mute = run.start("env-server mute");
    client.reset();
    std::thread::scope(|scope| {
        let killer = scope.spawn(|| {
            mute.expect_line("asked");
            mute.kill();
        });
        assert_eq!(client.snapshot(), SnapshotResult::Lost);
        killer.join().unwrap();
        let (waits, waiting) = channel();
        let starter = scope.spawn(|| {
            expect_several_polls(waiting);
            run.start("env-server")
        });
        client.restore_while(&words, notify(&waits)).unwrap();
        let _server = starter.join().unwrap();
        assert_eq!(client.future(10), whole);
    });
}

#[test]
fn an_invalid_snapshot_is_refused_and_the_server_continues() {
    let run = Run::new();
    let domain = run.join();
    let _server = run.start("env-server");
    let client = TestClient::new(&domain);
    let garbage = [u64::MAX; ENVS as usize * 5];
    let refusal = |words: &[u64]| client.restore(words).unwrap_err().to_string();
    assert!(refusal(&garbage).contains("refused"));
    assert!(
        matches!(client.step(), StepResult::Lost),
        "a refused snapshot starts no episode"
    );
    client.reset();
    let words = client.take_snapshot();
    assert!(refusal(&garbage).contains("refused"));
    assert!(refusal(&garbage[1..]).contains("the snapshot has 9 words instead of 10"));
    assert_eq!(client.take_snapshot(), words);
    client.steps(3);
}

#[test]
fn a_training_episode_depends_only_on_its_number() {
    let run = Run::new();
    let domain = run.join();
    let _server = run.start("env-server");
    let client = TestClient::new(&domain);
    let begin = |begin| {
        let observed = client.inner.reset(&client.listener, begin, || ()).expect("no hang");
        observed.observations().to_vec()
    };
    let [first, second] = [begin(ResetRequest::Next), begin(ResetRequest::Next)];
    assert_ne!(first, second);
    client.steps(10);
    assert_eq!(begin(ResetRequest::Training(0)), first);
    assert_eq!(begin(ResetRequest::Next), second, "the count continues from there");
    assert_eq!(begin(ResetRequest::Training(1)), second);
}
