//! The child processes. Each opens its channels, prints `ready`, and executes commands from its standard input until
//! that closes.

use std::cell::Cell;
use std::io::{BufRead, Write};
use std::path::PathBuf;
use std::sync::mpsc::{self, Receiver, TryRecvError};
use std::time::{Duration, Instant};

use shoal_common::channel::environment::{EnvironmentPort, RequestKind};
use shoal_common::channel::policy::{PolicyHeader, PolicyPublisher};
use shoal_common::channel::transitions::ChunkSender;
use shoal_common::channel::{Domain, EventName, HeartbeatSender, Listener, Notifier, Services, wait_for};
use shoal_common::commit::CommitReader;
use shoal_common::role::{Role, RoleInstance};
use shoal_common::stop::Stop;
use shoal_env_server::server;
use shoal_env_server::vector::VectorEnvironment;
use shoal_learner::process::intake::Intake;
use shoal_learner::replay::{Replay, ReplayError, WriteStep};

use crate::chunks::{ROWS, WINDOW, chunk_layout, fill, replay_layout};
use crate::process::MARK;

pub(crate) const ROLE: &str = "SHOAL_TEST_ROLE";
pub(crate) const RUN: &str = "SHOAL_TEST_RUN";
pub(crate) const DIRECTORY: &str = "SHOAL_TEST_DIRECTORY";

pub(crate) const MAX_ACTORS: u32 = 4;
/// Environments per server.
pub(crate) const ENVS: u32 = 2;
pub(crate) const PARAMETERS: usize = 5_000;
pub(crate) const FINGERPRINT: u64 = 77;

const POLL: Duration = Duration::from_millis(50);

pub(crate) fn main() {
    // Without the variable, a user runs the ignored tests by hand.
    let Ok(role) = std::env::var(ROLE) else { return };
    iceoryx2::prelude::set_log_level(iceoryx2::prelude::LogLevel::Fatal);
    let domain = Domain::join(&std::env::var(RUN).unwrap(), MAX_ACTORS).unwrap();
    let replay = PathBuf::from(std::env::var_os(DIRECTORY).unwrap()).join("replay.rows");
    let number = |word: &str| word.parse().unwrap();
    match role.split(' ').collect::<Vec<_>>()[..] {
        ["host"] => host(&domain),
        ["actor", index, incarnation] => actor(&domain, &replay, number(index) as u32, number(incarnation)),
        ["learner", actors] => learner(&domain, &replay, number(actors) as u32, None),
        ["learner", actors, "stalls-at", step, after] => {
            learner(&domain, &replay, number(actors) as u32, Some((step, number(after))));
        }
        ["policy-publisher", incarnation] => policy_publisher(&domain, number(incarnation)),
        ["env-server"] => env_server(&domain),
        ["env-server", "mute"] => mute_env_server(&domain),
        _ => panic!("no such role: {role}"),
    }
    domain.leave().unwrap();
}

fn reply(line: &str) {
    let mut stdout = std::io::stdout().lock();
    // The test harness has begun a line.
    write!(stdout, "\n{MARK}{line}\n")
        .and_then(|()| stdout.flush())
        .unwrap();
}

/// The lines of standard input. The channel closes with it.
fn commands() -> Receiver<String> {
    let (sender, commands) = mpsc::channel();
    std::thread::spawn(move || {
        let lines = std::io::stdin().lock().lines().map_while(Result::ok);
        lines.for_each(|line| drop(sender.send(line)));
    });
    commands
}

fn words(command: &str) -> (&str, u64) {
    let (word, number) = command.split_once(' ').unwrap_or((command, "0"));
    (word, number.parse().unwrap())
}

/// Prints a line and then sleeps until the process is killed.
fn stall(line: &str) -> ! {
    reply(line);
    loop {
        std::thread::park();
    }
}

