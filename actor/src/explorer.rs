//! The exploring actor: acts with the newest policy and noise, and writes what happens into chunks for the learner.
//!
//! ```text
//! loop {
//!     policy  = newest(policy)                     // in lockstep: exactly the one after the last round
//!     actions = explore(policy, observations)      // as the algorithm does: noise, sampling, or ε-greedy
//!     next    = environments.step(actions)
//!     chunk.push(s, a, r, discount, s', last)
//!     when the chunk is full, or its episode over: wait for room in the window, send it
//! }
//! ```

use std::path::PathBuf;
use std::rc::Rc;
use std::time::{Duration, Instant};

use shoal_common::algorithms::Experience;
use shoal_common::channel::environment::{Begin, EnvironmentClient, Observed, Snapshot, Stepped};
use shoal_common::channel::policy::{Policy, PolicyReader};
use shoal_common::channel::reports::Reporter;
use shoal_common::channel::transitions::{Chunk, ChunkSender};
use shoal_common::channel::{ChannelError, Domain, EventName, HeartbeatSender, Listener, Notifier, wait_for};
use shoal_common::commit::{CommitReader, OpenError};
use shoal_common::config::{Algorithm, Config, Mode};
use shoal_common::exit::Exit;
use shoal_common::report::{Activity, EpisodeReport, Identity, Role};
use shoal_common::run_dir::RunDir;
use shoal_common::space::EnvironmentSpec;
use shoal_common::stop::Stop;
use shoal_common::stream::{Purpose, stream};
use shoal_common::transition::{ChunkLayout, Transition};

use crate::actor_snapshot::ActorSnapshot;
use crate::error::ActorError;
use crate::exploration::Exploration;

/// What the line about an invalid answer of an environment server ends with; the launcher looks for it.
pub const GIVEN_UP: &str = "its episodes are given up";

/// How long an actor waits after an invalid answer before it begins new episodes.
const AFTER_FAULT: Duration = Duration::from_millis(50);

/// How long an actor waits for its last chunk to be committed when the whole run ends.
const FAREWELL: Duration = Duration::from_secs(1);

/// What an actor is told.
#[derive(Clone, Debug)]
pub struct ExplorerSettings {
    /// Which process this is.
    pub identity: Identity,
    /// The run's seed.
    pub seed: u64,
    /// Whether to wait for every policy in turn.
    pub mode: Mode,
    /// What the environment server is expected to serve, and how many of it.
    pub spec: EnvironmentSpec,
    /// Environments stepped at once.
    pub envs: usize,
    /// What a chunk has room for.
    pub chunk: ChunkLayout,
    /// Chunks that may be sent and not committed.
    pub window: u32,
    /// What is learned, and with it how to explore.
    pub algorithm: Algorithm,
    /// The replay, whose commit record tells what has arrived.
    pub replay: PathBuf,
}

impl ExplorerSettings {
    /// What an actor of this run is told.
    pub fn new(config: &Config, run: &RunDir, identity: Identity) -> Self {
        Self {
            identity,
            seed: config.run.seed,
            mode: config.run.mode,
            spec: config.spec.clone(),
            envs: config.actors.envs as usize,
            chunk: config.chunk_layout(),
            window: config.actors.window,
            algorithm: config.algorithm.clone(),
            replay: run.replay_file(),
        }
    }
}

/// Explores until `stop`.
///
/// # Errors
/// When a channel does not work, or the environment is not the expected one.
pub fn explore(domain: &Domain, settings: &ExplorerSettings, stop: &Stop) -> Result<(), ActorError> {
    let mut explorer = match Explorer::new(domain, settings, stop) {
        Ok(explorer) => explorer,
        Err(exit) => return exit.into_result(),
    };
    match explorer.run() {
        Exit::Stopped => explorer.hand_over(),
        Exit::Failed(error) => Err(error),
    }
}

struct Explorer<'a> {
    settings: &'a ExplorerSettings,
    stop: &'a Stop,
    listener: Listener,
    learner: Notifier,
    client: EnvironmentClient,
    policy: PolicyReader,
    exploration: Exploration,
    sender: ChunkSender,
    /// The chunk under way.
    chunk: Chunk,
    /// Version of the policy that its last row was collected with; of the one before it, while it is empty.
    policy_version: u64,
    commits: CommitReader,
    heartbeat: HeartbeatSender,
    episodes: Reporter<EpisodeReport>,
    returns: Vec<f64>,
    lengths: Vec<u32>,
    actions: Vec<f32>,
    /// Steps of every environment since the actor's stream began.
    step: u64,
    /// Where it stood after the last chunk, where it can say that.
    standing: Option<ActorSnapshot>,
    /// Since when it knows that the run ends.
    hurried: Option<Instant>,
    /// Episodes whose ends are in the chunk under way.
    ended: Vec<EpisodeReport>,
}

