//! The messages between another terminal and a run's launcher.

use bincode::config::{self, Config};
use bincode::error::EncodeError;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use shoal_base::role::{Activity, Role};

/// The format version of the messages. Increase it with every change: launcher and client may be of different builds.
pub(super) const VERSION: u32 = 7;

/// A request to a launcher.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ControlRequest {
    /// Report the status of the run.
    Status,
    /// Continue with other numbers of actors.
    Scale(ScaleRequest),
    /// End the run in an orderly way.
    Stop,
    /// From the gate: admit another host.
    Admit(HostRequest),
    /// From the gate, a few times a second: the status of the other hosts. The answer is the admitted hosts.
    Hosts(Vec<HostStatus>),
    /// From a relay: end this actor if it is of this incarnation or an earlier one, and start it again.
    Replace {
        /// The actor.
        actor: u32,
        /// Its incarnation.
        incarnation: u64,
    },
    /// From a relay: the host must join again.
    JoinAgain(JoinAgain),
}

/// The wanted numbers of actors. A host that is not named keeps its number, or gets a share of `total`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ScaleRequest {
    /// The number of the learner's host.
    pub here: Option<u32>,
    /// Names of joined hosts, each with its number.
    pub joined: Vec<(String, u32)>,
    /// The number on all hosts together.
    pub total: Option<u32>,
}

/// Why a host must join again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum JoinAgain {
    /// Its actors belong to others now.
    LostActors,
    /// The run wants it to have this many actors.
    Scaled(u32),
}

/// What another host asks for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostRequest {
    /// Identifies the host: a random number of its own choice.
    pub host: u64,
    /// Its name.
    pub name: String,
    /// The number of actors that it offers.
    pub actors: u32,
    /// The number of its processor cores.
    pub cores: u32,
    /// The actors that an earlier launcher of the run has given it.
    pub held: Vec<u32>,
}

/// What a host is given: actors, and the incarnations that its processes may have.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostLease {
    /// The host.
    pub host: u64,
    /// Its name.
    pub name: String,
    /// Grows with every start of the launcher.
    pub epoch: u64,
    /// The indices of its actors.
    pub actors: Vec<u32>,
    /// The number of actors that the run wants it to have. If `actors` has another length, the host must join again.
    pub wanted_actors: u32,
    /// The number of its processor cores.
    pub cores: u32,
    /// The first incarnation of its processes.
    pub first_incarnation: u64,
    /// Their incarnations are below this one.
    pub limit: u64,
}

impl HostLease {
    /// Incarnations that a host gets at once: more than it will ever need.
    pub const INCARNATIONS: u64 = 1 << 20;
}

/// The state of another host.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum HostState {
    /// It sends reports.
    Connected,
    /// It has sent none for seconds. It may come back with all that its actors have collected.
    CutOff,
    /// It has left the run.
    Left,
}

/// The status of another host.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HostStatus {
    /// Its number.
    pub host: u64,
    /// Its name.
    pub name: String,
    /// Its state.
    pub state: HostState,
    /// The number of its actors.
    pub actors: u32,
    /// The number of actors that it is about to have.
    pub wanted_actors: u32,
    /// Rows a second that arrive from it.
    pub rows_per_second: f64,
    /// Chunks that it had to send more than once.
    pub resent_chunks: u64,
    /// Time from a report of the host to the answer, in microseconds.
    pub round_trip_us: Option<u64>,
    /// How many versions its newest policy is behind the learner's.
    pub policy_lag: u64,
    /// Seconds since it was last heard of.
    pub silent_seconds: f64,
    /// Its actors and environment servers.
    pub roles: Vec<RoleStatus>,
}

/// A request and the run that it is about. The run is checked because a copy of a run directory has the same name in
/// shared memory: a request about the copy reaches the launcher of the original.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct AddressedRequest {
    pub(super) run: RunDirId,
    pub(super) request: ControlRequest,
}

/// Distinguishes a run directory from its copies by device and inode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunDirId {
    /// The device.
    pub device: u64,
    /// The inode.
    pub inode: u64,
}

