//! The actor: acts with the newest policy and exploration, and writes transitions into chunks for the learner.
//!
//! ```text
//! loop {
//!     policy  = newest(policy)                     // in lockstep: exactly the one after the last round
//!     actions = explore(policy, observations)      // as the algorithm does: noise, sampling, or ε-greedy
//!     next    = environments.step(actions)
//!     chunk.push(s, a, r, discount, s', last)
//!     when the chunk is full, or its episode over: wait for space in the window, send it
//! }
//! ```

use std::path::PathBuf;
use std::rc::Rc;
use std::time::{Duration, Instant};

use shoal_common::algorithms::TransitionUse;
use shoal_common::channel::environment::{
    EnvironmentClient, EnvironmentResponse, ResetRequest, SnapshotResult, StepResult,
};
use shoal_common::channel::policy::{PolicyReader, PublishedPolicy};
use shoal_common::channel::transitions::{Chunk, ChunkSender};
use shoal_common::channel::{ChannelError, Domain, EventName, HeartbeatSender, Listener, Notifier, wait_for};
use shoal_common::commit::CommitReader;
use shoal_common::config::{Config, Mode};
use shoal_common::exit::Exit;
use shoal_common::report::EpisodeReport;
use shoal_common::role::{Activity, Role, RoleInstance};
use shoal_common::run_dir::RunDir;
use shoal_common::stop::Stop;
use shoal_common::stream::{Purpose, stream};
use shoal_common::transition::{ChunkLayout, Transition};

use crate::actor_snapshot::ActorSnapshot;
use crate::environment::{after_fault, connect};
use crate::episode_reports::EpisodeReports;
use crate::error::ActorError;
use crate::exploration::{Exploration, StepCounts};
use crate::n_step::NStepTransitions;

/// How long an actor waits for its last chunk to be committed when the whole run ends.
const LAST_COMMIT_TIMEOUT: Duration = Duration::from_secs(1);

/// The settings of an actor.
#[derive(Clone, Debug)]
pub struct ActorSettings {
    /// Which process this is.
    pub instance: RoleInstance,
    /// The run's configuration.
    pub config: Config,
    /// Environments stepped at once.
    envs: usize,
    /// Steps of a transition.
    n_step: usize,
    /// The layout of a chunk.
    chunk: ChunkLayout,
    /// Whether the first policy comes from another run (`--from`).
    starts_with_learned_policy: bool,
    /// The replay file; its commit record shows which chunks have arrived.
    pub replay_file: PathBuf,
}

impl ActorSettings {
    /// The settings of an actor of this run.
    pub fn new(config: &Config, run: &RunDir, instance: RoleInstance) -> Self {
        Self {
            instance,
            config: config.clone(),
            envs: config.actors.envs as usize,
            n_step: config.replay.n_step as usize,
            chunk: config.chunk_layout(),
            starts_with_learned_policy: config.run.from.is_some(),
            replay_file: run.replay_file(),
        }
    }
}

/// Explores until `stop`.
///
/// # Errors
/// When a channel fails, or the environment is not the expected one.
pub fn run(domain: &Domain, settings: &ActorSettings, stop: &Stop) -> Result<(), ActorError> {
    let mut actor = match Actor::new(domain, settings, stop) {
        Ok(actor) => actor,
        Err(exit) => return exit.into_result(),
    };
    match actor.run() {
        Exit::Stopped => actor.hand_over(),
        Exit::Failed(error) => Err(error),
    }
}

struct Actor<'a> {
    settings: &'a ActorSettings,
    stop: &'a Stop,
    listener: Listener,
    learner: Notifier,
    client: EnvironmentClient,
    policy: PolicyReader,
    exploration: Exploration,
    sender: ChunkSender,
    /// What is not in a chunk yet, if a transition has several steps.
    n_step: NStepTransitions,
    /// The chunk that is being filled.
    chunk: Chunk,
    /// Version of the policy that chose the newest action.
    policy_version: u64,
    commits: CommitReader,
    heartbeat: HeartbeatSender,
    episodes: EpisodeReports,
    returns: Vec<f64>,
    lengths: Vec<u32>,
    actions: Vec<f32>,
    /// Steps of each environment since the actor's random stream began.
    step: u64,
    /// The actor's snapshot after the last chunk, if it takes snapshots.
    snapshot: Option<ActorSnapshot>,
    /// When it first noticed that the whole run is ending.
    ending_since: Option<Instant>,
    /// Invalid answers of the environment server since this process began.
    faults: u64,
}