impl<'a> Explorer<'a> {
    fn new(domain: &Domain, settings: &'a ExplorerSettings, stop: &'a Stop) -> Result<Self, Exit<ActorError>> {
        let Identity { index, incarnation, .. } = settings.identity;
        let row = settings.chunk.row;
        let layout = settings.algorithm.policy_layout(&settings.spec)?;
        let listener = Listener::bind(domain, EventName(Role::Actor, index))?;
        let mut heartbeat = HeartbeatSender::new(domain, settings.identity)?;
        let client = connect(domain, &listener, index, &settings.spec, settings.envs, stop)?;
        let policy = PolicyReader::open(domain, layout.fingerprint(), layout.parameters())?;
        heartbeat.beat(Activity::WaitingForPeer);

        let commits = wait_for_replay(settings, &listener, stop, &mut heartbeat)?;
        let handshake = ChunkSender::open(domain, index, incarnation, settings.chunk, settings.window)?;
        let learner = Notifier::new(domain, EventName(Role::Learner, 0))?;
        learner.notify();
        let sender = handshake
            .wait(&commits, &listener, stop, || heartbeat.beat(Activity::WaitingForPeer))
            .map_err(Exit::widen)?;
        // In lockstep nothing may depend on how often an actor was started: it goes on where the last chunk left it.
        let incarnation = match settings.mode {
            Mode::Lockstep => 0,
            Mode::Free => incarnation,
        };
        let stream = stream(settings.seed, Purpose::Exploration, index.into(), incarnation);
        let exploration = Exploration::new(
            settings.algorithm.behaviour(&settings.spec, settings.envs)?,
            settings.envs,
            stream,
        );
        let standing = if settings.mode == Mode::Lockstep && sender.sent() > 0 {
            let words = commits.standing(index as usize);
            ActorSnapshot::read(&words, &settings.chunk, settings.envs, exploration.state().len())
        } else {
            None
        };
        Ok(Self {
            settings,
            stop,
            learner,
            client,
            policy,
            exploration,
            step: 0,
            standing,
            hurried: None,
            ended: Vec::new(),
            chunk: sender.begin()?,
            policy_version: 0,
            sender,
            commits,
            heartbeat,
            episodes: Reporter::open(domain)?,
            returns: vec![0.0; settings.envs],
            lengths: vec![0; settings.envs],
            actions: vec![0.0; settings.envs * row.action_width()],
            listener,
        })
    }

    fn run(&mut self) -> Exit<ActorError> {
        loop {
            match self.run_until_the_server_is_lost() {
                Ok(()) => tracing::warn!("the environment server was restarted"),
                Err(Exit::Failed(ActorError::Channel(error))) if error.fault().is_some() => {
                    if let Err(exit) = after_fault(&error, &mut self.heartbeat, &self.listener, self.stop) {
                        return exit.widen();
                    }
                }
                Err(exit) => return exit,
            }
        }
    }

    /// Begins new episodes, and gives up those under way; in lockstep goes on with those after the last chunk.
    fn begin(&mut self) -> Result<Observed, Exit<ActorError>> {
        if self.settings.mode == Mode::Free {
            (0..self.settings.envs).for_each(|environment| self.begin_episode(environment));
            return self.reset(Begin::Next);
        }
        self.chunk.clear();
        self.ended.clear();
        if let Some(standing) = &self.standing {
            self.step = standing.step;
            self.exploration.restore(&standing.noise);
            self.returns.clone_from(&standing.returns);
            self.lengths.clone_from(&standing.lengths);
            let idle = || self.heartbeat.beat(Activity::WaitingForServer);
            let restored = self.client.restore(&self.listener, &standing.snapshot, idle);
            return restored.map_err(Exit::widen);
        }
        (0..self.settings.envs).for_each(|environment| self.begin_episode(environment));
        // Without a word of where it stood there is only the beginning that is the same for everyone.
        let sent = self.sender.sent();
        self.step = sent * (self.settings.chunk.rows / self.settings.envs) as u64;
        let begin = if sent == 0 { Begin::Training(0) } else { Begin::Next };
        self.reset(begin)
    }

    fn reset(&mut self, begin: Begin) -> Result<Observed, Exit<ActorError>> {
        let idle = || self.heartbeat.beat(Activity::WaitingForServer);
        self.client.reset(&self.listener, begin, idle).map_err(Exit::widen)
    }

