//! The gate, a role on the learner's host. To the learner it looks like the actors of the other hosts: it
//! forwards their chunks, each exactly once and in order. It acknowledges the chunks to the hosts, and sends them the
//! newest policy.

mod host;
mod policies;

use std::collections::{BTreeSet, HashMap};
use std::fmt;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use shoal_common::channel::control::{ControlRequest, ControlResponse, HostLease, HostRequest};
use shoal_common::channel::policy::PolicyReader;
use shoal_common::channel::reports::Reporter;
use shoal_common::channel::transitions::ChunkForwarder;
use shoal_common::channel::{ChannelError, Domain, EventName, HeartbeatSender, Notifier, PORT_TIMEOUT};
use shoal_common::commit::{CommitReader, OpenError};
use shoal_common::config::{Config, Mode};
use shoal_common::numbers::are_finite;
use shoal_common::policy::PolicyError;
use shoal_common::report::{EpisodeReport, Heartbeat};
use shoal_common::role::{Activity, Role, RoleInstance};
use shoal_common::run_dir::{RunDir, RunDirError};
use shoal_common::stop::Stop;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::Query;
use zenoh::{Session, Wait};

use self::host::Host;
use self::policies::Policies;
use crate::endpoint::Endpoint;
use crate::files::KeyFile;
use crate::forwarding::{ChunkOrder, Forwarding};
use crate::network::{self, CUT_OFF_AFTER, LONGEST_SLEEP, NetworkError, REFRESH_INTERVAL, failed};
use crate::refused;
use crate::relay::RELAY_HAND_OVER_TIMEOUT;
use crate::requests::LauncherRequests;
use crate::wire::vector_instructions;
use crate::wire::{
    Acknowledgement, ActorAcknowledgement, Admission, Hello, HostReport, MAX_SNAPSHOT_WORDS, Message, PolicyRequest,
    ReportNumber, RunPhase, WireChunk, WireError, WireLease,
};

/// The least and the greatest time between two acknowledgements to a host.
const SHORTEST_ACKNOWLEDGEMENT_INTERVAL: Duration = Duration::from_millis(1);
const LONGEST_ACKNOWLEDGEMENT_INTERVAL: Duration = Duration::from_millis(100);

/// How long to sleep at first while chunks wait to be committed. The sleep doubles, up to [`LONGEST_SLEEP`], while
/// nothing is committed.
const SHORTEST_SLEEP: Duration = Duration::from_micros(200);

/// How often the launcher gets the status of the hosts.
const STATUS_INTERVAL: Duration = Duration::from_millis(500);

/// After a host is released, its actors' channels stay open for at most this long, until the learner has committed what
/// they hold. A new actor of the learner's host waits longer for its channel.
const RELEASED_TIMEOUT: Duration = Duration::from_secs(4);
const _: () = assert!(RELEASED_TIMEOUT.as_millis() < PORT_TIMEOUT.as_millis());

/// How long the hosts may take to hand over what they have when the run is over.
const HOSTS_HAND_OVER_TIMEOUT: Duration = Duration::from_secs(5);
const _: () = assert!(RELAY_HAND_OVER_TIMEOUT.as_millis() < HOSTS_HAND_OVER_TIMEOUT.as_millis());

/// The least time between two warnings about wrong chunks of a host, or about refused connections.
const WARNING_INTERVAL: Duration = Duration::from_secs(10);

/// How long at least to announce that the run is over.
const END_ANNOUNCEMENT: Duration = Duration::from_secs(2);

/// How long hosts may take to find a new gate.
const RECONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// What the gate needs.
#[derive(Clone, Debug)]
pub struct GateSettings {
    /// Which process this is.
    pub instance: RoleInstance,
    /// The run's configuration.
    pub config: Config,
    /// The run's directory.
    pub run: RunDir,
    /// Where to listen.
    pub endpoint: Endpoint,
    /// The gate's key, unless the endpoint is not encrypted.
    pub key: Option<KeyFile>,
}