impl<'a> Actor<'a> {
    fn new(domain: &Domain, settings: &'a ActorSettings, stop: &'a Stop) -> Result<Self, Exit<ActorError>> {
        let RoleInstance { index, incarnation, .. } = settings.instance;
        let row = settings.chunk.row;
        let layout = settings.config.policy_layout()?;
        let listener = Listener::bind(domain, EventName(Role::Actor, index))?;
        let mut heartbeat = HeartbeatSender::new(domain, settings.instance)?;
        let client = connect(domain, &listener, index, &settings.config.spec, settings.envs, stop)?;
        let policy = PolicyReader::open(domain, layout.fingerprint(), layout.parameters())?;
        heartbeat.beat(Activity::WaitingForPeer);

        let commits = wait_for_replay(settings, &listener, stop, &mut heartbeat)?;
        let handshake = ChunkSender::open(
            domain,
            index,
            incarnation,
            settings.chunk,
            settings.config.actors.window,
        )?;
        let learner = Notifier::new(domain, EventName(Role::Learner, 0))?;
        learner.notify();
        let sender = handshake
            .wait(&commits, &listener, stop, || heartbeat.beat(Activity::WaitingForPeer))
            .map_err(Exit::convert)?;
        // In lockstep the bits must not depend on how often an actor was started: it continues after its last chunk.
        let incarnation = match settings.config.run.mode {
            Mode::Lockstep => 0,
            Mode::Free => incarnation,
        };
        let stream = stream(
            settings.config.run.seed,
            Purpose::Exploration,
            index.into(),
            incarnation,
        );
        let exploration = Exploration::new(settings.config.behaviour(settings.envs)?, settings.envs, stream);
        let snapshot_layout = settings.config.actor_snapshot_layout();
        let snapshot = match snapshot_layout.filter(|_| sender.sent() > 0) {
            None => None,
            Some(layout) => {
                let words = commits.actor_snapshot(index as usize);
                // To begin new episodes instead would change the run's bits.
                let snapshot = ActorSnapshot::read(&words, &layout).ok_or(Exit::Failed(ActorError::Snapshot))?;
                Some(snapshot)
            }
        };
        Ok(Self {
            settings,
            stop,
            learner,
            client,
            policy,
            exploration,
            step: 0,
            snapshot,
            ending_since: None,
            faults: 0,
            n_step: NStepTransitions::new(settings.n_step, settings.envs, row),
            chunk: sender.empty_chunk()?,
            policy_version: 0,
            sender,
            commits,
            heartbeat,
            episodes: EpisodeReports::open(domain)?,
            returns: vec![0.0; settings.envs],
            lengths: vec![0; settings.envs],
            actions: vec![0.0; settings.envs * row.action_width()],
            listener,
        })
    }

    fn run(&mut self) -> Exit<ActorError> {
        loop {
            match self.run_until_server_lost() {
                Ok(()) => tracing::warn!("the environment server was restarted"),
                Err(Exit::Failed(ActorError::Channel(error))) if error.fault().is_some() => {
                    self.faults += 1;
                    if let Err(exit) = after_fault(&error, &mut self.heartbeat, &self.listener, self.stop) {
                        return exit.convert();
                    }
                }
                Err(exit) => return exit,
            }
        }
    }

    /// Drops the current episodes and begins new ones. In lockstep it continues the episodes of the last snapshot
    /// instead, if there is one.
    fn begin(&mut self) -> Result<EnvironmentResponse, Exit<ActorError>> {
        self.n_step.clear();
        if self.settings.config.run.mode == Mode::Free {
            (0..self.settings.envs).for_each(|environment| self.begin_episode(environment));
            return self.reset(ResetRequest::Next);
        }
        self.chunk.clear();
        self.episodes.clear();
        if let Some(snapshot) = &self.snapshot {
            self.step = snapshot.step;
            self.exploration.restore(&snapshot.exploration);
            if !self.n_step.restore(&snapshot.n_step) {
                return Err(Exit::Failed(ActorError::Snapshot));
            }
            self.returns.clone_from(&snapshot.returns);
            self.lengths.clone_from(&snapshot.lengths);
            let idle = || self.heartbeat.beat(Activity::WaitingForServer);
            let restored = self.client.restore(&self.listener, &snapshot.environments, idle);
            return restored.map_err(Exit::convert);
        }
        (0..self.settings.envs).for_each(|environment| self.begin_episode(environment));
        // Without a snapshot, only the first episodes of the run can be repeated with the same bits.
        let sent = self.sender.sent();
        // A row of n steps is complete n − 1 steps after it began.
        let sent_steps = sent * (self.settings.chunk.rows / self.settings.envs) as u64;
        self.step = sent_steps + if sent == 0 { 0 } else { self.settings.n_step as u64 - 1 };
        // A new server would begin with episode 0 again, so the episode is named. Each step and each fault begins at
        // most one in each environment, so this number is above those of all episodes that have sent rows; and after an
        // invalid answer it is another episode, because the same one may end in the same way. With snapshots faults do
        // not count: there the bits must not depend on what was not sent.
        let faults = match self.settings.chunk.actor_snapshot_words {
            0 => self.faults,
            _ => 0,
        };
        self.reset(ResetRequest::Training(self.step + faults))
    }