/// Creates and holds the services of the run, as the launcher does.
fn host(domain: &Domain) {
    let mut services = Services::new(domain).unwrap();
    services.create_common(domain).unwrap();
    (0..MAX_ACTORS).for_each(|index| services.create_actor(domain, index, WINDOW).unwrap());
    reply("ready");
    commands().iter().for_each(drop);
}

/// Commands, where S is the number of chunks sent so far:
///
/// - `send N`: sends N chunks; prints `sending S` after each, and `full S` when it starts to wait for a full window.
/// - `hold N`: fills N rows of a borrowed chunk, prints `holding` and sleeps until it is killed.
/// - `finish`: waits until all chunks are committed.
///
/// After `send` and `finish` it prints `done S M`, with the longest time of a `send` in µs.
fn actor(domain: &Domain, replay: &std::path::Path, index: u32, incarnation: u64) {
    let listener = Listener::bind(domain, EventName(Role::Actor, index)).unwrap();
    let learner = Notifier::new(domain, EventName(Role::Learner, 0)).unwrap();
    let commits = loop {
        if let Some(commits) = CommitReader::open_if_ready(replay).unwrap() {
            break commits;
        }
        listener.wait(Duration::from_millis(5)).unwrap();
    };
    let handshake = ChunkSender::open(domain, index, incarnation, chunk_layout(), WINDOW).unwrap();
    reply("ready");
    let mut slowest = Duration::ZERO;
    let stop = Stop::default();
    let commands = commands();
    // The numbers it prints count from its own start.
    let full = |waits: &Cell<bool>, sent: u64| {
        if !waits.replace(true) {
            reply(&format!("full {sent}"));
        }
    };
    let Ok(first) = commands.recv() else { return };
    let waits = Cell::new(false);
    let mut sender = handshake.wait(&commits, &listener, &stop, || full(&waits, 0)).unwrap();
    let before = sender.sent();
    for command in std::iter::once(first).chain(commands) {
        let (word, count) = words(&command);
        let most_in_flight = match word {
            "send" => u64::from(WINDOW) - 1,
            "finish" => 0,
            "hold" => {
                let mut chunk = sender.empty_chunk().unwrap();
                fill(
                    &mut chunk,
                    (index, incarnation, sender.sent() + 1 - before),
                    count as usize,
                );
                stall("holding");
            }
            _ => panic!("no such command: {command}"),
        };
        for _ in 0..count.max(1) {
            let waits = Cell::new(false);
            let committed = || commits.committed(index as usize);
            wait_for(
                &listener,
                &stop,
                || Ok((sender.in_flight(committed()) <= most_in_flight).then_some(())),
                || {
                    full(&waits, sender.sent() - before);
                    sender.refresh_connections()
                },
            )
            .unwrap();
            if word == "send" {
                let mut chunk = sender.empty_chunk().unwrap();
                fill(&mut chunk, (index, incarnation, sender.sent() + 1 - before), ROWS);
                let begun = Instant::now();
                sender.send(chunk, 0).unwrap();
                slowest = slowest.max(begun.elapsed());
                learner.notify();
                reply(&format!("sending {}", sender.sent() - before));
            }
        }
        reply(&format!("done {} {}", sender.sent() - before, slowest.as_micros()));
    }
}

