//! Asking a run to be admitted.

use std::time::{Duration, Instant};

use zenoh::{Session, Wait};

use crate::endpoint::Endpoint;
use crate::files::KeyFile;
use crate::network::{self, NetworkError, failed};
use crate::wire::{Admission, Hello, Message, WireError};

/// How long the gate may take to answer.
const ANSWER: Duration = Duration::from_secs(10);

/// The pause before the next question to a gate that is not there.
const PAUSE: Duration = Duration::from_millis(200);

/// Why a run was not joined.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// The network failed.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The gate's answer cannot be read.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// There was no answer.
    #[error(
        "nobody answers at {endpoint}: is the run running there, with --listen{}?",
        also(endpoint)
    )]
    Silence {
        /// Where the question was sent.
        endpoint: String,
    },
}

/// What else may be wrong where there are keys.
fn also(endpoint: &str) -> &'static str {
    if endpoint.starts_with("tls") {
        ", and is this its key"
    } else {
        ""
    }
}

/// Asks the gate at this endpoint, whichever run it belongs to, until it answers, `patience` is over, or `stop` returns
/// true.
///
/// # Errors
/// When there is no answer, or it cannot be read.
pub fn join(
    endpoint: &Endpoint,
    key: Option<&KeyFile>,
    hello: &Hello,
    patience: Duration,
    stop: impl Fn() -> bool,
) -> Result<Admission, JoinError> {
    let session = network::connect(endpoint, key)?;
    let begun = Instant::now();
    loop {
        // Without a key nobody knows which run it is, and only one can be there.
        match ask_to_join(&session, key.map_or("*", |key| &key.run_id), hello) {
            Err(JoinError::Silence { .. }) if begun.elapsed() < patience && !stop() => std::thread::sleep(PAUSE),
            Err(JoinError::Silence { .. }) => {
                let endpoint = endpoint.to_string();
                return Err(JoinError::Silence { endpoint });
            }
            answer => {
                session.close().wait().map_err(failed("close"))?;
                return answer;
            }
        }
    }
}

/// Asks the gate of this run once.
pub(crate) fn ask_to_join(session: &Session, run_id: &str, hello: &Hello) -> Result<Admission, JoinError> {
    let replies = session
        .get(network::join(run_id))
        .payload(hello.encode()?)
        .timeout(ANSWER)
        .wait()
        .map_err(failed("ask to be admitted"))?;
    let reply = replies.recv().ok();
    match reply.as_ref().and_then(|reply| reply.result().ok()) {
        Some(sample) => Ok(Admission::decode(&sample.payload().to_bytes())?),
        None => Err(JoinError::Silence {
            endpoint: run_id.into(),
        }),
    }
}