    fn reset(&mut self, request: ResetRequest) -> Result<EnvironmentResponse, Exit<ActorError>> {
        let idle = || self.heartbeat.beat(Activity::WaitingForServer);
        self.client.reset(&self.listener, request, idle).map_err(Exit::convert)
    }

    fn run_until_server_lost(&mut self) -> Result<(), Exit<ActorError>> {
        let mut current = self.begin()?;
        // A snapshot may hold transitions that are complete.
        let mut connected = self.send_complete_chunks()?;
        while connected {
            let policy = self.await_policy().map_err(Exit::convert)?;
            self.heartbeat.announce_first_step();
            self.act(&policy, &current);
            let idle = || self.heartbeat.beat(Activity::WaitingForServer);
            let stepped = self.client.step(&self.listener, &self.actions, idle);
            match stepped.map_err(Exit::convert)? {
                StepResult::Taken(next) => {
                    self.store(&current, &next, policy.header().version);
                    current = next;
                }
                StepResult::Lost => return Ok(()),
            }
            self.step += 1;
            self.heartbeat.count(self.settings.envs as u64);
            self.heartbeat.beat(Activity::Working);
            connected = self.send_complete_chunks()?;
            if self.stop.requested() {
                return Err(Exit::Stopped);
            }
        }
        Ok(())
    }

    /// Sends the chunk if it is complete, and further chunks while complete transitions fill them. Returns false if the
    /// environment server was lost.
    fn send_complete_chunks(&mut self) -> Result<bool, Exit<ActorError>> {
        loop {
            self.n_step.move_into(&mut self.chunk);
            if !self.chunk_is_complete() {
                return Ok(true);
            }
            if !self.append_snapshot()? {
                return Ok(false);
            }
            self.await_capacity().map_err(Exit::convert)?;
            self.send()?;
        }
    }

    /// Whether the chunk is full or, if a chunk is one episode, the episode is over.
    fn chunk_is_complete(&self) -> bool {
        let episode_is_over = self.settings.config.algorithm.properties().transition_use == TransitionUse::Episodes
            && self.episodes.has_ended();
        self.chunk.is_full() || episode_is_over
    }

