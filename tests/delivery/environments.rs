//! Environment servers that die or pause between question and answer.

use std::time::Duration;

use rustix::process::Signal;
use shoal_common::channel::environment::{EnvironmentClient, Observed, ResponseLayout, Stepped};
use shoal_common::channel::{Bell, Domain, Place};
use shoal_common::report::Role;

use crate::children::{ENVS, pendulums};
use crate::run::{Run, Watchdog};

const ACTIONS: [f32; ENVS as usize] = [0.5; ENVS as usize];

/// An actor's end of the conversation.
struct Asker<'a> {
    domain: &'a Domain,
    bell: Bell,
    client: EnvironmentClient,
    _watchdog: Watchdog,
}

impl<'a> Asker<'a> {
    fn new(domain: &'a Domain) -> Self {
        let watchdog = Watchdog::new();
        let layout = ResponseLayout::new(ENVS as usize, pendulums().spec().observation.width());
        let bell = Bell::hang(domain, Place(Role::Actor, 0)).unwrap();
        let client = EnvironmentClient::open(domain, 0, layout, 1, watchdog.stop.clone()).unwrap();
        Self {
            domain,
            bell,
            client,
            _watchdog: watchdog,
        }
    }

    fn reset(&self) -> Observed {
        self.client.reset(self.domain, &self.bell, None).expect("no hang")
    }

    fn step(&self) -> Stepped {
        self.client.step(self.domain, &self.bell, &ACTIONS).expect("no hang")
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
        let starter = scope.spawn(|| {
            std::thread::sleep(Duration::from_millis(200));
            run.start("env-server")
        });
        asker.reset();
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
    server.signal(Signal::STOP);
    let waker = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_secs(1));
        server.signal(Signal::CONT);
        server
    });
    asker.steps(1);
    let server = waker.join().unwrap();
    asker.steps(3);
    server.ends();
}
