//! Control of a run from another terminal: requests to its launcher, and the launcher's answers.

use std::os::fd::{AsFd, BorrowedFd};
use std::path::Path;
use std::time::{Duration, Instant};

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::port::client::Client;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::*;
use iceoryx2::service::header::request_response::{
    RequestHeader as IoxRequestHeader, ResponseHeader as IoxResponseHeader,
};
use iceoryx2::service::port_factory::request_response::PortFactory;

use self::message::{AddressedRequest, VERSION, decode, encode};
pub use self::message::{
    ControlRequest, ControlResponse, HostLease, HostRequest, HostState, HostStatus, JoinAgain, RoleState, RoleStatus,
    RunDirId, RunStatus, ScaleRequest,
};
use super::domain::{Domain, DomainError};
use super::error::{Cause, ChannelError, ChannelErrorKind};
use super::event::{Listener, Notifier};
use super::memory;
use super::service::{HeldService, OpenMode, make_port, service_name};

mod message;

const CHANNEL: &str = "control";

/// Clients that may ask at the same time.
const CLIENTS: usize = 8;

/// Processes that may have the service open. Killed clients count until the launcher has cleaned up after them.
const NODES: usize = 2 * CLIENTS;

const ACTIVE_REQUESTS: usize = 2;

/// Most bytes of a request from a terminal.
const REQUEST_BYTES: usize = 64;

/// Most bytes of an answer without its roles.
const RESPONSE_BYTES: usize = 1024;

/// Most bytes of one role in an answer.
const RESPONSE_BYTES_PER_ROLE: usize = 96;

/// Most bytes of another host in an answer, without its roles. Each has at least one actor.
const RESPONSE_BYTES_PER_HOST: usize = 192;

/// How long the client sleeps between checks for an answer. It notifies the launcher, which answers at once if it is
/// idle.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// How long a status request waits for the service of a launcher that is starting or ending.
const MISSING_TIMEOUT: Duration = Duration::from_secs(1);

/// How often the client checks that the launcher is still alive.
const LIVENESS_INTERVAL: Duration = Duration::from_millis(100);

/// The launcher's end.
#[derive(Debug)]
pub struct ControlPort {
    server: Server<ipc::Service, [u8], ControlHeader, [u8], ControlHeader>,
    listener: Listener,
    /// Requests that will be answered later.
    waiting: Vec<UnansweredRequest>,
}

type UnansweredRequest = ActiveRequest<ipc::Service, [u8], ControlHeader, [u8], ControlHeader>;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
struct ControlHeader {
    version: u32,
    reserved: u32,
}

/// Why the launcher gave no answer.
#[derive(Debug, thiserror::Error)]
pub enum ControlError {
    /// The channel does not work.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The run's lock cannot be taken, so no ports can be made.
    #[error(transparent)]
    Domain(DomainError),
    /// The launcher lives and has no service for requests: it is starting, or the roles have ended already.
    #[error("the run is starting, or ending; try again")]
    Missing,
    /// The launcher has ended.
    #[error("the launcher has ended")]
    Gone,
    /// The shared memory in which the launcher was asked has been removed: the run has ended, or got new shared memory.
    #[error("the run got new shared memory before the launcher could answer; try again")]
    Removed,
    /// The launcher does not answer.
    #[error("the launcher does not answer; is it stopped?")]
    Silence,
    /// The answer cannot be read.
    #[error("the launcher's answer cannot be read: {0}; is it another version of this program?")]
    Unreadable(String),
}

/// The descriptor becomes readable when a request arrives.
impl AsFd for ControlPort {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.listener.as_fd()
    }
}