    /// Waits for the policy to act with. In lockstep that is the policy published after the last round, otherwise the
    /// newest policy.
    fn await_policy(&mut self) -> Result<Rc<PublishedPolicy>, Exit<ChannelError>> {
        let wanted = match self.settings.config.run.mode {
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
        let latest = |reader: &mut PolicyReader| -> Result<Option<Rc<PublishedPolicy>>, _> {
            Ok(reader.latest()?.filter(|policy| policy.header().version >= wanted))
        };
        let newest = match latest(policy)? {
            Some(newest) => newest,
            None => {
                let begun = Instant::now();
                let newest = wait_for(
                    listener,
                    stop,
                    || latest(policy),
                    || {
                        heartbeat.beat(Activity::WaitingForPeer);
                        // A restarted learner may need the last chunks before it can publish a policy.
                        sender.refresh_connections()
                    },
                )?;
                tracing::debug!(waited_us = microseconds(begun), "waited for a policy");
                newest
            }
        };
        self.heartbeat.set_policy_version(newest.header().version);
        Ok(newest)
    }

    /// Chooses an action for every environment.
    fn act(&mut self, policy: &PublishedPolicy, current: &EnvironmentResponse) {
        let act = match policy.header().updates {
            0 if !self.settings.starts_with_learned_policy => Exploration::warmup,
            _ => Exploration::act,
        };
        let steps = StepCounts {
            step: self.step,
            env_steps: policy.header().env_steps,
        };
        act(
            &mut self.exploration,
            policy.parameters(),
            current.observations(),
            steps,
            &mut self.actions,
        );
    }

    /// Adds the transition of every environment to the chunk (line 10 of Algorithm 4).
    fn store(&mut self, current: &EnvironmentResponse, next: &EnvironmentResponse, version: u64) {
        let width = self.settings.chunk.row.action_width();
        let gamma = self.settings.config.algorithm.gamma() as f32;
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
            if self.settings.n_step == 1 {
                self.chunk.push(&transition);
            } else {
                self.n_step.add(e, &transition);
            }
            self.returns[e] += f64::from(transition.r);
            self.lengths[e] += 1;
            if transition.last {
                self.episodes.push(EpisodeReport {
                    actor: self.settings.instance.index,
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

    /// Adds the actor's snapshot to the chunk, if the layout has one. Returns false if the environment server was lost.
    fn append_snapshot(&mut self) -> Result<bool, Exit<ActorError>> {
        if self.settings.chunk.actor_snapshot_words == 0 {
            return Ok(true);
        }
        let idle = || self.heartbeat.beat(Activity::WaitingForServer);
        let environments = self.client.snapshot(&self.listener, idle).map_err(Exit::convert)?;
        let SnapshotResult::Taken(environments) = environments else {
            return Ok(false);
        };
        let snapshot = ActorSnapshot {
            environments,
            step: self.step,
            exploration: self.exploration.state().into(),
            returns: self.returns.clone(),
            lengths: self.lengths.clone(),
            n_step: self.n_step.words(),
        };
        self.chunk.set_actor_snapshot(&snapshot.words());
        self.snapshot = Some(snapshot);
        Ok(true)
    }

    /// Waits until another chunk may be sent.
    fn await_capacity(&mut self) -> Result<(), Exit<ChannelError>> {
        let Self {
            sender,
            commits,
            settings,
            listener,
            stop,
            heartbeat,
            ..
        } = self;
        let has_capacity = || {
            let committed = commits.committed(settings.instance.index as usize);
            (sender.in_flight(committed) < u64::from(settings.config.actors.window)).then_some(())
        };
        if has_capacity().is_some() {
            return Ok(());
        }
        let begun = Instant::now();
        wait_for(
            listener,
            stop,
            || Ok(has_capacity()),
            || {
                heartbeat.beat(Activity::WaitingForRatio);
                sender.refresh_connections()
            },
        )?;
        tracing::debug!(waited_us = microseconds(begun), "waited for space in the window");
        // A busy learner may notify before the first heartbeat of this wait; the launcher must see even a short wait.
        heartbeat.beat(Activity::WaitingForRatio);
        Ok(())
    }

    /// Sends the chunk and begins the next one.
    fn send(&mut self) -> Result<(), ChannelError> {
        let chunk = std::mem::replace(&mut self.chunk, self.sender.empty_chunk()?);
        self.sender.send(chunk, self.policy_version)?;
        self.learner.notify();
        self.episodes.send();
        Ok(())
    }

    /// Sends the rows collected so far and waits until they are committed. If only this actor ends, it waits as long as
    /// needed; if the whole run ends, at most [`LAST_COMMIT_TIMEOUT`]. In lockstep incomplete chunks are dropped,
    /// because an incomplete round is collected again.
    fn hand_over(&mut self) -> Result<(), ActorError> {
        if self.settings.config.run.mode == Mode::Free {
            self.n_step.complete_all();
            loop {
                self.n_step.move_into(&mut self.chunk);
                if self.chunk.is_empty() || !self.await_commits(u64::from(self.settings.config.actors.window) - 1)? {
                    break;
                }
                self.send()?;
            }
        }
        self.await_commits(0)?;
        self.heartbeat.beat_now(Activity::Done);
        Ok(())
    }

    /// Waits until at most `most` chunks are uncommitted. Returns false if it gave up because the whole run is ending.
    fn await_commits(&mut self, most: u64) -> Result<bool, ChannelError> {
        let index = self.settings.instance.index as usize;
        while self.sender.in_flight(self.commits.committed(index)) > most {
            if self.stop.run_is_ending() {
                let ending_since = self.ending_since.get_or_insert_with(Instant::now);
                if !self.sender.has_receiver() || ending_since.elapsed() >= LAST_COMMIT_TIMEOUT {
                    return Ok(false);
                }
            }
            self.heartbeat.beat(Activity::WaitingForRatio);
            self.sender.refresh_connections()?;
            self.listener.wait(Duration::from_millis(10))?;
        }
        Ok(true)
    }
}

fn microseconds(begun: Instant) -> u64 {
    u64::try_from(begun.elapsed().as_micros()).unwrap_or(u64::MAX)
}

fn wait_for_replay(
    settings: &ActorSettings,
    listener: &Listener,
    stop: &Stop,
    heartbeat: &mut HeartbeatSender,
) -> Result<CommitReader, Exit<ActorError>> {
    loop {
        if let Some(reader) = CommitReader::open_if_ready(&settings.replay_file)? {
            return Ok(reader);
        }
        if stop.requested() {
            return Err(Exit::Stopped);
        }
        listener.wait(Duration::from_millis(20))?;
        heartbeat.beat(Activity::WaitingForPeer);
    }
}
