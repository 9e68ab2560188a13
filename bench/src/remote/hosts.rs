//! The processes of a measured remote run: learner and gate, and a relay on each joined host. This process is the
//! launcher of them all, and every actor: it sends chunks as fast as their windows allow.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, bail};
use rustix::process::Signal;
use shoal_common::channel::control::{ControlPort, ControlRequest, ControlResponse, HostLease};
use shoal_common::channel::transitions::ChunkSender;
use shoal_common::channel::{ChannelError, Domain, EventName, HeartbeatSender, Listener, Notifier, Services};
use shoal_common::commit::CommitReader;
use shoal_common::config::Config;
use shoal_common::role::{Activity, Role, RoleInstance};
use shoal_common::run_dir::{LockedRun, RunDir};
use shoal_remote::endpoint::Endpoint;
use shoal_remote::files::{HostFile, JoinFile, KeyFile};
use shoal_remote::keys::{self, Keys, VALIDITY};
use shoal_remote::wire::WireLease;
use shoal_run::child_process::{ChildProcess, role_command};
use shoal_run::joining::make_host_directory;
use shoal_run::preflight;
use shoal_run::signals::Interrupt;
use tempfile::TempDir;

use super::cable::{Cable, End};
use crate::measurement::{TimeBudget, interrupted};
use crate::progress::{STARTUP_TIMEOUT, wait_for_replay};
use crate::rows::{ENVIRONMENTS, Rows};
use crate::temporary_run::TemporaryRun;

/// Number of different chunks that are sent in turn.
const CHUNKS: usize = 64;

/// How often the requests of the gate are answered, at least.
const ANSWER_INTERVAL: Duration = Duration::from_millis(20);

/// The pause when every window is full.
const PAUSE: Duration = Duration::from_micros(100);

/// How late the loop may be because it has slept.
const MAX_LATENESS: Duration = Duration::from_millis(1);

/// What lies between the learner's host and the others.
#[derive(Debug)]
pub(super) enum Network {
    /// This machine's loopback device, without encryption.
    Loopback,
    /// A virtual cable, with encryption.
    Cable(Cable),
}

impl Network {
    /// A free address of the learner's host.
    fn endpoint(&self) -> anyhow::Result<Endpoint> {
        match self {
            Self::Loopback => Ok("tcp/127.0.0.1:0".parse::<Endpoint>()?.with_port(Duration::ZERO)?),
            // The port is free, because the namespace is new.
            Self::Cable(cable) => Ok(format!("tls/{}:7447", cable.address(End::Learner)).parse()?),
        }
    }

    fn command(&self, end: End, instance: RoleInstance, run: &Path) -> anyhow::Result<Command> {
        let command = role_command(instance, run);
        match self {
            Self::Loopback => Ok(command),
            Self::Cable(cable) => cable.at(end, &command),
        }
    }
}

/// A remote run whose actors are in this process.
pub(super) struct RemoteRun<'a> {
    budget: &'a TimeBudget,
    temporary: &'a TemporaryRun,
    network: &'a Network,
    launcher: Launcher<'a>,
    answered_at: Instant,
    gates: u64,
    gate: ChildProcess,
    learner: ChildProcess,
    replay: CommitReader,
    _services: Services,
    hosts: Vec<JoinedHost>,
    chunks: Vec<Vec<f32>>,
    next_chunk: usize,
    /// The time in which an actor fills a chunk.
    think: Duration,
    directory: TempDir,
}

/// What the launcher of the learner's host does for gate and learner.
struct Launcher<'a> {
    run: &'a RunDir,
    control: ControlPort,
    leases: Vec<HostLease>,
    /// Of the last actor, because the learner receives from all actors up to the last one that has sent a heartbeat.
    heartbeat: HeartbeatSender,
}

impl Launcher<'_> {
    /// Answers the gate.
    fn answer(&mut self) -> anyhow::Result<()> {
        self.heartbeat.beat(Activity::Working);
        let leases = &self.leases;
        self.control
            .answer_requests(self.run.directory_id()?, self.run.path(), |request| {
                Ok::<_, ChannelError>(Some(match request {
                    ControlRequest::Hosts(_) => ControlResponse::Leases {
                        epoch: 1,
                        leases: leases.clone(),
                    },
                    _ => ControlResponse::Refused("this run is measured".into()),
                }))
            })?;
        Ok(())
    }
}

/// An actor's end.
struct PacedSender {
    actor: usize,
    sender: ChunkSender,
    /// When its next chunk is full.
    ready_at: Instant,
}