impl ControlPort {
    /// Opens the launcher's end, for a run of up to `max_actors` actors on all hosts.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub fn open(domain: &Domain, max_actors: u32) -> Result<Self, ChannelError> {
        let server = make_port(|| {
            service(domain, OpenMode::Open)?
                .server_builder()
                .initial_max_slice_len(response_length(max_actors as usize))
                .create()
                .map_err(|cause| ChannelError::new(CHANNEL, "answer", cause))
        })?;
        Ok(Self {
            server,
            listener: Listener::of_launcher(domain)?,
            waiting: Vec::new(),
        })
    }

    /// Answers all requests about `run`, which is in `directory`, that have arrived since the last call. If `answer`
    /// returns `None`, the client waits for [`answer_waiting`](Self::answer_waiting).
    ///
    /// # Errors
    /// When the channel does not work, or `answer` fails.
    pub fn answer_requests<E: From<ChannelError>>(
        &mut self,
        run: RunDirId,
        directory: &Path,
        mut answer: impl FnMut(ControlRequest) -> Result<Option<ControlResponse>, E>,
    ) -> Result<(), E> {
        // Clear the notifications before reading the requests: a later request notifies again.
        self.listener.notified()?;
        loop {
            let received = self
                .server
                .receive()
                .map_err(|cause| ChannelError::new(CHANNEL, "receive a request", cause))?;
            let Some(request) = received else { return Ok(()) };
            let answer = match decode(request.user_header().version, request.payload()) {
                Ok(AddressedRequest { run: addressed, .. }) if addressed != run => {
                    Some(ControlResponse::AnotherRun(directory.display().to_string()))
                }
                Ok(AddressedRequest { request, .. }) => answer(request)?,
                Err(reason) => Some(ControlResponse::Refused(format!(
                    "the request cannot be read: {reason}"
                ))),
            };
            match answer {
                Some(answer) => send(&request, &answer),
                None => self.waiting.push(request),
            }
        }
    }

    /// Answers the waiting clients and gives them a moment to receive the answer. For use before the launcher ends.
    pub fn answer_waiting(&mut self, answer: &ControlResponse) {
        if self.waiting.is_empty() {
            return;
        }
        self.waiting.drain(..).for_each(|request| send(&request, answer));
        std::thread::sleep(10 * POLL_INTERVAL);
    }
}

/// Sends an answer. Failures are only logged: the launcher must not fail because a client has gone or memory is
/// exhausted.
fn send(request: &UnansweredRequest, answer: &ControlResponse) {
    let bytes = match encode(answer) {
        Ok(bytes) => bytes,
        Err(cause) => {
            return tracing::warn!("a request was not answered, because the answer cannot be encoded: {cause}");
        }
    };
    let sent = request.loan_slice(bytes.len()).map(|mut response| {
        response.payload_mut().copy_from_slice(&bytes);
        response.user_header_mut().version = VERSION;
        response.send()
    });
    if !matches!(sent, Ok(Ok(()))) {
        tracing::debug!(?sent, "a request was not answered");
    }
}

/// Asks the launcher of `run` and waits for the answer while `is_alive` returns true.
///
/// # Errors
/// When the launcher ends, there is no answer within `timeout`, or the answer cannot be read.
pub fn ask(
    domain: &Domain,
    run: RunDirId,
    request: ControlRequest,
    timeout: Duration,
    is_alive: impl Fn() -> bool,
) -> Result<ControlResponse, ControlError> {
    let asked = Instant::now();
    let deadline = asked + timeout;
    // A status request gives up sooner: it need not wait until the launcher can answer.
    let missing_until = match request {
        ControlRequest::Status => deadline.min(asked + MISSING_TIMEOUT),
        _ => deadline,
    };
    let request = encode(&AddressedRequest { run, request }).map_err(cannot_ask)?;
    let make_ports = || -> Result<_, ChannelError> {
        let client = service(domain, OpenMode::Open)?
            .client_builder()
            .initial_max_slice_len(request.len().max(REQUEST_BYTES))
            .create()
            .map_err(cannot_ask)?;
        Ok((client, Notifier::to_launcher(domain)))
    };
    // A launcher that is starting has not created the service yet, and one that is ending has removed it.
    let ports = loop {
        let made = match domain.make_ports(make_ports) {
            Ok(Some(made)) => made,
            Ok(None) if is_alive() => return Err(ControlError::Removed),
            // The run's processes take this lock when they join and leave, for seconds where the disk is busy.
            Err(DomainError::Locked(_)) if is_alive() && Instant::now() < deadline => continue,
            Err(error) if is_alive() => return Err(ControlError::Domain(error)),
            Ok(None) | Err(_) => return Err(ControlError::Gone),
        };
        match made {
            Ok(ports) => break ports,
            Err(_) if !is_alive() => return Err(ControlError::Gone),
            Err(error) if error.kind == ChannelErrorKind::Missing && Instant::now() >= missing_until => {
                return Err(ControlError::Missing);
            }
            Err(error) if is_permanent(&error) || Instant::now() >= deadline => return Err(error.into()),
            Err(_) => std::thread::sleep(POLL_INTERVAL),
        }
    };
    let (client, launcher) = &ports;
    let answer = await_answer(domain, client, launcher.as_ref(), &request, timeout, is_alive);
    domain.drop_ports(ports);
    answer
}

