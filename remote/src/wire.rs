//! The bytes between gate and relay. Numbers are little-endian.
//!
//! Every message begins with a word that states what it is and the version of this format, and ends with the CRC-32 of
//! all bytes before it. Chunks and policies are a header and `f32` numbers as they stand in memory. All other messages
//! are encoded by bincode.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use shoal_common::channel::policy::PolicyHeader;
use shoal_common::channel::transitions::ChunkHeader;
use shoal_common::commit::ChunkId;
use shoal_common::report::{EpisodeReport, Heartbeat};
use shoal_common::role::{Activity, Role, RoleInstance};

/// The version of this format. Increase it with every change.
pub const VERSION: u32 = 2;

/// The longest message, in bytes: far more than any policy or chunk has.
pub const LONGEST: usize = 256 << 20;

const CHECKSUM: usize = size_of::<u32>();

/// Why bytes are not a message.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// They do not begin as a message of this kind.
    #[error("the message is not what was expected")]
    MessageKind,
    /// They have another version of the format.
    #[error("the message has format {0}, this program uses format {VERSION}: use the same program on all hosts")]
    Version(u32),
    /// Their checksum is wrong.
    #[error("the message is damaged: its checksum is wrong")]
    Checksum,
    /// They have the wrong length.
    #[error("the message has a wrong length of {0} bytes")]
    Length(usize),
    /// They encode nothing that is valid.
    #[error("the message cannot be read: {0}")]
    Contents(String),
}

/// What a message is.
#[doc(hidden)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum MessageKind {
    Chunk = 1,
    Policy = 2,
    Hello = 3,
    Admission = 4,
    Acknowledgement = 5,
    HostReport = 6,
    PolicyRequest = 7,
}

/// The first word of a message has these letters in its upper half and the kind in its lower; the second is the
/// version.
const LETTERS: u32 = (b's' as u32) << 16 | (b'h' as u32) << 24;

/// Bytes of the first two words.
const START: usize = 2 * size_of::<u32>();

/// A chunk as it travels: the numbers of its rows, and after them those of the actor's snapshot if there is one.
#[derive(Clone, Debug, PartialEq)]
pub struct WireChunk {
    /// The host that sends it.
    pub host: u64,
    /// Its header.
    pub header: ChunkHeader,
    /// Rows and snapshot.
    pub numbers: Vec<f32>,
}

impl WireChunk {
    /// Its own incarnation and sequence number.
    pub fn id(&self) -> ChunkId {
        id_of(&self.header)
    }

    /// The bytes of a chunk.
    pub fn encode(host: u64, header: &ChunkHeader, rows: &[f32], snapshot: &[f32]) -> Vec<u8> {
        let start = [
            host,
            header.incarnation,
            header.sequence,
            header.policy_version,
            u64::from(header.rows) << 32 | u64::from(header.actor),
        ];
        sealed(
            MessageKind::Chunk,
            &[
                &words(&start),
                bytemuck::cast_slice(rows),
                bytemuck::cast_slice(snapshot),
            ],
        )
    }

    /// Reads a chunk.
    ///
    /// # Errors
    /// When the bytes are not a whole chunk of this version.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let body = opened(MessageKind::Chunk, bytes)?;
        let ([host, incarnation, sequence, policy_version, rows_and_actor], numbers) = split(body, bytes.len())?;
        let header = ChunkHeader {
            incarnation,
            sequence,
            policy_version,
            rows: (rows_and_actor >> 32) as u32,
            actor: rows_and_actor as u32,
        };
        Ok(Self { host, header, numbers })
    }
}

/// The numbers in a chunk's header that identify it; a handshake has sequence number 0.
pub fn id_of(header: &ChunkHeader) -> ChunkId {
    ChunkId {
        incarnation: header.incarnation,
        sequence: header.sequence,
    }
}

/// A policy as it travels.
#[derive(Clone, Debug, PartialEq)]
pub struct WirePolicy {
    /// Its header.
    pub header: PolicyHeader,
    /// Its parameters.
    pub parameters: Vec<f32>,
}

impl WirePolicy {
    /// The bytes of a policy.
    pub fn encode(header: &PolicyHeader, parameters: &[f32]) -> Vec<u8> {
        let start = [
            header.incarnation,
            header.version,
            header.env_steps,
            header.updates,
            header.fingerprint,
        ];
        sealed(MessageKind::Policy, &[&words(&start), bytemuck::cast_slice(parameters)])
    }

