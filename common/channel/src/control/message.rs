//! What travels between a terminal and a run's launcher.

use bincode::config::{self, Config};
use bincode::error::EncodeError;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// The form of the messages. Raise it with every change: launcher and asker may be of different builds.
pub(super) const VERSION: u32 = 3;

/// What can be asked of a launcher.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Question {
    /// How the run gets on.
    Status,
    /// Go on with so many actors.
    Scale {
        /// How many.
        actors: u32,
    },
    /// End the run in order.
    Stop,
}

/// A question, and the run it is about. A copy of a run directory has the run's name, and so reaches the original's
/// launcher.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Asked {
    pub(super) run: RunKey,
    pub(super) question: Question,
}

/// What tells a run directory from its copies: the device and the number of its inode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunKey {
    /// The device.
    pub device: u64,
    /// The inode.
    pub inode: u64,
}

/// What a launcher answers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Answer {
    /// How the run gets on.
    Status(RunStatus),
    /// It is being done.
    Accepted,
    /// It cannot be done, and why.
    Refused(String),
    /// The launcher runs another directory, of which the one that was asked about is a copy.
    AnotherRun(String),
}

/// How a run gets on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunStatus {
    /// Every process of the run.
    pub roles: Vec<RoleStatus>,
    /// Environment steps learned from.
    pub env_steps: u64,
    /// Environment steps after which training ends.
    pub steps: u64,
    /// Episodes that end within the steps learned from.
    pub episodes: u64,
    /// Episodes after which training ends, if that is earlier.
    pub episodes_limit: Option<u64>,
    /// Updates done.
    pub updates: u64,
    /// Rows committed to the replay over the whole run.
    pub replay_rows: u64,
    /// Actors the run is to have.
    pub actors: u32,
    /// Updates for each step beyond the warm-up, so far.
    pub ratio: f64,
    /// The ratio agreed on.
    pub updates_per_step: f64,
    /// Version of the policy published last.
    pub policy_version: u64,
    /// Updates a second.
    pub updates_per_second: f64,
    /// Environment steps a second.
    pub env_steps_per_second: f64,
    /// Mean return of the last evaluation.
    pub eval_return_mean: Option<f64>,
    /// Who waits for whom; `None` where nobody waits.
    pub waiting: Option<String>,
    /// Whether nothing is left to be done: no step, no update, no evaluation.
    pub finished: bool,
}

/// How a process of a run gets on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RoleStatus {
    /// What it is for.
    pub role: String,
    /// Which one of that role.
    pub index: u32,
    /// Its process, if there is one.
    pub pid: Option<u32>,
    /// What it does.
    pub state: RoleState,
    /// How often it was started again.
    pub restarts: u32,
    /// Environment steps a second, or updates of a learner.
    pub rate: f64,
    /// Version of the policy it uses or publishes; `None` for an environment server.
    pub policy_version: Option<u64>,
    /// Versions that its policy is behind the learner's.
    pub policy_lag: Option<u64>,
}

/// What a process of a run does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RoleState {
    /// Started, and not ready yet.
    Starting,
    /// At work.
    Working,
    /// Waiting for another role to appear or to answer.
    WaitingForPeer,
    /// Waiting for the other side of the ratio.
    WaitingForRatio,
    /// Has not been heard of for seconds: stopped, or stuck.
    Silent,
    /// Handing over what it has, to end for good.
    Retiring,
    /// Asked to end with the whole run.
    Ending,
    /// Ended, and about to be started again.
    Restarting,
    /// Through with everything.
    Done,
}

/// A message as bytes.
///
/// # Errors
/// When its type cannot be serialised.
pub(super) fn encode(message: &impl Serialize) -> Result<Vec<u8>, EncodeError> {
    bincode::serde::encode_to_vec(message, encoding())
}

/// The message that the bytes are, or what is wrong with them.
pub(super) fn decode<T: DeserializeOwned>(version: u32, bytes: &[u8]) -> Result<T, String> {
    if version != VERSION {
        return Err(format!("it is of form {version}, this program's is {VERSION}"));
    }
    match bincode::serde::decode_from_slice(bytes, encoding()) {
        Ok((message, used)) if used == bytes.len() => Ok(message),
        Ok((_, used)) => Err(format!("{} bytes are left over", bytes.len() - used)),
        Err(error) => Err(error.to_string()),
    }
}

/// The limit keeps a length that no message has from asking for memory.
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
                role: "actor".into(),
                index: 3,
                pid: Some(77),
                state: RoleState::WaitingForRatio,
                restarts: 2,
                rate: 0.5,
                policy_version: Some(9),
                policy_lag: None,
            }],
            waiting: Some("actors wait".into()),
            eval_return_mean: Some(-140.0),
            ..Default::default()
        }
    }

    #[test]
    fn a_message_arrives_as_it_was_and_another_builds_is_refused() {
        let answer = Answer::Status(status());
        assert_eq!(decode(VERSION, &encode(&answer).unwrap()), Ok(answer.clone()));
        assert!(
            decode::<Answer>(VERSION + 1, &encode(&answer).unwrap())
                .unwrap_err()
                .contains("form")
        );
        assert!(decode::<Answer>(VERSION, &[]).is_err());
    }

    #[test]
    fn a_message_that_is_cut_or_too_long_is_refused() {
        let whole = encode(&Answer::Status(status())).unwrap();
        for end in 0..whole.len() {
            assert!(
                decode::<Answer>(VERSION, &whole[..end]).is_err(),
                "{end} of {} bytes",
                whole.len()
            );
        }
        for extra in 1..4 {
            let longer = [&whole[..], &[0; 3][..extra]].concat();
            assert_eq!(
                decode::<Answer>(VERSION, &longer),
                Err(format!("{extra} bytes are left over"))
            );
        }
    }

    /// What is read is a message: sent on, it arrives as the same. (As bytes: NaN is not equal to itself.)
    fn is_read_for_what_it_is<T: Serialize + DeserializeOwned>(bytes: &[u8]) -> bool {
        match decode::<T>(VERSION, bytes) {
            Ok(message) => {
                let sent_on = encode(&message).unwrap();
                let arrived: T = decode(VERSION, &sent_on).unwrap();
                encode(&arrived).unwrap() == sent_on
            }
            Err(reason) => !reason.is_empty(),
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_message_or_an_error(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(is_read_for_what_it_is::<Question>(&bytes));
            prop_assert!(is_read_for_what_it_is::<Asked>(&bytes));
            prop_assert!(is_read_for_what_it_is::<Answer>(&bytes));
        }

        #[test]
        fn a_changed_message_is_an_error_or_another_message(at in any::<prop::sample::Index>(), by in 1_u8..) {
            let sent = encode(&Answer::Status(status())).unwrap();
            let mut changed = sent.clone();
            changed[at.index(sent.len())] ^= by;
            if let Ok(message) = decode::<Answer>(VERSION, &changed) {
                prop_assert_ne!(encode(&message).unwrap(), sent);
            }
        }
    }
}