    fn run_until_the_server_is_lost(&mut self) -> Result<(), Exit<ActorError>> {
        let mut current = self.begin()?;
        loop {
            let policy = self.await_policy().map_err(Exit::widen)?;
            self.heartbeat.begin_work();
            self.act(&policy, &current);
            let idle = || self.heartbeat.beat(Activity::WaitingForServer);
            let stepped = self.client.step(&self.listener, &self.actions, idle);
            match stepped.map_err(Exit::widen)? {
                Stepped::Taken(next) => {
                    self.remember(&current, &next, policy.header().version);
                    current = next;
                }
                Stepped::Lost => return Ok(()),
            }
            self.step += 1;
            self.heartbeat.count(self.settings.envs as u64);
            self.heartbeat.beat(Activity::Working);
            if self.chunk_is_complete() {
                if !self.append_snapshot()? {
                    return Ok(());
                }
                self.await_room().map_err(Exit::widen)?;
                self.send()?;
            }
            if self.stop.requested() {
                return Err(Exit::Stopped);
            }
        }
    }

    /// Whether the chunk is full, or holds the one episode that it is for.
    fn chunk_is_complete(&self) -> bool {
        let episode_is_over =
            self.settings.algorithm.spec().experience == Experience::Episodes && !self.ended.is_empty();
        self.chunk.is_full() || episode_is_over
    }

    /// The policy to act with: the newest, or in lockstep the one after the last round.
    fn await_policy(&mut self) -> Result<Rc<Policy>, Exit<ChannelError>> {
        let wanted = match self.settings.mode {
            Mode::Free => 0,
            Mode::Lockstep => self.sender.sent(),
        };
        let Self {
            policy,
            sender,
            heartbeat,
            listener,
            stop,
            ..
        } = self;
        let newest = |reader: &mut PolicyReader| -> Result<Option<Rc<Policy>>, _> {
            Ok(reader.latest()?.filter(|policy| policy.header().version >= wanted))
        };
        let newest = match newest(policy)? {
            Some(newest) => newest,
            None => wait_for(
                listener,
                stop,
                || newest(policy),
                || {
                    heartbeat.beat(Activity::WaitingForPeer);
                    // A new learner may need the last chunks before it can publish anything.
                    sender.look_after()
                },
            )?,
        };
        self.heartbeat.set_policy_version(newest.header().version);
        Ok(newest)
    }

    /// Chooses an action for every environment.
    fn act(&mut self, policy: &Policy, current: &Observed) {
        let act = match policy.header().updates {
            0 => Exploration::warm_up,
            _ => Exploration::act,
        };
        act(
            &mut self.exploration,
            policy.parameters(),
            current.observations(),
            self.step,
            &mut self.actions,
        );
    }

    /// Line 10 of Algorithm 4, for every environment.
    fn remember(&mut self, current: &Observed, next: &Observed, version: u64) {
        let width = self.settings.chunk.row.action_width();
        let gamma = self.settings.algorithm.gamma() as f32;
        self.policy_version = version;
        for e in 0..self.settings.envs {
            let (terminated, truncated) = (next.terminated(e), next.truncated(e));
            let transition = Transition {
                s: current.observation(e),
                a: &self.actions[e * width..][..width],
                r: next.reward(e),
                discount: if terminated { 0.0 } else { gamma },
                s_next: next.next_observation(e),
                last: terminated || truncated,
            };
            self.chunk.push(&transition);
            self.returns[e] += f64::from(transition.r);
            self.lengths[e] += 1;
            if transition.last {
                self.ended.push(EpisodeReport {
                    actor: self.settings.identity.index,
                    environment: e as u32,
                    steps: self.lengths[e],
                    terminated: terminated.into(),
                    episode_return: self.returns[e],
                    policy_version: version,
                    env_steps: self.commits.rows(),
                });
                self.begin_episode(e);
            }
        }
    }

    fn begin_episode(&mut self, environment: usize) {
        self.exploration.begin_episode(environment);
        self.returns[environment] = 0.0;
        self.lengths[environment] = 0;
    }

    /// Says behind the chunk's rows where the actor stands after them, where that is asked for; whether the environment
    /// server is still there to say its part.
    fn append_snapshot(&mut self) -> Result<bool, Exit<ActorError>> {
        if self.settings.chunk.actor_snapshot_words == 0 {
            return Ok(true);
        }
        let idle = || self.heartbeat.beat(Activity::WaitingForServer);
        let snapshot = self.client.snapshot(&self.listener, idle).map_err(Exit::widen)?;
        let Snapshot::Taken(snapshot) = snapshot else {
            return Ok(false);
        };
        let standing = ActorSnapshot {
            snapshot,
            step: self.step,
            noise: self.exploration.state().into(),
            returns: self.returns.clone(),
            lengths: self.lengths.clone(),
        };
        self.chunk.set_standing(&standing.words());
        self.standing = Some(standing);
        Ok(true)
    }