/// Sends a request and waits for its answer.
fn await_answer(
    domain: &Domain,
    client: &ControlClient,
    launcher: Option<&Notifier>,
    request: &[u8],
    timeout: Duration,
    is_alive: impl Fn() -> bool,
) -> Result<ControlResponse, ControlError> {
    let ask = |bytes: &[u8]| {
        let mut request = client.loan_slice(bytes.len()).map_err(cannot_ask)?;
        request.payload_mut().copy_from_slice(bytes);
        request.user_header_mut().version = VERSION;
        request.send().map_err(cannot_ask)
    };
    let notify = || launcher.into_iter().for_each(Notifier::notify);
    let mut pending = ask(request)?;
    notify();
    // Making the client writes files, which takes seconds where the disk is busy. That time does not count as silence of
    // the launcher.
    let deadline = Instant::now() + timeout;
    let mut checked = Instant::now();
    let (mut gone, mut removed) = (false, false);
    loop {
        let received = pending.receive().map_err(cannot_ask)?;
        if let Some(response) = received {
            return decode(response.user_header().version, response.payload()).map_err(ControlError::Unreadable);
        }
        if gone {
            return Err(ControlError::Gone);
        }
        if removed {
            return Err(ControlError::Removed);
        }
        if Instant::now() >= deadline {
            return Err(ControlError::Silence);
        }
        std::thread::sleep(POLL_INTERVAL);
        if checked.elapsed() >= LIVENESS_INTERVAL {
            checked = Instant::now();
            gone = !is_alive();
            removed = !domain.is_current();
        }
        // Ask again: the launcher had not opened its end when the request was sent.
        if pending.number_of_server_connections() == 0 {
            pending = ask(request)?;
            notify();
        }
    }
}

fn cannot_ask(cause: impl Cause) -> ChannelError {
    ChannelError::new(CHANNEL, "ask", cause)
}

/// Whether waiting cannot help. All other errors may end when the launcher creates its services.
fn is_permanent(error: &ChannelError) -> bool {
    matches!(
        error.kind,
        ChannelErrorKind::Permission | ChannelErrorKind::Incompatible
    )
}

/// Bytes of shared memory that the service reserves in a run of up to `max_actors` actors.
pub fn reserved(max_actors: usize) -> u64 {
    // The same formula as for an environment server, with iceoryx2's default numbers of loans.
    let requests = 2 * ACTIVE_REQUESTS + 2;
    let answers = 2 * ACTIVE_REQUESTS * 4;
    memory::service(NODES)
        + CLIENTS as u64 * memory::segment::<IoxRequestHeader, ControlHeader>(requests, REQUEST_BYTES)
        + memory::segment::<IoxResponseHeader, ControlHeader>(CLIENTS * answers, response_length(max_actors))
        + CLIENTS as u64 * memory::connection(1, ACTIVE_REQUESTS, requests, requests)
        + CLIENTS as u64 * memory::connection(2 * ACTIVE_REQUESTS, 1, 1, CLIENTS * answers)
}

/// Most bytes of an answer. Its roles are the learner, the evaluator with its server, the gate, and each actor with its
/// server.
fn response_length(max_actors: usize) -> usize {
    // Each actor has a server, and may be the only one of its host.
    RESPONSE_BYTES + RESPONSE_BYTES_PER_ROLE * (2 * max_actors + 4) + RESPONSE_BYTES_PER_HOST * max_actors
}

/// Creates the service.
pub(super) fn create(domain: &Domain) -> Result<HeldService, ChannelError> {
    service(domain, OpenMode::Create).map(HeldService::of_request_response)
}

type ControlClient = Client<ipc::Service, [u8], ControlHeader, [u8], ControlHeader>;

type ControlService = PortFactory<ipc::Service, [u8], ControlHeader, [u8], ControlHeader>;

fn service(domain: &Domain, mode: OpenMode) -> Result<ControlService, ChannelError> {
    let builder = domain
        .node()
        .service_builder(&service_name(domain, CHANNEL)?)
        .request_response::<[u8], [u8]>()
        .request_user_header::<ControlHeader>()
        .response_user_header::<ControlHeader>()
        .max_servers(1)
        .max_clients(CLIENTS)
        .max_nodes(NODES)
        .max_active_requests_per_client(ACTIVE_REQUESTS)
        .max_response_buffer_size(1)
        .max_borrowed_responses_per_pending_response(1);
    mode.service(CHANNEL, builder, |b| b.create(), |b| b.open())
}