/// A host that has joined.
struct JoinedHost {
    // In the order in which they are dropped.
    senders: Vec<PacedSender>,
    notifier: Notifier,
    commits: CommitReader,
    relay: ChildProcess,
    _services: Services,
    domain: Domain,
    config: Config,
    _run: LockedRun,
}

impl<'a> RemoteRun<'a> {
    /// Calls `act` while `hosts` hosts with `actors` actors each have joined the run. Leaves nothing in shared memory.
    pub(super) fn with<T>(
        temporary: &TemporaryRun,
        network: &Network,
        (hosts, actors): (u32, u32),
        budget: &TimeBudget,
        act: impl FnOnce(&mut RemoteRun<'_>) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        temporary.in_shared_memory(|domain| {
            preflight::reserve(&temporary.config, &temporary.run, domain)?;
            let mut run = RemoteRun::start(temporary, network, (hosts, actors), budget, domain)?;
            let acted = run.join_all().and_then(|()| act(&mut run));
            let ended = run.end();
            let acted = acted?;
            ended?;
            Ok(acted)
        })
    }

    /// Starts learner and gate.
    fn start(
        temporary: &'a TemporaryRun,
        network: &'a Network,
        (hosts, actors): (u32, u32),
        budget: &'a TimeBudget,
        domain: &Domain,
    ) -> anyhow::Result<Self> {
        let (config, run) = (&temporary.config, &temporary.run);
        let endpoint = network.endpoint()?;
        JoinFile::new(endpoint.clone(), endpoint.clone()).write(run)?;
        let keys = keys::make(&config.run.id, SystemTime::now() + VALIDITY)?;
        let Keys { gate, join } = &keys;
        gate.write(&run.path().join(KeyFile::GATE))?;
        join.write(&run.path().join(KeyFile::JOIN))?;
        // All have services of their own, or all share one.
        let first = config.actors.max - hosts * actors;
        let lease = |host: u32| HostLease {
            host: u64::from(host) + 1,
            name: format!("host-{host}"),
            epoch: 1,
            actors: (first + host * actors..first + (host + 1) * actors).collect(),
            wanted_actors: actors,
            cores: 1,
            first_incarnation: (u64::from(host) + 1) * HostLease::INCARNATIONS,
            limit: (u64::from(host) + 2) * HostLease::INCARNATIONS,
        };
        let mut services = Services::new(domain)?;
        // The services of the run's own actors exist.
        if config.actors_that_share() > 0 {
            services.create_shared_transitions(domain, config.actors_that_share(), config.actors.window)?;
        } else {
            for actor in config.actors.count..hosts * actors {
                services.create_transitions(domain, actor, config.actors.window)?;
            }
        }
        let mut rows = Rows::new(config)?;
        let mut chunks = vec![vec![0.0; ENVIRONMENTS * config.row_layout().width()]; CHUNKS];
        chunks.iter_mut().try_for_each(|chunk| rows.fill(chunk))?;
        let mut learner = ChildProcess::role(Role::Learner, run)?;
        let replay = wait_for_replay(&run.replay_file(), || {
            learner.check()?;
            budget.check()
        })?;
        let last_actor = RoleInstance {
            role: Role::Actor,
            index: if first == 0 { hosts * actors - 1 } else { 0 },
            incarnation: 1,
        };
        Ok(Self {
            launcher: Launcher {
                run,
                control: ControlPort::open(domain, config.actors.max)?,
                leases: (0..hosts).map(lease).collect(),
                heartbeat: HeartbeatSender::new(domain, last_actor)?,
            },
            answered_at: Instant::now(),
            gates: 1,
            gate: gate_process(network, temporary, 1)?,
            learner,
            replay,
            _services: services,
            hosts: Vec::new(),
            chunks,
            next_chunk: 0,
            think: Duration::ZERO,
            directory: tempfile::Builder::new()
                .prefix("shoal-bench-hosts-")
                .tempdir()
                .context("cannot make a temporary directory")?,
            budget,
            temporary,
            network,
        })
    }

    /// Starts the relay of each host, and waits until every actor may send.
    fn join_all(&mut self) -> anyhow::Result<()> {
        let key = KeyFile::read(&self.temporary.run.path().join(KeyFile::JOIN))?;
        for lease in self.launcher.leases.clone() {
            let host = JoinedHost::join(self, &lease, &key)?;
            self.hosts.push(host);
        }
        for (host, lease) in self.hosts.iter_mut().zip(self.launcher.leases.clone()) {
            host.begin_to_send(&lease, &mut self.launcher, self.budget)?;
        }
        Ok(())
    }

    /// Rows in the learner's replay.
    pub(super) fn rows(&self) -> u64 {
        self.replay.rows()
    }

    /// Rows of each host in the learner's replay.
    pub(super) fn rows_of_hosts(&self) -> Vec<u64> {
        let of = |lease: &HostLease| {
            lease
                .actors
                .iter()
                .map(|actor| self.replay.actor(*actor as usize).rows)
                .sum()
        };
        self.launcher.leases.iter().map(of).collect()
    }

    /// The gate's process id.
    pub(super) fn gate(&self) -> u32 {
        process_id(&self.gate)
    }

    /// The learner's process id.
    pub(super) fn learner(&self) -> u32 {
        process_id(&self.learner)
    }

    /// The process id of the first host's relay.
    pub(super) fn relay(&self) -> u32 {
        process_id(&self.hosts[0].relay)
    }

    /// From now on, an actor needs this time to fill a chunk.
    pub(super) fn set_pace(&mut self, think: Duration) {
        self.think = think;
    }

    /// Sends chunks for `length`.
    pub(super) fn send_for(&mut self, length: Duration) -> anyhow::Result<()> {
        self.send_until(length, |_| false).map(drop)
    }

    /// Sends chunks for `length`, or until `done`; returns whether it is done.
    pub(super) fn send_until(&mut self, length: Duration, mut done: impl FnMut(&Self) -> bool) -> anyhow::Result<bool> {
        let begun = Instant::now();
        loop {
            if !self.send()? {
                std::thread::sleep(PAUSE);
            }
            if self.answered_at.elapsed() >= ANSWER_INTERVAL {
                self.answer()?;
                self.budget.check()?;
            }
            if done(self) {
                return Ok(true);
            }
            if begun.elapsed() >= length {
                return Ok(false);
            }
        }
    }

    /// Sends a chunk of each actor whose window has room. Returns whether there was one.
    fn send(&mut self) -> anyhow::Result<bool> {
        let row = self.temporary.config.row_layout();
        let (now, mut any) = (Instant::now(), false);
        for host in &mut self.hosts {
            let mut sent = false;
            for paced in &mut host.senders {
                let in_flight = paced.sender.in_flight(host.commits.committed(paced.actor));
                if now < paced.ready_at || in_flight >= u64::from(host.config.actors.window) {
                    continue;
                }
                // A full window makes the actor late, a pause of this loop does not.
                paced.ready_at = paced.ready_at.max(now - MAX_LATENESS.min(self.think)) + self.think;
                let sender = &mut paced.sender;
                let numbers = &self.chunks[self.next_chunk];
                self.next_chunk = (self.next_chunk + 1) % CHUNKS;
                let mut chunk = sender.empty_chunk()?;
                for numbers in numbers.chunks_exact(row.width()) {
                    chunk.push(&row.read(numbers));
                }
                sender.send(chunk, 0)?;
                sent = true;
            }
            if sent {
                host.notifier.notify();
                any = true;
            }
        }
        Ok(any)
    }

    /// Answers the gate, and looks after the processes.
    fn answer(&mut self) -> anyhow::Result<()> {
        self.answered_at = Instant::now();
        self.launcher.answer()?;
        self.learner.check()?;
        self.gate.check()?;
        for host in &mut self.hosts {
            host.relay.check()?;
            host.senders
                .iter()
                .try_for_each(|paced| paced.sender.refresh_connections())?;
        }
        Ok(())
    }

    /// Kills the gate, and starts its successor.
    pub(super) fn replace_gate(&mut self) -> anyhow::Result<()> {
        self.gate.signal(Signal::KILL)?;
        self.gate.wait(STARTUP_TIMEOUT);
        // As the launcher does after a role has died.
        Domain::clean_up(self.temporary.config.run.id.as_str())?;
        self.gates += 1;
        self.gate = gate_process(self.network, self.temporary, self.gates)?;
        Ok(())
    }

    fn end(mut self) -> anyhow::Result<()> {
        let mut ended = Ok(());
        self.hosts.iter_mut().for_each(|host| host.relay.ask_to_end());
        for host in self.hosts.drain(..) {
            ended = ended.and(host.end());
        }
        self.gate.ask_to_end();
        // It tells its hosts that it ends. Its launcher must answer until then.
        let deadline = Instant::now() + STARTUP_TIMEOUT;
        while self.gate.wait(ANSWER_INTERVAL).is_none() && Instant::now() < deadline {
            ended = ended.and(self.launcher.answer());
        }
        ended.and(self.gate.end()).and(self.learner.end())
    }
}