/// Commands:
///
/// - `take N`: receives N more chunks, then prints `took`.
/// - `crawl`: receives one chunk per millisecond.
/// - `run`: receives everything.
///
/// It receives nothing before its first command. With `stalls_at` it receives from the start, and prints `stalled` and
/// sleeps when more than the given number of chunks have passed this step of a write.
fn learner(domain: &Domain, path: &std::path::Path, actors: u32, stalls_at: Option<(&str, u64)>) {
    let listener = Listener::bind(domain, EventName(Role::Learner, 0)).unwrap();
    let mut replay = match Replay::open(path, &replay_layout(MAX_ACTORS)) {
        Err(ReplayError::Missing(_)) => Replay::create(path, &replay_layout(MAX_ACTORS)).unwrap(),
        opened => opened.unwrap(),
    };
    if let Some((name, after)) = stalls_at {
        let name = name.to_owned();
        let mut passed = 0;
        replay.on_step(move |step: WriteStep| {
            if format!("{step:?}") == name {
                passed += 1;
                if passed > after {
                    stall("stalled");
                }
            }
        });
    }
    let mut intake = Intake::open(domain, actors, WINDOW, chunk_layout(), u64::MAX).unwrap();
    reply("ready");
    let commands = commands();
    let mut quota = if stalls_at.is_some() { u64::MAX } else { replay.head() };
    let (mut busy, mut crawls) = (false, false);
    loop {
        match commands.try_recv().as_deref().map(words) {
            Ok(("take", chunks)) => (quota, busy) = (replay.head() + chunks * ROWS as u64, true),
            Ok(("crawl", _)) => crawls = true,
            Ok(("run", _)) => quota = u64::MAX,
            Ok((word, _)) => panic!("no such command: {word}"),
            Err(TryRecvError::Disconnected) => return,
            Err(TryRecvError::Empty) => {}
        }
        if crawls {
            // Makes this learner slow on purpose.
            std::thread::sleep(Duration::from_millis(1));
            quota += ROWS as u64;
        }
        let took_any = intake
            .take_in_turn(&mut replay, 8, |replay| replay.head() >= quota)
            .unwrap();
        if busy && replay.head() >= quota {
            busy = false;
            reply("took");
        }
        if !took_any && !crawls {
            listener.wait(POLL).unwrap();
        }
    }
}

/// Command: `publish V` publishes a policy whose parameters are all V, then prints `published`.
fn policy_publisher(domain: &Domain, incarnation: u64) {
    let publisher = PolicyPublisher::open(domain, PARAMETERS).unwrap();
    reply("ready");
    let commands = commands();
    loop {
        match commands.recv_timeout(POLL).as_deref().map(words) {
            Ok((_, version)) => {
                let header = PolicyHeader {
                    incarnation,
                    version,
                    fingerprint: FINGERPRINT,
                    ..Default::default()
                };
                publisher.publish(&[version as f32; PARAMETERS], header).unwrap();
                reply("published");
            }
            Err(mpsc::RecvTimeoutError::Timeout) => publisher.refresh_connections().unwrap(),
            Err(mpsc::RecvTimeoutError::Disconnected) => return,
        }
    }
}

pub(crate) fn pendulums() -> VectorEnvironment {
    VectorEnvironment::new("pendulum", &toml::Table::new(), ENVS, 1, 0, 0).unwrap()
}

fn port(domain: &Domain, environments: &VectorEnvironment) -> EnvironmentPort {
    EnvironmentPort::open(
        domain,
        0,
        environments.spec().clone(),
        ENVS as usize,
        EventName(Role::Actor, 0),
    )
    .unwrap()
}

fn env_server(domain: &Domain) {
    let mut environments = pendulums();
    let port = port(domain, &environments);
    let instance = RoleInstance {
        role: Role::EnvServer,
        index: 0,
        incarnation: 0,
    };
    let heartbeat = HeartbeatSender::new(domain, instance).unwrap();
    let stop = Stop::when_stdin_closes().unwrap();
    reply("ready");
    server::run(&mut environments, &port, 1, heartbeat, &stop).unwrap();
}

/// A server that prints `asked` at the first request for a step or snapshot, and never answers it.
fn mute_env_server(domain: &Domain) {
    let mut environments = pendulums();
    let port = port(domain, &environments);
    reply("ready");
    let stop = Stop::when_stdin_closes().unwrap();
    while let Ok(request) = port.next(&stop, || ()) {
        if matches!(request.kind(), Some(RequestKind::Step | RequestKind::Snapshot)) {
            stall("asked");
        }
        let start = shoal_env_server::vector::Reset::Next;
        request
            .respond(|_, blocks| environments.reset(start, blocks.observations))
            .unwrap()
            .unwrap();
    }
}