/// The answer of a launcher.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ControlResponse {
    /// The status of the run.
    Status(RunStatus),
    /// The request is being carried out.
    Accepted,
    /// The run will have these numbers of actors.
    Scaled {
        /// On the learner's host.
        here: u32,
        /// On all hosts together.
        total: u32,
    },
    /// The request is refused, with the reason.
    Refused(String),
    /// The request is refused, because the run is ending.
    RunIsEnding,
    /// The host is admitted.
    Admitted(HostLease),
    /// The hosts that are admitted.
    Leases {
        /// Grows with every start of the launcher.
        epoch: u64,
        /// What each has.
        leases: Vec<HostLease>,
    },
    /// The launcher runs this other directory; the one that was asked about is a copy of it.
    AnotherRun(String),
    /// The request cannot be carried out for the moment, for this reason.
    NotNow(String),
}

impl RunStatus {
    /// Whether the number of actors is right and all of them have started.
    pub fn all_actors_work(&self) -> bool {
        let mut actors = self.roles.iter().filter(|role| role.role == Role::Actor);
        actors.clone().count() == self.actors as usize
            && !actors.any(|actor| {
                matches!(
                    actor.state,
                    RoleState::Starting | RoleState::Restarting | RoleState::Retiring
                )
            })
    }
}

/// The status of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunStatus {
    /// Every process of the run.
    pub roles: Vec<RoleStatus>,
    /// Environment steps that count for the ratio: all committed ones, in lockstep those of complete rounds.
    pub env_steps: u64,
    /// Environment steps after which training ends.
    pub steps: u64,
    /// Episodes that end within the steps learned from.
    pub episodes: u64,
    /// Episodes after which training ends, if that is earlier.
    pub episodes_limit: Option<u64>,
    /// Updates so far.
    pub updates: u64,
    /// Environment steps committed to the replay over the whole run.
    pub replay_rows: u64,
    /// Configured number of actors.
    pub actors: u32,
    /// Updates for each environment step beyond the warm-up, so far.
    pub ratio: f64,
    /// The configured ratio.
    pub updates_per_step: f64,
    /// Version of the policy published last.
    pub policy_version: u64,
    /// Updates a second.
    pub updates_per_second: f64,
    /// Environment steps a second.
    pub env_steps_per_second: f64,
    /// Mean return of the last evaluation.
    pub eval_return_mean: Option<f64>,
    /// Which processes wait, and what for; `None` if none waits.
    pub waiting: Option<String>,
    /// Whether all environment steps, updates and evaluations are done.
    pub finished: bool,
    /// The other hosts of the run.
    pub hosts: Vec<HostStatus>,
}

/// The status of a process of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RoleStatus {
    /// Its role, in messages by name.
    #[serde(with = "role_name")]
    pub role: Role,
    /// Its index among the processes of that role.
    pub index: u32,
    /// Its process id, if it is running.
    pub pid: Option<u32>,
    /// Its state.
    pub state: RoleState,
    /// Number of restarts.
    pub restarts: u32,
    /// Environment steps a second; for a learner, updates a second.
    pub rate: f64,
    /// Version of the policy it uses or publishes; `None` for an environment server.
    pub policy_version: Option<u64>,
    /// How many versions its policy is behind the learner's.
    pub policy_lag: Option<u64>,
}

mod role_name {
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serializer};
    use shoal_base::role::Role;

    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde requires this signature")]
    pub(super) fn serialize<S: Serializer>(role: &Role, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(role.name())
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Role, D::Error> {
        let name = String::deserialize(from)?;
        Role::from_name(&name).ok_or_else(|| D::Error::custom(format!("there is no role {name:?}")))
    }
}

/// The state of a process of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RoleState {
    /// Started but not ready yet.
    Starting,
    /// Doing its work.
    Working,
    /// Waiting for another role to appear or to answer.
    WaitingForPeer,
    /// Waiting for the other side of the ratio.
    WaitingForRatio,
    /// No heartbeat for seconds: it is stopped or stuck.
    Silent,
    /// Handing over what it has, before it ends for good.
    Retiring,
    /// Asked to end with the whole run.
    Ending,
    /// Ended, and about to be restarted.
    Restarting,
    /// Finished with all its work.
    Done,
}

impl From<Activity> for RoleState {
    fn from(activity: Activity) -> Self {
        match activity {
            Activity::Working => Self::Working,
            Activity::WaitingForPeer | Activity::WaitingForServer => Self::WaitingForPeer,
            Activity::WaitingForRatio => Self::WaitingForRatio,
            Activity::Done => Self::Done,
        }
    }
}