    /// Reads a policy.
    ///
    /// # Errors
    /// When the bytes are not a whole policy of this version.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let body = opened(MessageKind::Policy, bytes)?;
        let ([incarnation, version, env_steps, updates, fingerprint], parameters) = split(body, bytes.len())?;
        let header = PolicyHeader {
            incarnation,
            version,
            env_steps,
            updates,
            fingerprint,
        };
        Ok(Self { header, parameters })
    }
}

/// What identifies a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PolicyId {
    /// Incarnation of the learner that published it.
    pub incarnation: u64,
    /// Its version.
    pub version: u64,
}

impl From<&PolicyHeader> for PolicyId {
    fn from(header: &PolicyHeader) -> Self {
        Self {
            incarnation: header.incarnation,
            version: header.version,
        }
    }
}

/// A host's request for a policy that it does not have. The gate answers when there is one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PolicyRequest {
    /// The host.
    pub host: u64,
    /// The policy that it has; `None` before the first.
    pub have: Option<PolicyId>,
}

/// A host's request to be admitted to a run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// Version of the program.
    pub program: String,
    /// A number that the host has drawn; it keeps it until it joins again.
    pub host: u64,
    /// The host's name, for people.
    pub name: String,
    /// The vector instructions of its processor. Bits of policies depend on them.
    pub instructions: String,
    /// The number of actors that it offers.
    pub actors: u32,
    /// The number of its processor cores.
    pub cores: u32,
    /// The actors that it has already, if it was admitted before.
    pub held: Vec<u32>,
}

/// The longest name of a host, in bytes, and the longest other text.
const LONGEST_NAME: usize = 64;
const LONGEST_TEXT: usize = 256;

impl Hello {
    /// The same with texts that can be shown on a terminal and fit into messages.
    pub fn with_plain_texts(mut self) -> Self {
        make_plain(&mut self.name, LONGEST_NAME);
        make_plain(&mut self.program, LONGEST_TEXT);
        make_plain(&mut self.instructions, LONGEST_TEXT);
        self
    }
}

/// Removes control characters, and all beyond this number of bytes.
fn make_plain(text: &mut String, longest: usize) {
    text.retain(|letter| !letter.is_control());
    let end = (0..=longest).rev().find(|end| text.is_char_boundary(*end));
    text.truncate(end.unwrap_or(0));
}

/// The number of processor cores of this host.
pub fn cores() -> u32 {
    std::thread::available_parallelism().map_or(1, |cores| cores.get() as u32)
}

/// The vector instructions of this processor that the program may use.
pub fn vector_instructions() -> String {
    let mut found = Vec::new();
    #[cfg(target_arch = "x86_64")]
    {
        for (name, present) in [
            ("avx2", std::is_x86_feature_detected!("avx2")),
            ("fma", std::is_x86_feature_detected!("fma")),
            ("avx512f", std::is_x86_feature_detected!("avx512f")),
            ("avx512vl", std::is_x86_feature_detected!("avx512vl")),
            ("avx512dq", std::is_x86_feature_detected!("avx512dq")),
        ] {
            if present {
                found.push(name);
            }
        }
    }
    format!("{} {}", std::env::consts::ARCH, found.join(" "))
}

/// The answer to a [`Hello`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Admission {
    /// The host may work for the run.
    Admitted(WireLease),
    /// It may not, for this reason.
    Refused(String),
    /// It may not, because the run is ending.
    RunIsEnding,
}

/// What a host is given.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireLease {
    /// Number of the launcher's start that admitted it. After another start it must ask again.
    pub epoch: u64,
    /// The run's `config.toml`.
    pub config: String,
    /// The indices of its actors.
    pub actors: Vec<u32>,
    /// The incarnations that its processes have: from this one on …
    pub first_incarnation: u64,
    /// … and below this one.
    pub limit: u64,
}

/// Whether the run continues.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum RunPhase {
    /// The run continues.
    Running,
    /// It is over, because it is finished or was stopped: the host ends too.
    Over,
}

/// What the gate tells a host: what is committed of its actors, and what it has forwarded. Only the newest one counts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Acknowledgement {
    /// See [`WireLease::epoch`].
    pub epoch: u64,
    /// Incarnation of the gate. Those of a later gate, and later ones of the same gate, are newer.
    pub gate: u64,
    /// Its number among those of this gate.
    pub number: u64,
    /// Whether the run continues.
    pub phase: RunPhase,
    /// Rows in the replay.
    pub rows: u64,
    /// The number of the last report that the gate has received from this host.
    pub report: ReportNumber,
    /// The number of actors that the run wants this host to have.
    pub wanted_actors: u32,
    /// For each actor of the host.
    pub actors: Vec<ActorAcknowledgement>,
}

