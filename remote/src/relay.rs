//! The relay, a role on each other host. To the actors there it is the learner: it receives their chunks, publishes the
//! policy, and writes the commit record that they wait for. What it knows of the learner comes from the gate.

use std::collections::BTreeMap;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::mpsc::{Receiver, Sender, SyncSender, TrySendError, channel, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use shoal_common::channel::control::{ControlRequest, JoinAgain};
use shoal_common::channel::policy::PolicyPublisher;
use shoal_common::channel::reports::Reports;
use shoal_common::channel::transitions::ChunkReceiver;
use shoal_common::channel::{ChannelError, Domain, EventName, HeartbeatSender, Listener, Notifier};
use shoal_common::commit::{ActorCommit, CommitMirror, ReplayLayout};
use shoal_common::config::Config;
use shoal_common::report::{EpisodeReport, Heartbeat};
use shoal_common::role::{Activity, Role, RoleInstance};
use shoal_common::run_dir::{RunDir, RunDirError};
use shoal_common::stop::Stop;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

use crate::files::{FileError, HostFile, KeyFile};
use crate::join::ask_to_join;
use crate::network::{self, CUT_OFF_AFTER, LONGEST_SLEEP, NetworkError, REFRESH_INTERVAL, failed};
use crate::requests::LauncherRequests;
use crate::uncommitted::{ActorFollowUp, UncommittedChunks};
use crate::wire::{
    Acknowledgement, Admission, Hello, HostReport, Message, PolicyId, PolicyRequest, RemoteEpisode, RemoteRole,
    ReportNumber, RunPhase, WireChunk, WireError, WirePolicy, cores, id_of, vector_instructions,
};

/// Chunks are sent again if the gate has got none for this long; or for some round trips, if that is longer.
const RESEND_AFTER: Duration = Duration::from_millis(200);
const RESEND_AFTER_ROUND_TRIPS: u32 = 4;

/// Time between two reports.
const REPORT_INTERVAL: Duration = Duration::from_millis(250);

/// Chunks on their way to the thread that sends them.
const CHUNK_QUEUE_LENGTH: usize = 64;

/// Episodes kept for the next report; more are dropped while the gate is away. The channel to the launcher holds a few
/// more.
const MAX_KEPT_EPISODES: usize = 4_000;

/// How long a query for a policy may take, and the pause after one without an answer.
const POLICY_QUERY_TIMEOUT: Duration = Duration::from_secs(10);
const POLICY_PAUSE: Duration = Duration::from_millis(50);

/// How long the gate may take to get the last chunks.
pub(crate) const RELAY_HAND_OVER_TIMEOUT: Duration = Duration::from_secs(3);

/// How long to wait before asking again to be admitted.
pub(crate) const REJOIN_INTERVAL: Duration = Duration::from_secs(1);

/// What the relay needs.
#[derive(Clone, Debug)]
pub struct RelaySettings {
    /// Which process this is.
    pub instance: RoleInstance,
    /// The run's configuration, as on this host.
    pub config: Config,
    /// The host's directory.
    pub run: RunDir,
    /// What `shoal join` has been given.
    pub host: HostFile,
    /// The run's key, unless the endpoint is not encrypted.
    pub key: Option<KeyFile>,
}

/// Why the relay ended.
#[derive(Debug, thiserror::Error)]
pub enum RelayError {
    /// A channel of this host failed.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The network failed.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The host's directory cannot be used.
    #[error(transparent)]
    Run(#[from] RunDirError),
    /// A file of the host cannot be used.
    #[error(transparent)]
    File(#[from] FileError),
    /// A message cannot be encoded.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// The copy of the commit record cannot be written.
    #[error("cannot write the copy of the commit record: {0}")]
    Mirror(std::io::Error),
    /// The system refused something that the relay needs.
    #[error("cannot {action}: {cause}")]
    System {
        /// What, such as "start a thread".
        action: &'static str,
        /// The system's reason.
        cause: std::io::Error,
    },
}

/// Something that has come from the gate.
enum Arrival {
    Acknowledgement(Vec<u8>),
    Policy(Vec<u8>),
    /// The answer to the request whether this host is still admitted.
    Admission(Result<Admission, String>),
}

/// Sends arrivals to the relay's loop, and wakes it.
#[derive(Clone)]
struct ArrivalSender {
    arrivals: Sender<Arrival>,
    event: Arc<OwnedFd>,
}

impl ArrivalSender {
    fn send(&self, arrival: Arrival) {
        // Both fail only while the relay ends, or if the counter of wake-ups is full, which wakes it as well.
        let _ = self.arrivals.send(arrival);
        let _ = rustix::io::write(&self.event, &1_u64.to_ne_bytes());
    }
}

/// An actor of this host.
struct LocalActor {
    receiver: ChunkReceiver,
    uncommitted: UncommittedChunks<ZBytes>,
    notifier: Notifier,
    commit: ActorCommit,
}

struct Relay<'a> {
    settings: &'a RelaySettings,
    domain: &'a Domain,
    stop: &'a Stop,
    session: Session,
    listener: Listener,
    arrival_sender: ArrivalSender,
    arrivals: Receiver<Arrival>,
    requests: LauncherRequests<()>,
    chunk_queue: SyncSender<ZBytes>,
    report_publisher: Publisher<'static>,
    mirror: CommitMirror,
    actors: BTreeMap<u32, LocalActor>,
    policy_publisher: Option<PolicyPublisher>,
    /// The newest policy, for the thread that asks for the next one.
    newest_policy: NewestPolicy,
    heartbeat: HeartbeatSender,
    heartbeat_reports: Reports<Heartbeat>,
    episode_reports: Reports<EpisodeReport>,
    /// The last heartbeats of actors and environment servers, with the times of their arrival.
    roles: BTreeMap<(Role, u32), (Instant, RemoteRole)>,
    episodes: Vec<RemoteEpisode>,
    epoch: u64,
    /// Gate and number of the newest acknowledgement.
    last_acknowledgement: (u64, u64),
    heard_at: Option<Instant>,
    started_at: Instant,
    /// Number and time of the last report.
    last_report: (u64, Instant),
    /// A report that no acknowledgement has confirmed yet.
    unconfirmed_report: Option<(ReportNumber, Instant)>,
    round_trip: Option<Duration>,
    connections_refreshed_at: Instant,
    /// When this host last asked to be admitted again, and whether an answer is still to come.
    rejoin_request: Option<(Instant, bool)>,
    run_is_over: bool,
    /// The gate has refused to admit this host again.
    is_refused: bool,
    /// When the launcher of this host was last told that its actors belong to others.
    lost_actors_at: Option<Instant>,
    /// When it was last told that the run wants this host to have another number of actors.
    scaled_at: Option<Instant>,
    /// When a request to stop was first seen.
    stop_seen_at: Option<Instant>,
}

/// Stands in for the learner until `stop`.
///
/// # Errors
/// When a channel fails, or this host is no longer admitted.
pub fn run(domain: &Domain, settings: &RelaySettings, stop: &Stop) -> Result<(), RelayError> {
    Relay::new(domain, settings, stop)?.run()
}

impl<'a> Relay<'a> {
    fn new(domain: &'a Domain, settings: &'a RelaySettings, stop: &'a Stop) -> Result<Self, RelayError> {
        let RelaySettings { config, run, host, .. } = settings;
        let heartbeat = HeartbeatSender::new(domain, settings.instance)?;
        let listener = Listener::bind(domain, EventName(Role::Learner, 0))?;
        let chunk = config.chunk_layout();
        let layout = ReplayLayout {
            row: chunk.row,
            // There are no rows in a copy.
            ring: 1,
            actors: config.actors.max as usize,
            actor_snapshot_words: chunk.actor_snapshot_words,
            fingerprint: config.fingerprint(),
        };
        let mirror = CommitMirror::open(&run.replay_file(), &layout).map_err(RelayError::Mirror)?;
        let mut actors = BTreeMap::new();
        for index in &host.actors {
            let commit = mirror.actor(*index as usize);
            let actor = LocalActor {
                receiver: ChunkReceiver::open(domain, *index, chunk, config.actors.window)?,
                uncommitted: UncommittedChunks::new(commit.last_chunk),
                notifier: Notifier::new(domain, EventName(Role::Actor, *index))?,
                commit,
            };
            actors.insert(*index, actor);
        }
        let session = network::connect(&host.endpoint, settings.key.as_ref())?;
        let (sender, arrivals) = channel();
        let event =
            eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK).map_err(system_error("create an event"))?;
        let arrival_sender = ArrivalSender {
            arrivals: sender,
            event: Arc::new(event),
        };
        let to = arrival_sender.clone();
        session
            .declare_subscriber(network::acknowledgements(&host.run_id, host.host))
            .callback(move |sample| to.send(Arrival::Acknowledgement(sample.payload().to_bytes().into_owned())))
            .background()
            .wait()
            .map_err(failed("receive acknowledgements"))?;
        let reports = session
            .declare_publisher(network::reports(&host.run_id, &host.host.to_string()))
            .congestion_control(CongestionControl::Drop)
            .express(true)
            .wait()
            .map_err(failed("send reports"))?;
        let newest = NewestPolicy::default();
        start_asking_for_policies(&session, host, arrival_sender.clone(), newest.clone())?;
        let now = Instant::now();
        Ok(Self {
            chunk_queue: start_sending(&session, host)?,
            requests: LauncherRequests::start(&config.run.id, config.actors.max_on_a_host(), run.directory_id()?)
                .map_err(system_error("start a thread"))?,
            heartbeat_reports: Reports::open(domain)?,
            episode_reports: Reports::open(domain)?,
            settings,
            domain,
            stop,
            session,
            listener,
            arrival_sender,
            arrivals,
            report_publisher: reports,
            mirror,
            actors,
            policy_publisher: None,
            newest_policy: newest,
            heartbeat,
            roles: BTreeMap::new(),
            episodes: Vec::new(),
            epoch: host.epoch,
            last_acknowledgement: (0, 0),
            heard_at: None,
            started_at: now,
            last_report: (0, now),
            unconfirmed_report: None,
            round_trip: None,
            connections_refreshed_at: now,
            rejoin_request: None,
            run_is_over: false,
            is_refused: false,
            lost_actors_at: None,
            scaled_at: None,
            stop_seen_at: None,
        })
    }

    fn run(&mut self) -> Result<(), RelayError> {
        self.heartbeat.beat_now(Activity::WaitingForPeer);
        loop {
            let arrivals: Vec<Arrival> = self.arrivals.try_iter().collect();
            for arrival in arrivals {
                self.handle(arrival)?;
            }
            self.handle_chunks()?;
            self.send_chunks();
            self.read_reports()?;
            if self.last_report.1.elapsed() >= REPORT_INTERVAL {
                self.send_report(false)?;
            }
            self.refresh_connections()?;
            while self.requests.answer().is_some() {}
            if self.may_leave() {
                return self.send_report(true);
            }
            self.sleep()?;
        }
    }

    /// Whether to end now: once it was asked to, and the gate has got all chunks or cannot be reached.
    fn may_leave(&mut self) -> bool {
        if !self.stop.requested() {
            return false;
        }
        let since = *self.stop_seen_at.get_or_insert_with(Instant::now);
        let handed_over = self.actors.values().all(|actor| actor.uncommitted.all_forwarded());
        handed_over || self.lost_actors_at.is_some() || self.is_cut_off() || since.elapsed() >= RELAY_HAND_OVER_TIMEOUT
    }

    fn is_cut_off(&self) -> bool {
        self.heard_at.is_none_or(|heard| heard.elapsed() >= CUT_OFF_AFTER)
    }

    fn now(&self) -> Duration {
        self.started_at.elapsed()
    }

    fn handle(&mut self, arrival: Arrival) -> Result<(), RelayError> {
        match arrival {
            Arrival::Acknowledgement(bytes) => match Acknowledgement::decode(&bytes) {
                Ok(acknowledgement) => self.handle_acknowledgement(&acknowledgement),
                Err(error) => {
                    tracing::warn!("the gate sent an acknowledgement that is not read: {error}");
                    Ok(())
                }
            },
            Arrival::Policy(bytes) => match WirePolicy::decode(&bytes) {
                Ok(policy) => self.publish(&policy),
                Err(error) => {
                    tracing::warn!("the gate sent a policy that is not read: {error}");
                    Ok(())
                }
            },
            Arrival::Admission(answer) => self.handle_admission(answer),
        }
    }

    fn handle_acknowledgement(&mut self, acknowledgement: &Acknowledgement) -> Result<(), RelayError> {
        if (acknowledgement.gate, acknowledgement.number) <= self.last_acknowledgement {
            return Ok(());
        }
        let other_gate = acknowledgement.gate != self.last_acknowledgement.0;
        self.last_acknowledgement = (acknowledgement.gate, acknowledgement.number);
        if self.is_cut_off() {
            tracing::info!("connected to the gate");
            // The report was lost or delayed by the outage, whose length says nothing about a round trip.
            self.unconfirmed_report = None;
        }
        self.heard_at = Some(Instant::now());
        if acknowledgement.phase == RunPhase::Over && !self.run_is_over {
            tracing::info!("the run is over");
            self.run_is_over = true;
        }
        let confirmed = self
            .unconfirmed_report
            .take_if(|(number, _)| *number <= acknowledgement.report);
        // If a later report is confirmed, this one or its acknowledgement was lost.
        if let Some((_, sent)) = confirmed.filter(|(number, _)| *number == acknowledgement.report) {
            self.round_trip = Some(sent.elapsed());
        }
        let covered = |actor: &u32| acknowledgement.actors.iter().any(|of| of.actor == *actor);
        if acknowledgement.epoch != self.epoch || !self.settings.host.actors.iter().all(covered) {
            self.ask_to_rejoin();
            return Ok(());
        }
        let now = self.now();
        let (mut changed, mut lost) = (Vec::new(), false);
        for of_actor in &acknowledgement.actors {
            let Some(actor) = self.actors.get_mut(&of_actor.actor) else {
                continue;
            };
            let commit = ActorCommit {
                last_chunk: of_actor.committed,
                rows: of_actor.rows,
            };
            let limit = self.settings.host.limit;
            let follow_up = actor
                .uncommitted
                .acknowledge(of_actor.forwarded, commit.last_chunk, limit, now);
            if other_gate {
                actor.uncommitted.go_back(now);
            }
            if commit != actor.commit {
                actor.commit = commit;
                changed.push(of_actor.actor);
            }
            lost |= follow_up == ActorFollowUp::TakenOver;
            request_restart(&self.requests, of_actor.actor, follow_up);
        }
        if lost {
            self.report_lost_actors();
        } else if acknowledgement.wanted_actors != self.actors.len() as u32 {
            self.report_wanted_actors(acknowledgement.wanted_actors);
        }
        if other_gate || !changed.is_empty() {
            let of_host = acknowledgement.actors.iter();
            let commits = of_host.filter_map(|of_actor| {
                let actor = self.actors.get(&of_actor.actor)?;
                Some((of_actor.actor, actor.commit, &of_actor.snapshot[..]))
            });
            self.mirror.publish(acknowledgement.rows, commits);
            changed.iter().for_each(|index| self.actors[index].notifier.notify());
        }
        Ok(())
    }

    /// Tells the launcher of this host that its actors belong to others now, so that the host joins again.
    fn report_lost_actors(&mut self) {
        if self.lost_actors_at.is_none_or(|told| told.elapsed() >= REJOIN_INTERVAL) {
            tracing::warn!("the run has given the actors of this host to others");
            self.lost_actors_at = Some(Instant::now());
            let why = JoinAgain::LostActors;
            self.requests.ask(ControlRequest::JoinAgain(why), ());
        }
    }

    /// Tells the launcher of this host that the run wants it to have another number of actors, so that the host joins
    /// again.
    fn report_wanted_actors(&mut self, actors: u32) {
        if self.scaled_at.is_none_or(|told| told.elapsed() >= REJOIN_INTERVAL) {
            tracing::info!("the run wants this host to have {actors} actors");
            self.scaled_at = Some(Instant::now());
            let why = JoinAgain::Scaled(actors);
            self.requests.ask(ControlRequest::JoinAgain(why), ());
        }
    }

    /// Asks whether this host is still admitted: the launcher of the run is another process, or has given its actors
    /// away.
    fn ask_to_rejoin(&mut self) {
        if self.lost_actors_at.is_some() {
            return;
        }
        let waits = self
            .rejoin_request
            .is_some_and(|(then, open)| open || then.elapsed() < REJOIN_INTERVAL);
        if waits {
            return;
        }
        self.rejoin_request = Some((Instant::now(), true));
        let host = &self.settings.host;
        let hello = Hello {
            program: env!("CARGO_PKG_VERSION").into(),
            host: host.host,
            name: host.name.clone(),
            instructions: vector_instructions(),
            actors: host.actors.len() as u32,
            cores: cores(),
            held: host.actors.clone(),
        };
        let (session, run_id) = (self.session.clone(), host.run_id.clone());
        let arrival_sender = self.arrival_sender.clone();
        let ask = move || {
            let answer = ask_to_join(&session, &run_id, &hello).map_err(|error| error.to_string());
            arrival_sender.send(Arrival::Admission(answer));
        };
        if let Err(cause) = std::thread::Builder::new().name("join".into()).spawn(ask) {
            tracing::warn!("cannot ask to be admitted again: {cause}");
            self.rejoin_request = Some((Instant::now(), false));
        }
    }

    fn handle_admission(&mut self, answer: Result<Admission, String>) -> Result<(), RelayError> {
        self.rejoin_request = Some((Instant::now(), false));
        let host = &self.settings.host;
        match answer {
            Ok(Admission::Admitted(lease)) if lease.actors == host.actors => {
                tracing::info!("admitted again");
                self.epoch = lease.epoch;
                self.is_refused = false;
                let mut host = host.clone();
                host.epoch = lease.epoch;
                host.write(&self.settings.run)?;
            }
            Ok(Admission::Admitted(_)) => self.report_lost_actors(),
            Ok(Admission::Refused(why)) => {
                tracing::warn!("not admitted again: {why}");
                self.is_refused = true;
            }
            Ok(Admission::RunIsEnding) => {
                tracing::warn!("not admitted again: the run is ending");
                self.is_refused = true;
            }
            Err(why) => tracing::debug!("no answer: {why}"),
        }
        Ok(())
    }

    fn publish(&mut self, policy: &WirePolicy) -> Result<(), RelayError> {
        let publisher = match &self.policy_publisher {
            Some(publisher) => publisher,
            None => self
                .policy_publisher
                .insert(PolicyPublisher::open(self.domain, policy.parameters.len())?),
        };
        publisher.publish(&policy.parameters, policy.header)?;
        self.newest_policy.set(PolicyId::from(&policy.header));
        self.heartbeat.set_policy_version(policy.header.version);
        self.actors.values().for_each(|actor| actor.notifier.notify());
        Ok(())
    }

    /// Handles the chunks of the actors.
    fn handle_chunks(&mut self) -> Result<(), RelayError> {
        // Before the first acknowledgement nobody knows what is committed.
        if self.heard_at.is_none() {
            return Ok(());
        }
        let now = self.now();
        for (index, actor) in &mut self.actors {
            while let Some(chunk) = actor.receiver.receive()? {
                let (rows, snapshot) = chunk.parts();
                let bytes = WireChunk::encode(self.settings.host.host, chunk.header(), rows, snapshot);
                let follow_up = actor.uncommitted.add(id_of(chunk.header()), bytes.into(), now);
                request_restart(&self.requests, *index, follow_up);
                self.heartbeat.count(chunk.header().rows.into());
            }
        }
        Ok(())
    }

    /// Hands chunks to the thread that sends them, as many as it takes. While the gate is away they stay here.
    fn send_chunks(&mut self) {
        let (now, cut_off) = (self.now(), self.is_cut_off());
        let timeout = RESEND_AFTER.max(RESEND_AFTER_ROUND_TRIPS * self.round_trip.unwrap_or_default());
        for actor in self.actors.values_mut() {
            if cut_off {
                continue;
            }
            actor.uncommitted.go_back_if_overdue(now, timeout);
            while let Some(kept) = actor.uncommitted.next() {
                match self.chunk_queue.try_send(kept.chunk.clone()) {
                    Ok(()) => actor.uncommitted.note_sent(),
                    Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => return,
                }
            }
        }
    }

    fn read_reports(&mut self) -> Result<(), RelayError> {
        while let Some(heartbeat) = self.heartbeat_reports.receive()? {
            if let Some(role) = RemoteRole::of(&heartbeat).filter(|role| role.role != Role::Relay) {
                self.roles.insert((role.role, role.index), (Instant::now(), role));
            }
        }
        while let Some(episode) = self.episode_reports.receive()? {
            if self.episodes.len() < MAX_KEPT_EPISODES {
                self.episodes.push(episode.into());
            }
        }
        Ok(())
    }

    fn send_report(&mut self, leaving: bool) -> Result<(), RelayError> {
        let now = Instant::now();
        self.last_report = (self.last_report.0 + 1, now);
        let number = ReportNumber {
            relay: self.settings.instance.incarnation,
            report: self.last_report.0,
        };
        self.unconfirmed_report.get_or_insert((number, now));
        // What is sent while the gate is away is lost.
        let episodes = if self.is_cut_off() {
            Vec::new()
        } else {
            std::mem::take(&mut self.episodes)
        };
        self.roles.retain(|_, (heard, _)| heard.elapsed() < CUT_OFF_AFTER);
        let report = HostReport {
            host: self.settings.host.host,
            number,
            round_trip_us: self.round_trip.map(|trip| trip.as_micros() as u64),
            leaving,
            resent: self.actors.values().map(|actor| actor.uncommitted.resent()).sum(),
            policy_version: self.newest_policy.get().map_or(0, |policy| policy.version),
            roles: self.roles.values().map(|(_, role)| *role).collect(),
            episodes,
        };
        self.report_publisher
            .put(report.encode()?)
            .wait()
            .map_err(failed("send a report"))?;
        if leaving {
            // The process ends next. Closing the session first sends what is still queued.
            self.session.close().wait().map_err(failed("close"))?;
        }
        Ok(())
    }

    fn refresh_connections(&mut self) -> Result<(), RelayError> {
        if self.connections_refreshed_at.elapsed() < REFRESH_INTERVAL {
            return Ok(());
        }
        self.connections_refreshed_at = Instant::now();
        if self.lost_actors_at.is_some() {
            // The launcher may not have got the first message.
            self.report_lost_actors();
        }
        if let Some(publisher) = &self.policy_publisher {
            publisher.refresh_connections()?;
        }
        let activity = match (self.run_is_over, self.is_cut_off() || self.is_refused) {
            (true, _) => Activity::Done,
            (false, true) => Activity::WaitingForPeer,
            (false, false) => Activity::Working,
        };
        self.heartbeat.beat(activity);
        Ok(())
    }

    /// Waits at most [`LONGEST_SLEEP`] for an actor or the gate.
    fn sleep(&self) -> Result<(), RelayError> {
        let timeout = Timespec::try_from(LONGEST_SLEEP).ok();
        let mut ready = [
            PollFd::from_borrowed_fd(self.listener.as_fd(), PollFlags::IN),
            PollFd::from_borrowed_fd(self.arrival_sender.event.as_fd(), PollFlags::IN),
        ];
        match poll(&mut ready, timeout.as_ref()) {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(errno) => return Err(system_error("wait for chunks")(errno)),
        }
        let mut count = [0; 8];
        // It fails if there was no arrival.
        let _ = rustix::io::read(&self.arrival_sender.event, &mut count);
        self.listener.wait(Duration::ZERO)?;
        Ok(())
    }
}

/// For `map_err`.
fn system_error<E: Into<std::io::Error>>(action: &'static str) -> impl Fn(E) -> RelayError {
    move |cause| RelayError::System {
        action,
        cause: cause.into(),
    }
}

/// Asks the launcher of this host to restart an actor whose chunks the replay has lost.
fn request_restart(requests: &LauncherRequests<()>, actor: u32, follow_up: ActorFollowUp) {
    if let ActorFollowUp::Restart(incarnation) = follow_up {
        tracing::warn!("the replay has lost chunks of actor {actor}; the actor is restarted");
        requests.ask(ControlRequest::Replace { actor, incarnation }, ());
    }
}

/// Starts the thread that sends chunks. It may block for seconds while the connection is down.
fn start_sending(session: &Session, host: &HostFile) -> Result<SyncSender<ZBytes>, RelayError> {
    let publisher = session
        .declare_publisher(network::chunks(&host.run_id, &host.host.to_string()))
        .congestion_control(CongestionControl::Block)
        .priority(Priority::DataHigh)
        .wait()
        .map_err(failed("send chunks"))?;
    let (sender, chunks) = sync_channel::<ZBytes>(CHUNK_QUEUE_LENGTH);
    std::thread::Builder::new()
        .name("sender".into())
        .spawn(move || {
            for chunk in chunks {
                if let Err(cause) = publisher.put(chunk).wait() {
                    tracing::debug!("a chunk was not sent: {cause}");
                }
            }
        })
        .map_err(system_error("start a thread"))?;
    Ok(sender)
}

/// The newest policy of this host; `None` before the first.
#[derive(Clone, Debug, Default)]
struct NewestPolicy(Arc<Mutex<Option<PolicyId>>>);

impl NewestPolicy {
    fn get(&self) -> Option<PolicyId> {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn set(&self, id: PolicyId) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(id);
    }
}

/// Starts the thread that always asks for a policy other than the last one.
fn start_asking_for_policies(
    session: &Session,
    host: &HostFile,
    arrival_sender: ArrivalSender,
    newest: NewestPolicy,
) -> Result<(), RelayError> {
    let (session, key, host) = (session.clone(), network::policy(&host.run_id), host.host);
    let ask = move || {
        while !session.is_closed() {
            let have = newest.get();
            let Ok(request) = (PolicyRequest { host, have }).encode() else {
                return;
            };
            let replies = session
                .get(&key)
                .payload(request)
                .timeout(POLICY_QUERY_TIMEOUT)
                // The policy has the congestion control of the request: `Drop` would never deliver a large one.
                .congestion_control(CongestionControl::Block)
                .wait();
            let reply = replies.ok().and_then(|replies| replies.recv().ok());
            let Some(sample) = reply.as_ref().and_then(|reply| reply.result().ok()) else {
                std::thread::sleep(POLICY_PAUSE);
                continue;
            };
            arrival_sender.send(Arrival::Policy(sample.payload().to_bytes().into_owned()));
            // The next request names this policy, so it waits until it is published here.
            let asked = Instant::now();
            while newest.get() == have && asked.elapsed() < POLICY_QUERY_TIMEOUT {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
    };
    std::thread::Builder::new()
        .name("policies".into())
        .spawn(ask)
        .map_err(system_error("start a thread"))?;
    Ok(())
}