    /// Waits until another chunk may be sent.
    fn await_room(&mut self) -> Result<(), Exit<ChannelError>> {
        let Self {
            sender,
            commits,
            settings,
            listener,
            stop,
            heartbeat,
            ..
        } = self;
        let room = || {
            let committed = commits.committed(settings.identity.index as usize);
            (sender.in_flight(committed) < u64::from(settings.window)).then_some(())
        };
        if room().is_some() {
            return Ok(());
        }
        wait_for(
            listener,
            stop,
            || Ok(room()),
            || {
                heartbeat.beat(Activity::WaitingForRatio);
                sender.look_after()
            },
        )?;
        // A learner that is at work rings before a nap is over, and the launcher is to know of this wait too.
        heartbeat.beat(Activity::WaitingForRatio);
        Ok(())
    }

    /// Sends the chunk under way, and begins the next one.
    fn send(&mut self) -> Result<(), ChannelError> {
        let chunk = std::mem::replace(&mut self.chunk, self.sender.begin()?);
        self.sender.send(chunk, self.policy_version)?;
        self.learner.notify();
        self.ended.drain(..).for_each(|episode| self.episodes.send(episode));
        Ok(())
    }

    /// Sends what was collected and waits until it is committed: for as long as that takes where only this actor retires,
    /// for a moment where the run ends. In lockstep a round is whole or not at all.
    fn hand_over(&mut self) -> Result<(), ActorError> {
        if self.settings.mode == Mode::Free
            && !self.chunk.is_empty()
            && self.await_commits(u64::from(self.settings.window) - 1)?
        {
            self.send()?;
        }
        self.await_commits(0)?;
        self.heartbeat.beat_now(Activity::Done);
        Ok(())
    }

    /// Waits until no more than `most` chunks are uncommitted; whether that came about.
    fn await_commits(&mut self, most: u64) -> Result<bool, ChannelError> {
        let index = self.settings.identity.index as usize;
        while self.sender.in_flight(self.commits.committed(index)) > most {
            if self.stop.at_once() {
                let hurried = self.hurried.get_or_insert_with(Instant::now);
                if !self.sender.is_heard() || hurried.elapsed() >= FAREWELL {
                    return Ok(false);
                }
            }
            self.heartbeat.beat(Activity::WaitingForRatio);
            self.sender.look_after()?;
            self.listener.wait(Duration::from_millis(10))?;
        }
        Ok(true)
    }
}

/// Opens the conversation with environment server `index` and makes sure that it serves what the run is about.
pub(crate) fn connect(
    domain: &Domain,
    listener: &Listener,
    index: u32,
    spec: &EnvironmentSpec,
    envs: usize,
    stop: &Stop,
) -> Result<EnvironmentClient, Exit<ActorError>> {
    let client = EnvironmentClient::open(domain, index, spec, envs, stop.clone())?;
    let (served, served_envs) = client.describe(listener, || ()).map_err(Exit::widen)?;
    if !served.is(spec) || served_envs != envs {
        let served = format!("{served_envs} times {served:?}");
        let configured = format!("{envs} times {spec:?}");
        return Err(Exit::Failed(ActorError::Server {
            index,
            served,
            configured,
        }));
    }
    Ok(client)
}

/// Takes note of an answer that no environment may give; the next thing is to begin new episodes. The pause keeps an
/// environment that always answers so from filling the log before the launcher ends the run for it.
pub(crate) fn after_fault(
    error: &ChannelError,
    heartbeat: &mut HeartbeatSender,
    listener: &Listener,
    stop: &Stop,
) -> Result<(), Exit<ChannelError>> {
    tracing::warn!("{error}; {GIVEN_UP}");
    heartbeat.count_fault();
    let since = Instant::now();
    while since.elapsed() < AFTER_FAULT {
        if stop.requested() {
            return Err(Exit::Stopped);
        }
        listener.wait(AFTER_FAULT)?;
    }
    Ok(())
}

fn wait_for_replay(
    settings: &ExplorerSettings,
    listener: &Listener,
    stop: &Stop,
    heartbeat: &mut HeartbeatSender,
) -> Result<CommitReader, Exit<ActorError>> {
    loop {
        match CommitReader::open(&settings.replay) {
            Ok(reader) => return Ok(reader),
            Err(OpenError::NotYet { .. }) if stop.requested() => return Err(Exit::Stopped),
            Err(OpenError::NotYet { .. }) => {
                listener.wait(Duration::from_millis(20))?;
                heartbeat.beat(Activity::WaitingForPeer);
            }
            Err(error) => return Err(error.into()),
        }
    }
}