impl JoinedHost {
    fn join(run: &mut RemoteRun<'_>, lease: &HostLease, key: &KeyFile) -> anyhow::Result<Self> {
        let wire = WireLease {
            epoch: lease.epoch,
            config: run.temporary.config.to_toml()?,
            actors: lease.actors.clone(),
            first_incarnation: lease.first_incarnation,
            limit: lease.limit,
        };
        let path = run.directory.path().join(&lease.name);
        let (config, directory) =
            make_host_directory(&path, &wire.config, lease.first_incarnation, Interrupt::default())?;
        let endpoint = JoinFile::read(run.temporary.run.path())?.endpoint;
        key.write(&directory.path().join(KeyFile::JOIN))?;
        HostFile::new(endpoint, key.run_id.clone(), (lease.host, lease.name.clone()), &wire).write(&directory)?;
        let domain = Domain::join(&config.run.id, config.actors.max_on_a_host())?;
        let mut services = Services::new(&domain)?;
        services.create_common(&domain)?;
        for actor in &lease.actors {
            services.create_actor(&domain, *actor, config.actors.window)?;
        }
        let instance = RoleInstance {
            role: Role::Relay,
            index: 0,
            incarnation: lease.first_incarnation,
        };
        let mut command = run.network.command(End::Hosts, instance, directory.path())?;
        let mut relay = ChildProcess::start(&mut command, "relay".into()).context("cannot start the relay")?;
        let budget = run.budget;
        let commits = wait_for_replay(&directory.replay_file(), || {
            relay.check()?;
            budget.check()
        })?;
        Ok(Self {
            senders: Vec::new(),
            notifier: Notifier::new(&domain, EventName(Role::Learner, 0))?,
            commits,
            relay,
            _services: services,
            domain,
            config,
            _run: directory,
        })
    }