/// What has become of an actor's chunks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ActorAcknowledgement {
    /// The actor.
    pub actor: u32,
    /// Its last committed chunk.
    pub committed: ChunkId,
    /// The last chunk that the gate has forwarded to the learner.
    pub forwarded: ChunkId,
    /// Rows of all its committed chunks.
    pub rows: u64,
    /// The actor's snapshot after its last committed chunk, in runs that have snapshots.
    pub snapshot: Vec<u64>,
}

/// The number of a host's report. Numbers are ordered by relay, then by report.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct ReportNumber {
    /// The incarnation of the relay that sends the report; 0 if the host has no relay.
    pub relay: u64,
    /// Counts the reports of this relay.
    pub report: u64,
}

/// What a host tells the gate a few times a second. Some may be lost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HostReport {
    /// The host.
    pub host: u64,
    /// The number of this report.
    pub number: ReportNumber,
    /// Microseconds between an earlier report and the acknowledgement that confirmed it; `None` before the first.
    pub round_trip_us: Option<u64>,
    /// Whether the host is leaving the run, and sends nothing more.
    pub leaving: bool,
    /// Chunks sent more than once.
    pub resent: u64,
    /// Version of the newest policy that it has.
    pub policy_version: u64,
    /// The state of its actors and environment servers.
    pub roles: Vec<RemoteRole>,
    /// Episodes that ended since the last report.
    pub episodes: Vec<RemoteEpisode>,
}

impl HostReport {
    /// The report of a host without processes.
    pub fn without_processes(host: u64, number: ReportNumber, leaving: bool) -> Self {
        Self {
            host,
            number,
            round_trip_us: None,
            leaving,
            resent: 0,
            policy_version: 0,
            roles: Vec::new(),
            episodes: Vec::new(),
        }
    }
}

/// The last heartbeat of a process on another host.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RemoteRole {
    /// Its role.
    pub role: Role,
    /// Its index.
    pub index: u32,
    /// What it is doing.
    pub activity: Activity,
    /// Invalid answers of its environments.
    pub faults: u32,
    /// Its incarnation.
    pub incarnation: u64,
    /// Environment steps since its start.
    pub steps: u64,
    /// The policy that it uses.
    pub policy_version: u64,
}

impl RemoteRole {
    /// That of a heartbeat; `None` if this build does not know its role or activity.
    pub fn of(heartbeat: &Heartbeat) -> Option<Self> {
        Some(Self {
            role: heartbeat.role()?,
            index: heartbeat.index,
            activity: heartbeat.activity()?,
            faults: heartbeat.faults,
            incarnation: heartbeat.incarnation,
            steps: heartbeat.steps,
            policy_version: heartbeat.policy_version,
        })
    }

    /// The heartbeat.
    pub fn heartbeat(&self) -> Heartbeat {
        let mut heartbeat = Heartbeat::new(RoleInstance {
            role: self.role,
            index: self.index,
            incarnation: self.incarnation,
        });
        heartbeat.set_activity(self.activity);
        heartbeat.faults = self.faults;
        heartbeat.steps = self.steps;
        heartbeat.policy_version = self.policy_version;
        heartbeat
    }
}

/// An episode that has ended on another host.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RemoteEpisode {
    /// The actor.
    pub actor: u32,
    /// The environment, among the actor's.
    pub environment: u32,
    /// Steps.
    pub steps: u32,
    /// Whether it terminated; otherwise it was truncated.
    pub terminated: bool,
    /// The sum of its rewards.
    pub episode_return: f64,
    /// The policy that it was collected with.
    pub policy_version: u64,
    /// Environment steps of the run when it ended.
    pub env_steps: u64,
}

impl From<EpisodeReport> for RemoteEpisode {
    fn from(report: EpisodeReport) -> Self {
        Self {
            actor: report.actor,
            environment: report.environment,
            steps: report.steps,
            terminated: report.terminated != 0,
            episode_return: report.episode_return,
            policy_version: report.policy_version,
            env_steps: report.env_steps,
        }
    }
}

impl From<RemoteEpisode> for EpisodeReport {
    fn from(episode: RemoteEpisode) -> Self {
        Self {
            actor: episode.actor,
            environment: episode.environment,
            steps: episode.steps,
            terminated: episode.terminated.into(),
            episode_return: episode.episode_return,
            policy_version: episode.policy_version,
            env_steps: episode.env_steps,
        }
    }
}