#[cfg(test)]
mod tests {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};

    use super::*;
    use crate::Services;

    #[test]
    fn a_request_wakes_the_launcher() {
        let run_id = format!("a{:x}", std::process::id());
        let domain = Domain::join(&run_id, 1).unwrap();
        let mut services = Services::new(&domain).unwrap();
        services.create_common(&domain).unwrap();
        let mut port = ControlPort::open(&domain, 1).unwrap();
        let run = RunDirId { device: 1, inode: 2 };
        let a_minute = Timespec { tv_sec: 60, tv_nsec: 0 };
        std::thread::scope(|scope| {
            let asker = scope.spawn(|| {
                let client = Domain::join_as_client(&run_id, 1).unwrap();
                let answer = ask(&client, run, ControlRequest::Stop, Duration::from_secs(60), || true);
                client.leave().unwrap();
                answer
            });
            let mut asked = 0;
            while asked == 0 {
                let woken = poll(&mut [PollFd::new(&port, PollFlags::IN)], Some(&a_minute)).unwrap();
                assert_eq!(woken, 1, "there was no notification");
                port.answer_requests::<ChannelError>(run, Path::new("run"), |request| {
                    assert_eq!(request, ControlRequest::Stop);
                    asked += 1;
                    Ok(Some(ControlResponse::Accepted))
                })
                .unwrap();
            }
            assert_eq!(asker.join().unwrap().unwrap(), ControlResponse::Accepted);
            let at_once = Timespec::default();
            assert_eq!(
                poll(&mut [PollFd::new(&port, PollFlags::IN)], Some(&at_once)).unwrap(),
                0
            );
        });
        drop((port, services));
        domain.leave().unwrap();
    }

    #[test]
    fn a_busy_lock_is_not_taken_for_new_shared_memory() {
        let run_id = format!("l{:x}", std::process::id());
        let domain = Domain::join(&run_id, 1).unwrap();
        let client = Domain::join_as_client(&run_id, 1).unwrap();
        let held = std::fs::File::open(domain.directory().unwrap()).unwrap();
        held.lock().unwrap();
        let run = RunDirId { device: 1, inode: 2 };
        let answer = ask(&client, run, ControlRequest::Stop, Duration::ZERO, || true);
        drop(held);
        assert!(
            matches!(answer, Err(ControlError::Domain(DomainError::Locked(_)))),
            "{answer:?}"
        );
        client.leave().unwrap();
        domain.leave().unwrap();
    }

    #[test]
    fn a_client_that_outlives_a_run_leaves_the_next_one_of_that_name_alone() {
        let run_id = format!("b{:x}", std::process::id());
        let begin = || {
            let domain = Domain::join(&run_id, 1).unwrap();
            let mut services = Services::new(&domain).unwrap();
            services.create_common(&domain).unwrap();
            (domain, services)
        };
        let end = |(domain, services): (Domain, Services)| {
            drop(services);
            domain.leave().unwrap();
        };
        let minute = Duration::from_secs(60);
        let run = RunDirId { device: 1, inode: 2 };
        let first = begin();
        let client = Domain::join_as_client(&run_id, 1).unwrap();
        let second = std::thread::scope(|scope| {
            let (asked, has_asked) = std::sync::mpsc::channel();
            let (begun, has_begun) = std::sync::mpsc::channel::<()>();
            let client = &client;
            let asker = scope.spawn(move || {
                // It is called first when the request has been sent. Nobody answers.
                let is_alive = || {
                    let _ = asked.send(());
                    let _ = has_begun.recv_timeout(minute);
                    true
                };
                ask(client, run, ControlRequest::Stop, minute, is_alive)
            });
            has_asked.recv_timeout(minute).unwrap();
            end(first);
            let second = begin();
            drop(begun);
            let answer = asker.join().unwrap();
            assert!(matches!(answer, Err(ControlError::Removed)), "{answer:?}");
            second
        });
        // A client that has not asked yet.
        let answer = ask(&client, run, ControlRequest::Stop, minute, || true);
        assert!(matches!(answer, Err(ControlError::Removed)), "{answer:?}");
        assert!(second.0.is_intact(second.1.count()));
        assert_eq!(second.1.ports(), 0);
        end(second);
        client.leave().unwrap();
    }
}