/// Encodes a message.
///
/// # Errors
/// When its type cannot be serialised.
pub(super) fn encode(message: &impl Serialize) -> Result<Vec<u8>, EncodeError> {
    bincode::serde::encode_to_vec(message, encoding())
}

/// Decodes a message; the error describes what is wrong with the bytes.
pub(super) fn decode<T: DeserializeOwned>(version: u32, bytes: &[u8]) -> Result<T, String> {
    if version != VERSION {
        return Err(format!("it has format {version}; this program uses format {VERSION}"));
    }
    match bincode::serde::decode_from_slice(bytes, encoding()) {
        Ok((message, used)) if used == bytes.len() => Ok(message),
        Ok((_, used)) => Err(format!("{} bytes are left over", bytes.len() - used)),
        Err(error) => Err(error.to_string()),
    }
}

/// The encoding. Its limit keeps a damaged length from allocating memory without bound.
fn encoding() -> impl Config {
    config::standard().with_limit::<{ 1 << 20 }>()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn status() -> RunStatus {
        RunStatus {
            roles: vec![RoleStatus {
                role: Role::Actor,
                index: 3,
                pid: Some(77),
                state: RoleState::WaitingForRatio,
                restarts: 2,
                rate: 0.5,
                policy_version: Some(9),
                policy_lag: None,
            }],
            waiting: Some("actors wait".into()),
            hosts: vec![HostStatus {
                host: 17,
                name: "node-2".into(),
                state: HostState::CutOff,
                actors: 4,
                wanted_actors: 4,
                rows_per_second: 1.5,
                resent_chunks: 3,
                round_trip_us: Some(250),
                policy_lag: 2,
                silent_seconds: 4.5,
                roles: Vec::new(),
            }],
            eval_return_mean: Some(-140.0),
            ..Default::default()
        }
    }

    #[test]
    fn a_message_arrives_unchanged_and_another_format_is_refused() {
        let answer = ControlResponse::Status(status());
        assert_eq!(decode(VERSION, &encode(&answer).unwrap()), Ok(answer.clone()));
        assert!(
            decode::<ControlResponse>(VERSION + 1, &encode(&answer).unwrap())
                .unwrap_err()
                .contains("format")
        );
        assert!(decode::<ControlResponse>(VERSION, &[]).is_err());
    }

    #[test]
    fn a_truncated_or_too_long_message_is_refused() {
        let whole = encode(&ControlResponse::Status(status())).unwrap();
        for end in 0..whole.len() {
            assert!(
                decode::<ControlResponse>(VERSION, &whole[..end]).is_err(),
                "{end} of {} bytes",
                whole.len()
            );
        }
        for extra in 1..4 {
            let longer = [&whole[..], &[0; 3][..extra]].concat();
            assert_eq!(
                decode::<ControlResponse>(VERSION, &longer),
                Err(format!("{extra} bytes are left over"))
            );
        }
    }

    /// Whether the bytes are refused, or decode to a message that survives encoding and decoding. Compares bytes,
    /// because NaN is not equal to itself.
    fn is_refused_or_round_trips<T: Serialize + DeserializeOwned>(bytes: &[u8]) -> bool {
        match decode::<T>(VERSION, bytes) {
            Ok(message) => {
                let encoded = encode(&message).unwrap();
                let decoded: T = decode(VERSION, &encoded).unwrap();
                encode(&decoded).unwrap() == encoded
            }
            Err(reason) => !reason.is_empty(),
        }
    }

    proptest! {
        #[test]
        fn any_bytes_decode_to_a_message_or_an_error(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(is_refused_or_round_trips::<ControlRequest>(&bytes));
            prop_assert!(is_refused_or_round_trips::<AddressedRequest>(&bytes));
            prop_assert!(is_refused_or_round_trips::<ControlResponse>(&bytes));
        }

        #[test]
        fn a_changed_message_decodes_to_an_error_or_another_message(at in any::<prop::sample::Index>(), by in 1_u8..) {
            let sent = encode(&ControlResponse::Status(status())).unwrap();
            let mut changed = sent.clone();
            changed[at.index(sent.len())] ^= by;
            if let Ok(message) = decode::<ControlResponse>(VERSION, &changed) {
                prop_assert_ne!(encode(&message).unwrap(), sent);
            }
        }
    }
}