/// A message that bincode encodes.
pub trait Message: Serialize + DeserializeOwned {
    #[doc(hidden)]
    const KIND: MessageKind;

    /// Its bytes.
    ///
    /// # Errors
    /// When it cannot be encoded.
    fn encode(&self) -> Result<Vec<u8>, WireError> {
        let body = bincode::serde::encode_to_vec(self, encoding());
        let body = body.map_err(|error| WireError::Contents(error.to_string()))?;
        Ok(sealed(Self::KIND, &[&body]))
    }

    /// Reads a message.
    ///
    /// # Errors
    /// When the bytes are not a whole message of this kind and version.
    fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let body = opened(Self::KIND, bytes)?;
        match bincode::serde::decode_from_slice(body, encoding()) {
            Ok((message, used)) if used == body.len() => Ok(message),
            Ok(_) => Err(WireError::Length(bytes.len())),
            Err(error) => Err(WireError::Contents(error.to_string())),
        }
    }
}

impl Message for PolicyRequest {
    const KIND: MessageKind = MessageKind::PolicyRequest;
}

impl Message for Hello {
    const KIND: MessageKind = MessageKind::Hello;
}

impl Message for Admission {
    const KIND: MessageKind = MessageKind::Admission;
}

impl Message for Acknowledgement {
    const KIND: MessageKind = MessageKind::Acknowledgement;
}

impl Message for HostReport {
    const KIND: MessageKind = MessageKind::HostReport;
}

/// The most bytes that a message decodes to. The limit keeps a damaged length from allocating memory without bound.
const MAX_MESSAGE_BYTES: usize = 4 << 20;

/// The most words that the snapshots of a host's actors may have together: one acknowledgement carries them all. An
/// encoded word has at most 9 bytes; the rest of the message needs some room too.
pub const MAX_SNAPSHOT_WORDS: usize = MAX_MESSAGE_BYTES / 10;

fn encoding() -> impl bincode::config::Config {
    bincode::config::standard().with_limit::<MAX_MESSAGE_BYTES>()
}

fn sealed(kind: MessageKind, parts: &[&[u8]]) -> Vec<u8> {
    let length = START + parts.iter().map(|part| part.len()).sum::<usize>() + CHECKSUM;
    let mut bytes = Vec::with_capacity(length);
    bytes.extend((LETTERS | kind as u32).to_le_bytes());
    bytes.extend(VERSION.to_le_bytes());
    parts.iter().for_each(|part| bytes.extend_from_slice(part));
    let checksum = crc32fast::hash(&bytes);
    bytes.extend_from_slice(&checksum.to_le_bytes());
    bytes
}

/// The bytes between the first words and the checksum.
fn opened(kind: MessageKind, bytes: &[u8]) -> Result<&[u8], WireError> {
    let length = Err(WireError::Length(bytes.len()));
    if bytes.len() > LONGEST {
        return length;
    }
    let word = |at: usize| Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?));
    let (Some(found), Some(version)) = (word(0), word(size_of::<u32>())) else {
        return length;
    };
    if found != LETTERS | kind as u32 {
        return Err(WireError::MessageKind);
    }
    if version != VERSION {
        return Err(WireError::Version(version));
    }
    let Some((sealed, checksum)) = bytes.split_last_chunk::<CHECKSUM>() else {
        return length;
    };
    if sealed.len() < START {
        return length;
    }
    if crc32fast::hash(sealed) != u32::from_le_bytes(*checksum) {
        return Err(WireError::Checksum);
    }
    Ok(&sealed[START..])
}

/// The words of a header and the numbers after it.
fn split<const N: usize>(body: &[u8], length: usize) -> Result<([u64; N], Vec<f32>), WireError> {
    let wrong = WireError::Length(length);
    let (header, numbers) = body.split_at_checked(N * size_of::<u64>()).ok_or(wrong.clone())?;
    let (words, _) = header.as_chunks::<{ size_of::<u64>() }>();
    let (numbers, rest) = numbers.as_chunks::<{ size_of::<f32>() }>();
    if !rest.is_empty() {
        return Err(wrong);
    }
    let words = std::array::from_fn(|i| u64::from_le_bytes(words[i]));
    Ok((
        words,
        numbers.iter().map(|number| f32::from_le_bytes(*number)).collect(),
    ))
}

/// The bytes of a header's words.
fn words(header: &[u64]) -> Vec<u8> {
    header.iter().flat_map(|word| word.to_le_bytes()).collect()
}
