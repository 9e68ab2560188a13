//! Asking a run to be admitted.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use zenoh::{Session, Wait};

use crate::endpoint::Endpoint;
use crate::files::KeyFile;
use crate::network::{self, NetworkError, failed};
use crate::relay::REJOIN_INTERVAL;
use crate::wire::{Acknowledgement, Admission, Hello, HostReport, Message, ReportNumber, RunPhase, WireError};

/// How long the gate may take to answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// The pause before the next question to a gate that is not there.
const RETRY_INTERVAL: Duration = Duration::from_millis(200);

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
        "nobody answers at {endpoint}: is the run running there, with --listen{}? If so, its log may tell why",
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

/// The pause between two reports of a host that is preparing its work.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// A connection with the gate that has admitted this host.
#[derive(Debug)]
pub struct GateConnection(Session);

/// Why a [`LeaseKeeper`] ends.
#[derive(Clone, Copy, Debug)]
enum KeeperEnd {
    /// The relay sends the reports from here on.
    RelayReports,
    HostLeaves,
}

/// Sends reports for a host that is admitted and whose relay does not run yet, so that its actors stay its own. If it
/// is dropped, the host leaves and its actors are free.
#[derive(Debug)]
pub struct LeaseKeeper {
    /// `None` if nobody waits for its end.
    thread: Option<JoinHandle<()>>,
    run_is_over: Arc<AtomicBool>,
    /// Ends the thread.
    end: Sender<KeeperEnd>,
}

impl LeaseKeeper {
    /// For this host of the run `run_id`.
    ///
    /// # Errors
    /// When there can be no thread.
    pub fn start(connection: GateConnection, run_id: String, host: u64) -> Result<Self, std::io::Error> {
        let (end, ended) = channel();
        let run_is_over = Arc::new(AtomicBool::new(false));
        let is_over = Arc::clone(&run_is_over);
        let keep = move || report_until(&connection.0, &run_id, host, &is_over, &ended);
        let thread = std::thread::Builder::new().name("lease".into()).spawn(keep)?;
        let thread = Some(thread);
        Ok(Self {
            thread,
            run_is_over,
            end,
        })
    }

    /// Says whether the run has ended since the host was admitted.
    pub fn run_is_over(&self) -> Box<dyn Fn() -> bool> {
        let run_is_over = Arc::clone(&self.run_is_over);
        Box::new(move || run_is_over.load(Ordering::Relaxed))
    }

    /// Ends the reports, because the relay sends them from now on. The connection may take a while to close.
    pub fn end(mut self) {
        let _ = self.end.send(KeeperEnd::RelayReports);
        self.thread = None;
    }
}

impl Drop for LeaseKeeper {
    fn drop(&mut self) {
        // After `end` nobody reads it.
        let _ = self.end.send(KeeperEnd::HostLeaves);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Sends reports until `end`, or until the gate says that the run is over, and then closes the connection.
fn report_until(
    connection: &Session,
    run_id: &str,
    host: u64,
    run_is_over: &Arc<AtomicBool>,
    end: &Receiver<KeeperEnd>,
) {
    let key = network::reports(run_id, &host.to_string());
    let has_heard = Arc::clone(run_is_over);
    let hear = move |acknowledgement: &[u8]| {
        if Acknowledgement::decode(acknowledgement).is_ok_and(|news| news.phase == RunPhase::Over) {
            has_heard.store(true, Ordering::Relaxed);
        }
    };
    // If this fails, the host learns of the run's end only from its relay.
    let _subscriber = connection
        .declare_subscriber(network::acknowledgements(run_id, host))
        .callback(move |sample| hear(&sample.payload().to_bytes()))
        .wait();
    let send = |number, leaving| {
        let report = HostReport::without_processes(
            host,
            ReportNumber {
                relay: 0,
                report: number,
            },
            leaving,
        );
        if let Ok(bytes) = report.encode() {
            // If it is lost, the next one may arrive; without any, the host loses its actors after a while.
            let _ = connection.put(&key, bytes).wait();
        }
    };
    // The numbers of the relay's reports are greater.
    for number in 1.. {
        send(number, false);
        match end.recv_timeout(REPORT_INTERVAL) {
            // So that the gate need not wait for this host.
            Err(RecvTimeoutError::Timeout) if run_is_over.load(Ordering::Relaxed) => {
                send(number + 1, true);
                break;
            }
            Err(RecvTimeoutError::Timeout) => {}
            Ok(KeeperEnd::RelayReports) | Err(RecvTimeoutError::Disconnected) => break,
            Ok(KeeperEnd::HostLeaves) => {
                send(number + 1, true);
                break;
            }
        }
    }
    let _ = connection.close().wait();
}

/// Asks the gate at this endpoint to admit this host. Asks again until there is an answer, `timeout` is over or `stop`
/// returns true; also after a refusal, if `ask_again` returns true for its reason. With a key, only the gate of the
/// key's run is asked. The connection is for a [`LeaseKeeper`].
///
/// # Errors
/// When there is no answer, or it cannot be read.
pub fn join(
    endpoint: &Endpoint,
    key: Option<&KeyFile>,
    hello: &Hello,
    timeout: Duration,
    stop: impl Fn() -> bool,
    ask_again: impl Fn(&str) -> bool,
) -> Result<(Admission, GateConnection), JoinError> {
    let session = network::connect(endpoint, key)?;
    let begun = Instant::now();
    let may_wait = || begun.elapsed() < timeout && !stop();
    loop {
        // Without a key the run's id is not known. Only one run can listen at an endpoint.
        match ask_to_join(&session, key.map_or("*", |key| &key.run_id), hello) {
            Err(JoinError::Silence { .. }) if may_wait() => std::thread::sleep(RETRY_INTERVAL),
            Err(JoinError::Silence { .. }) => {
                let endpoint = endpoint.to_string();
                return Err(JoinError::Silence { endpoint });
            }
            Err(error) => {
                session.close().wait().map_err(failed("close"))?;
                return Err(error);
            }
            Ok(Admission::Refused(why)) if may_wait() && ask_again(&why) => std::thread::sleep(REJOIN_INTERVAL),
            Ok(admission) => return Ok((admission, GateConnection(session))),
        }
    }
}

/// Asks the gate of this run once.
pub(crate) fn ask_to_join(session: &Session, run_id: &str, hello: &Hello) -> Result<Admission, JoinError> {
    let replies = session
        .get(network::join(run_id))
        .payload(hello.encode()?)
        .timeout(ANSWER_TIMEOUT)
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