/// Why the gate ended.
#[derive(Debug, thiserror::Error)]
pub enum GateError {
    /// A channel of this host failed.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The network failed.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The replay cannot be read.
    #[error(transparent)]
    Replay(#[from] OpenError),
    /// The run's directory cannot be used.
    #[error(transparent)]
    Run(#[from] RunDirError),
    /// The policy of the run is impossible.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// A message cannot be encoded.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// The configuration cannot be written.
    #[error("cannot write the configuration: {0}")]
    Config(String),
    /// A thread cannot be started.
    #[error("cannot start a thread: {0}")]
    Thread(#[from] std::io::Error),
}

/// Something that has come from a host.
enum Arrival {
    Chunk(Vec<u8>),
    Report(Vec<u8>),
    Join(Query),
    Policy(Query),
}

/// An actor of another host.
struct RemoteActor {
    host: u64,
    /// When its host was released, if it was, and no other has the actor yet.
    released_at: Option<Instant>,
    /// `None` while the actor that the learner's host had before is ending, and for one that shares a service.
    forwarder: Option<ChunkForwarder>,
    forwarding: Forwarding,
}

/// What a request to the launcher was about.
enum PendingRequest {
    Join(Box<Query>, Hello),
    Hosts,
}

struct Gate<'a> {
    settings: &'a GateSettings,
    domain: &'a Domain,
    stop: &'a Stop,
    session: Session,
    arrivals: Receiver<Arrival>,
    requests: LauncherRequests<PendingRequest>,
    /// The launcher's epoch; `None` before its first answer.
    epoch: Option<u64>,
    hosts: HashMap<u64, Host>,
    actors: HashMap<u32, RemoteActor>,
    /// Of all actors that share a service; `None` while there are none, or an earlier gate's port is not freed.
    shared_forwarder: Option<ChunkForwarder>,
    replay: CommitReader,
    policies: Policies,
    learner_notifier: Notifier,
    heartbeat: HeartbeatSender,
    heartbeats: Reporter<Heartbeat>,
    episodes: Reporter<EpisodeReport>,
    /// The number of the last acknowledgement.
    acknowledgements_sent: u64,
    /// When [`warn`](Self::warn) last logged something.
    warned_at: Option<Instant>,
    /// When a refused connection was last logged. A host with a wrong key connects again and again, which must not hide
    /// other warnings.
    connection_warned_at: Option<Instant>,
    /// The line about the last host that was refused, and when it was written.
    last_refusal: Option<(Instant, String)>,
    started_at: Instant,
    /// Since when the run is over.
    over_since: Option<Instant>,
    connections_refreshed_at: Instant,
    /// When the launcher last got the status of the hosts.
    reported_to_launcher_at: Option<Instant>,
    /// Whether the launcher has yet to answer the last report on the hosts.
    awaits_launcher: bool,
    sleep: Duration,
}

/// Serves the other hosts of the run until `stop`.
///
/// # Errors
/// When a channel fails, or the endpoint cannot be used.
pub fn run(domain: &Domain, settings: &GateSettings, stop: &Stop) -> Result<(), GateError> {
    let Some(mut gate) = Gate::new(domain, settings, stop)? else {
        return Ok(());
    };
    gate.run()
}

impl<'a> Gate<'a> {
    /// `None` if it was asked to end before there was a replay.
    fn new(domain: &'a Domain, settings: &'a GateSettings, stop: &'a Stop) -> Result<Option<Self>, GateError> {
        let (config, run) = (&settings.config, &settings.run);
        let mut heartbeat = HeartbeatSender::new(domain, settings.instance)?;
        let replay = loop {
            if let Some(replay) = CommitReader::open_if_ready(&run.replay_file())? {
                break replay;
            }
            if stop.requested() {
                return Ok(None);
            }
            std::thread::sleep(LONGEST_SLEEP);
            heartbeat.beat(Activity::WaitingForPeer);
        };
        let layout = config.policy_layout()?;
        let policy = PolicyReader::open(domain, layout.fingerprint(), layout.parameters())?;
        let requests = LauncherRequests::start(&config.run.id, config.actors.max_on_a_host(), run.directory_id()?)?;
        let session = network::listen(&settings.endpoint, settings.key.as_ref())?;
        let (sender, arrivals) = channel();
        declare(&session, &config.run.id, &sender)?;
        heartbeat.beat_now(Activity::WaitingForPeer);
        tracing::info!("listening on {}", settings.endpoint);
        Ok(Some(Self {
            settings,
            domain,
            stop,
            session,
            arrivals,
            requests,
            epoch: None,
            hosts: HashMap::new(),
            actors: HashMap::new(),
            shared_forwarder: None,
            replay,
            policies: Policies::new(policy, config.remote.policy_bandwidth),
            learner_notifier: Notifier::new(domain, EventName(Role::Learner, 0))?,
            heartbeat,
            heartbeats: Reporter::open(domain)?,
            episodes: Reporter::open(domain)?,
            acknowledgements_sent: 0,
            warned_at: None,
            connection_warned_at: None,
            last_refusal: None,
            started_at: Instant::now(),
            over_since: None,
            connections_refreshed_at: Instant::now(),
            reported_to_launcher_at: None,
            awaits_launcher: false,
            sleep: LONGEST_SLEEP,
        }))
    }

    fn run(&mut self) -> Result<(), GateError> {
        loop {
            // The channel is never closed: its senders live as long as the session, which the gate owns.
            let first = self.arrivals.recv_timeout(self.sleep).ok();
            let more: Vec<Arrival> = self.arrivals.try_iter().collect();
            let mut forwarded_rows = 0;
            for arrival in first.into_iter().chain(more) {
                forwarded_rows += self.handle(arrival)?;
            }
            if forwarded_rows > 0 {
                self.learner_notifier.notify();
                self.heartbeat.count(forwarded_rows);
            }
            self.handle_answers()?;
            let progress = self.read_commits();
            self.send_acknowledgements()?;
            self.policies.send(&mut self.hosts)?;
            self.report_to_launcher();
            self.refresh_connections()?;
            self.choose_sleep(forwarded_rows > 0 || progress);
            if self.is_done() {
                return Ok(());
            }
        }
    }

    /// Whether to end now. When the run is over, the hosts are told and hand over what they have. If the launcher has
    /// died, they wait for its successor.
    fn is_done(&mut self) -> bool {
        if !self.stop.requested() {
            return false;
        }
        if self.stop.run_is_ending() {
            return true;
        }
        let since = *self.over_since.get_or_insert_with(Instant::now);
        // The announcement also reaches a host that reconnects meanwhile.
        let was_announced = since.elapsed() >= END_ANNOUNCEMENT;
        let gone = |host: &Host| host.has_left || (was_announced && host.heard_at.elapsed() >= CUT_OFF_AFTER);
        // A gate that has just started does not know its hosts before the launcher has answered. Hosts that the
        // launcher does not know yet need a moment to connect.
        let knows_all = self.epoch.is_some() && (was_announced || since >= self.started_at + RECONNECT_TIMEOUT);
        let has_told_all = knows_all && self.hosts.values().all(gone);
        has_told_all || since.elapsed() >= HOSTS_HAND_OVER_TIMEOUT
    }

    /// Handles what a host has sent. Returns the rows that were forwarded to the learner.
    fn handle(&mut self, arrival: Arrival) -> Result<u64, GateError> {
        match arrival {
            Arrival::Chunk(bytes) => return self.handle_chunk(&bytes),
            Arrival::Report(bytes) => match HostReport::decode(&bytes) {
                Ok(report) => self.handle_report(report)?,
                Err(error) => self.warn(format_args!("a host sent a report that is not read: {error}")),
            },
            Arrival::Join(query) => self.handle_join(query)?,
            Arrival::Policy(query) => self.handle_policy_query(query),
        }
        Ok(0)
    }

    fn handle_chunk(&mut self, bytes: &[u8]) -> Result<u64, GateError> {
        let chunk = match WireChunk::decode(bytes) {
            Ok(chunk) => chunk,
            Err(error) => {
                self.warn(format_args!("a host sent a chunk that is not read: {error}"));
                return Ok(0);
            }
        };
        let Some(actor) = self.actors.get_mut(&chunk.header.actor) else {
            return Ok(0);
        };
        let Some(host) = self.hosts.get_mut(&chunk.host).filter(|_| actor.host == chunk.host) else {
            return Ok(0);
        };
        host.heard_at = Instant::now();
        // There is no lower bound: a host that was admitted again may have processes of an earlier lease.
        let is_of_host = chunk.header.incarnation < host.lease.limit;
        // Until there is a way to the learner, the host sends it again.
        let forwarder = if self.settings.config.actors.has_own_service(chunk.header.actor) {
            &actor.forwarder
        } else {
            &self.shared_forwarder
        };
        let Some(forwarder) = forwarder else {
            return Ok(0);
        };
        let parts = forwarder.parts(&chunk.header, &chunk.numbers);
        if !(is_of_host && parts.is_some_and(|(rows, _)| are_finite(rows))) {
            // The host sends it again and again, so the warnings are limited.
            if may_warn(&mut host.warned_at) {
                tracing::warn!(
                    "host {} sent an invalid chunk of actor {} (of another shape, with a number that is not finite, or with \
                     an incarnation that the host was not given); it is ignored",
                    host.lease.name,
                    chunk.header.actor
                );
            }
            return Ok(0);
        }
        if actor.forwarding.offer(chunk.id()) != ChunkOrder::Next {
            return Ok(0);
        }
        forwarder.send(chunk.header, &chunk.numbers)?;
        host.forwarded_rows += u64::from(chunk.header.rows);
        host.acknowledgement_due = true;
        Ok(chunk.header.rows.into())
    }

    fn handle_report(&mut self, mut report: HostReport) -> Result<(), GateError> {
        let Some(host) = self.hosts.get_mut(&report.host) else {
            // The empty acknowledgement makes it ask to be admitted.
            return self.acknowledge_nothing(report.host);
        };
        (host.heard_at, host.has_contacted) = (Instant::now(), true);
        if report.number <= host.last_report {
            return Ok(());
        }
        host.last_report = report.number;
        host.acknowledgement_due = true;
        host.has_left = report.leaving;
        // A host may lie.
        let mut known = BTreeSet::new();
        report.roles.retain(|role| {
            matches!(role.role, Role::Actor | Role::EnvServer)
                && host.lease.actors.contains(&role.index)
                && known.insert((role.role, role.index))
        });
        for role in &report.roles {
            // This heartbeat makes the learner open the actor's own service.
            let has_own_service = self.settings.config.actors.has_own_service(role.index);
            if role.role == Role::Actor && has_own_service {
                self.heartbeats.send(role.heartbeat());
            }
        }
        let (config, rows) = (&self.settings.config, self.replay.rows());
        for episode in std::mem::take(&mut report.episodes) {
            let is_possible = host.lease.actors.contains(&episode.actor)
                && episode.environment < config.actors.envs
                && episode.steps <= config.spec.time_limit
                && episode.episode_return.is_finite();
            if is_possible {
                let mut episode = EpisodeReport::from(episode);
                episode.env_steps = episode.env_steps.min(rows);
                self.episodes.send(episode);
            }
        }
        host.newest_report = Some(report);
        Ok(())
    }

    fn handle_join(&mut self, query: Query) -> Result<(), GateError> {
        let bytes = query.payload().map(|payload| payload.to_bytes().into_owned());
        let hello = match Hello::decode(&bytes.unwrap_or_default()) {
            Ok(hello) => hello.with_plain_texts(),
            Err(error) => return answer_join(&query, &Admission::Refused(error.to_string())),
        };
        if let Some(why) = self.reason_to_refuse(&hello) {
            return self.refuse(&query, &hello.name, why);
        }
        let request = HostRequest {
            host: hello.host,
            name: hello.name.clone(),
            actors: hello.actors,
            cores: hello.cores,
            held: hello.held.clone(),
        };
        self.requests.ask(
            ControlRequest::Admit(request),
            PendingRequest::Join(Box::new(query), hello),
        );
        Ok(())
    }

    /// Why a host cannot be admitted, whatever the launcher says.
    fn reason_to_refuse(&self, hello: &Hello) -> Option<String> {
        if hello.program != env!("CARGO_PKG_VERSION") {
            return Some(format!(
                "this host has version {} of the program, the learner's host {}: install the same version on both",
                hello.program,
                env!("CARGO_PKG_VERSION")
            ));
        }
        let (theirs, ours) = (&hello.instructions, vector_instructions());
        if self.settings.config.run.mode == Mode::Lockstep && *theirs != ours {
            return Some(format!(
                "this host's processor has other vector instructions ({theirs}) than the learner's ({ours}): a lockstep run \
                 would not have the same bits; join from a host with the same ones"
            ));
        }
        let words = self.replay.layout().actor_snapshot_words;
        let most = MAX_SNAPSHOT_WORDS.checked_div(words).unwrap_or(usize::MAX);
        (hello.actors as usize > most).then(|| {
            format!(
                "the snapshots of {} actors are too large for one host: it may have {most}",
                hello.actors
            )
        })
    }

    /// Refuses a host. It may ask again every second, so the log repeats a line only after [`WARNING_INTERVAL`].
    fn refuse(&mut self, query: &Query, name: &str, why: String) -> Result<(), GateError> {
        let line = format!("host {name} is refused: {why}");
        let last = self.last_refusal.as_ref();
        if last.is_none_or(|(then, last)| *last != line || then.elapsed() >= WARNING_INTERVAL) {
            tracing::warn!("{line}");
            self.last_refusal = Some((Instant::now(), line));
        }
        answer_join(query, &Admission::Refused(why))
    }

    fn handle_policy_query(&mut self, query: Query) {
        let bytes = query.payload().map(|payload| payload.to_bytes().into_owned());
        match PolicyRequest::decode(&bytes.unwrap_or_default()) {
            Ok(request) => {
                if let Some(host) = self.hosts.get_mut(&request.host) {
                    host.policy_query = Some((query, request.have, Instant::now()));
                }
            }
            Err(error) => self.warn(format_args!("a host sent a request that is not read: {error}")),
        }
    }

    /// Warns, but at most once in [`WARNING_INTERVAL`]: a host may repeat the same fault without end.
    fn warn(&mut self, what: fmt::Arguments<'_>) {
        if may_warn(&mut self.warned_at) {
            tracing::warn!("{what}");
        }
    }

    /// Handles what the launcher has answered.
    fn handle_answers(&mut self) -> Result<(), GateError> {
        while let Some((answer, pending)) = self.requests.answer() {
            self.awaits_launcher &= !matches!(pending, PendingRequest::Hosts);
            match (answer, pending) {
                (Ok(ControlResponse::Admitted(lease)), PendingRequest::Join(query, hello)) => {
                    tracing::info!(
                        "host {} is admitted with {} actors: {:?}",
                        hello.name,
                        lease.actors.len(),
                        lease.actors
                    );
                    let config = self.settings.config.to_toml();
                    let answer = WireLease {
                        epoch: lease.epoch,
                        config: config.map_err(|error| GateError::Config(error.to_string()))?,
                        actors: lease.actors.clone(),
                        first_incarnation: lease.first_incarnation,
                        limit: lease.limit,
                    };
                    self.epoch = Some(lease.epoch);
                    self.admit(lease, true)?;
                    answer_join(&query, &Admission::Admitted(answer))?;
                }
                (Ok(ControlResponse::RunIsEnding), PendingRequest::Join(query, _)) => {
                    answer_join(&query, &Admission::RunIsEnding)?;
                }
                // A host that gets no answer asks again.
                (Ok(ControlResponse::NotNow(why)) | Err(why), PendingRequest::Join(_, hello)) => {
                    self.warn(format_args!("host {} is not admitted for now: {why}", hello.name));
                }
                (Ok(answer), PendingRequest::Join(query, hello)) => {
                    let why = match answer {
                        ControlResponse::Refused(why) => why,
                        other => format!("the launcher gave an unexpected answer: {other:?}"),
                    };
                    self.refuse(&query, &hello.name, why)?;
                }
                (Ok(ControlResponse::Leases { epoch, leases }), PendingRequest::Hosts) => {
                    self.epoch = Some(epoch);
                    let released = |host: &u64| !leases.iter().any(|lease| lease.host == *host);
                    let gone: Vec<u64> = self.hosts.keys().copied().filter(released).collect();
                    gone.iter().for_each(|host| self.release(*host));
                    leases.into_iter().try_for_each(|lease| self.admit(lease, false))?;
                }
                (answer, PendingRequest::Hosts) => {
                    tracing::debug!("the launcher did not say which hosts are admitted: {answer:?}")
                }
            }
        }
        Ok(())
    }

    /// Admits a host, or updates its lease. `asks` is whether the host has just asked for it.
    fn admit(&mut self, lease: HostLease, asks: bool) -> Result<(), GateError> {
        if let Some(host) = self.hosts.get_mut(&lease.host) {
            // Another number of actors is only announced: the host joins again for it.
            host.lease.wanted_actors = lease.wanted_actors;
            if host.lease == lease {
                return Ok(());
            }
        }
        let report = self
            .hosts
            .get(&lease.host)
            .map_or_else(ReportNumber::default, |host| host.last_report);
        self.release(lease.host);
        let config = &self.settings.config;
        for index in &lease.actors {
            let committed = self.replay.committed(*index as usize);
            // What another host has sent may be forwarded and not committed yet: the next chunks follow on that.
            let actor = self.actors.entry(*index).or_insert_with(|| RemoteActor {
                host: lease.host,
                released_at: None,
                forwarder: None,
                forwarding: Forwarding::new(committed, config.actors.window),
            });
            (actor.host, actor.released_at) = (lease.host, None);
        }
        let now = Instant::now();
        let host = Host {
            acknowledgements: acknowledgement_publisher(&self.session, &config.run.id, lease.host)?,
            last_acknowledged: Vec::new(),
            acknowledged_at: now,
            acknowledgement_due: true,
            heard_at: now,
            has_contacted: asks,
            last_report: report,
            has_left: false,
            newest_report: None,
            warned_at: None,
            forwarded_rows: 0,
            rows_at_last_status: (now, 0),
            rows_per_second: 0.0,
            steps_at_last_status: HashMap::new(),
            policy_query: None,
            lease,
        };
        self.hosts.insert(host.lease.host, host);
        self.open_forwarders()
    }

    /// Opens a forwarder for each actor for which no other process sends.
    fn open_forwarders(&mut self) -> Result<(), GateError> {
        let config = &self.settings.config;
        let (layout, window) = (config.chunk_layout(), config.actors.window);
        let mut any_shares = false;
        for (index, actor) in &mut self.actors {
            if !config.actors.has_own_service(*index) {
                any_shares = true;
            } else if actor.forwarder.is_none() {
                actor.forwarder = ChunkForwarder::try_open(self.domain, *index, layout, window)?;
            }
        }
        if any_shares && self.shared_forwarder.is_none() {
            let actors = config.actors_that_share();
            self.shared_forwarder = ChunkForwarder::try_open_shared(self.domain, actors, layout, window)?;
        }
        Ok(())
    }

    fn release(&mut self, host: u64) {
        self.hosts.remove(&host);
        for actor in self.actors.values_mut().filter(|actor| actor.host == host) {
            actor.released_at.get_or_insert_with(Instant::now);
        }
        self.forget_released();
    }

    /// Forgets the actors of released hosts when what was forwarded is committed: a new learner would need the history
    /// of their channels. An actor that the learner's host may take over is forgotten after [`RELEASED_TIMEOUT`] in any
    /// case. In lockstep actors are forgotten at once: an unfinished round is collected again.
    fn forget_released(&mut self) {
        let config = &self.settings.config;
        self.actors.retain(|index, actor| {
            let may_be_needed = |since: Instant| {
                config.run.mode == Mode::Free
                    && actor.forwarding.is_waiting()
                    && (!config.actors.has_own_service(*index) || since.elapsed() < RELEASED_TIMEOUT)
            };
            actor.released_at.is_none_or(may_be_needed)
        });
    }

    /// Reads what the learner has committed. Returns whether anything has changed.
    fn read_commits(&mut self) -> bool {
        let mut news = false;
        for (index, actor) in &mut self.actors {
            let committed = self.replay.committed(*index as usize);
            if committed != actor.forwarding.committed() {
                actor.forwarding.commit(committed);
                news = true;
            }
        }
        news
    }

    fn send_acknowledgements(&mut self) -> Result<(), GateError> {
        let Some(without_actors) = self.acknowledgement_without_actors() else {
            return Ok(());
        };
        if self
            .hosts
            .values()
            .all(|host| host.acknowledged_at.elapsed() < SHORTEST_ACKNOWLEDGEMENT_INTERVAL)
        {
            return Ok(());
        }
        // What is committed and the snapshots must belong together.
        let has_snapshots = self.replay.layout().actor_snapshot_words > 0;
        let record = if has_snapshots { self.replay.snapshot() } else { None };
        if has_snapshots && record.is_none() {
            return Ok(());
        }
        for host in self.hosts.values_mut() {
            let since = host.acknowledged_at.elapsed();
            if since < SHORTEST_ACKNOWLEDGEMENT_INTERVAL {
                continue;
            }
            let of = |actor: &u32| {
                let index = *actor as usize;
                let (commit, snapshot) = match &record {
                    Some(record) => (record.actor(index), record.actor_snapshot(index).to_vec()),
                    None => (self.replay.actor(index), Vec::new()),
                };
                let forwarded = self
                    .actors
                    .get(actor)
                    .map_or(commit.last_chunk, |actor| actor.forwarding.last_forwarded());
                ActorAcknowledgement {
                    actor: *actor,
                    committed: commit.last_chunk,
                    forwarded,
                    rows: commit.rows,
                    snapshot,
                }
            };
            let actors: Vec<ActorAcknowledgement> = host.lease.actors.iter().map(of).collect();
            if !host.acknowledgement_due && since < LONGEST_ACKNOWLEDGEMENT_INTERVAL && actors == host.last_acknowledged
            {
                continue;
            }
            self.acknowledgements_sent += 1;
            let acknowledgement = Acknowledgement {
                number: self.acknowledgements_sent,
                report: host.last_report,
                wanted_actors: host.lease.wanted_actors,
                actors,
                ..without_actors.clone()
            };
            host.acknowledgements
                .put(acknowledgement.encode()?)
                .wait()
                .map_err(failed("send an acknowledgement"))?;
            host.last_acknowledged = acknowledgement.actors;
            (host.acknowledged_at, host.acknowledgement_due) = (Instant::now(), false);
        }
        Ok(())
    }

    /// The part of the next acknowledgement that is the same for every host. `None` before the launcher has answered.
    fn acknowledgement_without_actors(&self) -> Option<Acknowledgement> {
        Some(Acknowledgement {
            epoch: self.epoch?,
            gate: self.settings.instance.incarnation,
            number: self.acknowledgements_sent + 1,
            phase: if self.over_since.is_some() {
                RunPhase::Over
            } else {
                RunPhase::Running
            },
            rows: self.replay.rows(),
            report: ReportNumber::default(),
            wanted_actors: 0,
            actors: Vec::new(),
        })
    }

    /// An acknowledgement without actors, for a host that is not admitted.
    fn acknowledge_nothing(&mut self, host: u64) -> Result<(), GateError> {
        let Some(acknowledgement) = self.acknowledgement_without_actors() else {
            return Ok(());
        };
        self.acknowledgements_sent = acknowledgement.number;
        let publisher = acknowledgement_publisher(&self.session, &self.settings.config.run.id, host)?;
        publisher
            .put(acknowledgement.encode()?)
            .wait()
            .map_err(failed("send an acknowledgement"))?;
        Ok(())
    }

    /// Sends the launcher the status of the hosts, and asks which are admitted.
    fn report_to_launcher(&mut self) {
        if self.awaits_launcher
            || self
                .reported_to_launcher_at
                .is_some_and(|at| at.elapsed() < STATUS_INTERVAL)
        {
            return;
        }
        (self.reported_to_launcher_at, self.awaits_launcher) = (Some(Instant::now()), true);
        let newest = self.policies.version();
        let statuses = self.hosts.values_mut().map(|host| host.status(newest)).collect();
        self.requests
            .ask(ControlRequest::Hosts(statuses), PendingRequest::Hosts);
        self.heartbeat.set_policy_version(newest);
    }

    fn refresh_connections(&mut self) -> Result<(), GateError> {
        if self.connections_refreshed_at.elapsed() < REFRESH_INTERVAL {
            return Ok(());
        }
        self.connections_refreshed_at = Instant::now();
        if let Some(why) = refused::take()
            && may_warn(&mut self.connection_warned_at)
        {
            tracing::warn!("a connection was refused: {why}; only hosts with the run's join.key are let in");
        }
        self.forget_released();
        self.policies.refresh()?;
        self.heartbeats.refresh_connections();
        self.episodes.refresh_connections();
        let waits = self.actors.values().any(|actor| actor.forwarding.is_waiting());
        self.heartbeat.beat(match waits {
            // Waiting for another host is no fault of a process here, so none is replaced for it.
            _ if self.hosts.values().any(Host::is_awaited) => Activity::Working,
            true => Activity::WaitingForRatio,
            false => Activity::WaitingForPeer,
        });
        let own = self.actors.values().filter_map(|actor| actor.forwarder.as_ref());
        let mut forwarders = own.chain(&self.shared_forwarder);
        forwarders.try_for_each(ChunkForwarder::refresh_connections)?;
        self.open_forwarders()
    }

    /// The learner notifies only actors, so the gate looks at the commit record: often while chunks are being
    /// committed, less often while the learner is busy with its updates.
    fn choose_sleep(&mut self, progress: bool) {
        let waits = self.actors.values().any(|actor| actor.forwarding.is_waiting());
        self.sleep = match (waits, progress) {
            (true, true) => SHORTEST_SLEEP,
            (true, false) => (2 * self.sleep).min(LONGEST_SLEEP),
            // The acknowledgement may have to wait for the least interval.
            (false, true) => SHORTEST_ACKNOWLEDGEMENT_INTERVAL,
            (false, false) => LONGEST_SLEEP,
        };
    }
}

/// Whether there was no warning for [`WARNING_INTERVAL`]. The caller must then warn: this is noted as a warning.
fn may_warn(warned_at: &mut Option<Instant>) -> bool {
    let may = warned_at.is_none_or(|warned| warned.elapsed() >= WARNING_INTERVAL);
    if may {
        *warned_at = Some(Instant::now());
    }
    may
}

/// Declares what the gate receives. The session keeps the declarations.
fn declare(session: &Session, run_id: &str, arrivals: &Sender<Arrival>) -> Result<(), NetworkError> {
    // A callback fails only while the gate ends.
    let sender = arrivals.clone();
    session
        .declare_subscriber(network::chunks(run_id, "*"))
        .callback(move |sample| drop(sender.send(Arrival::Chunk(sample.payload().to_bytes().into_owned()))))
        .background()
        .wait()
        .map_err(failed("receive chunks"))?;
    let sender = arrivals.clone();
    session
        .declare_subscriber(network::reports(run_id, "*"))
        .callback(move |sample| drop(sender.send(Arrival::Report(sample.payload().to_bytes().into_owned()))))
        .background()
        .wait()
        .map_err(failed("receive reports"))?;
    let sender = arrivals.clone();
    session
        .declare_queryable(network::join(run_id))
        .callback(move |query| drop(sender.send(Arrival::Join(query))))
        .background()
        .wait()
        .map_err(failed("receive join requests"))?;
    let sender = arrivals.clone();
    session
        .declare_queryable(network::policy(run_id))
        .callback(move |query| drop(sender.send(Arrival::Policy(query))))
        .background()
        .wait()
        .map_err(failed("receive policy requests"))
}

/// Only the newest acknowledgement counts, and it is repeated, so one may be dropped where the network is busy.
fn acknowledgement_publisher(session: &Session, run_id: &str, host: u64) -> Result<Publisher<'static>, NetworkError> {
    session
        .declare_publisher(network::acknowledgements(run_id, host))
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::InteractiveHigh)
        .express(true)
        .wait()
        .map_err(failed("send an acknowledgement"))
}

fn answer_join(query: &Query, admission: &Admission) -> Result<(), GateError> {
    let sent = query.reply(query.key_expr().clone(), admission.encode()?).wait();
    if let Err(cause) = sent {
        tracing::debug!("a host did not get its answer: {cause}");
    }
    Ok(())
}