    /// Waits until every actor of this host may send.
    fn begin_to_send(
        &mut self,
        lease: &HostLease,
        launcher: &mut Launcher<'_>,
        budget: &TimeBudget,
    ) -> anyhow::Result<()> {
        let (begun, config) = (Instant::now(), &self.config);
        let incarnation = lease.first_incarnation + 1;
        let open = |actor: &u32| {
            let (layout, window) = (config.chunk_layout(), config.actors.window);
            let listener = Listener::bind(&self.domain, EventName(Role::Actor, *actor))?;
            let handshake = ChunkSender::open(&self.domain, *actor, incarnation, layout, window)?;
            Ok((*actor, listener, handshake))
        };
        let opened = lease
            .actors
            .iter()
            .map(open)
            .collect::<Result<Vec<_>, ChannelError>>()?;
        self.notifier.notify();
        for (actor, listener, handshake) in opened {
            let mut answered = Ok(());
            let sender = handshake.wait(&self.commits, &listener, &budget.stop, || {
                answered = launcher.answer();
                if answered.is_err() || begun.elapsed() >= STARTUP_TIMEOUT {
                    budget.stop.request();
                }
            });
            answered?;
            if begun.elapsed() >= STARTUP_TIMEOUT {
                bail!(
                    "an actor's first chunk was not committed within {} s",
                    STARTUP_TIMEOUT.as_secs()
                );
            }
            self.senders.push(PacedSender {
                actor: actor as usize,
                sender: sender.map_err(interrupted)?,
                ready_at: Instant::now(),
            });
        }
        Ok(())
    }

    fn end(self) -> anyhow::Result<()> {
        let Self {
            senders,
            notifier,
            relay,
            _services,
            domain,
            ..
        } = self;
        let ended = relay.end();
        drop((senders, notifier, _services));
        let left = domain.leave();
        ended?;
        Ok(left?)
    }
}

fn process_id(process: &ChildProcess) -> u32 {
    process.pid().as_raw_pid() as u32
}

fn gate_process(network: &Network, temporary: &TemporaryRun, incarnation: u64) -> anyhow::Result<ChildProcess> {
    let instance = RoleInstance {
        role: Role::Gate,
        index: 0,
        incarnation,
    };
    let mut command = network.command(End::Learner, instance, temporary.run.path())?;
    ChildProcess::start(&mut command, "gate".into()).context("cannot start the gate")
}
