//! Control of a run, from any other terminal: questions to its launcher, and the launcher's answers.

use std::os::fd::{AsFd, BorrowedFd};
use std::path::Path;
use std::time::{Duration, Instant};

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::*;
use iceoryx2::service::header::request_response::{
    RequestHeader as IoxRequestHeader, ResponseHeader as IoxResponseHeader,
};
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::request_response::PortFactory;

pub use self::message::{Answer, Question, RoleState, RoleStatus, RunKey, RunStatus};
use self::message::{Asked, VERSION, decode, encode};
use super::domain::Domain;
use super::error::{Cause, ChannelError, ChannelErrorKind};
use super::event::{Listener, Notifier};
use super::memory;
use super::service::{Entry, Held, claim, service_name};

mod message;

const CHANNEL: &str = "control";

/// Terminals that may ask at the same time.
const CLIENTS: usize = 8;

/// Processes that may take part: askers that were killed count until the launcher has cleaned up after them.
const NODES: usize = 2 * CLIENTS;

const ACTIVE_REQUESTS: usize = 2;

/// Bytes of the longest question, and of the longest answer to each role of the run and beside them.
const QUESTION: usize = 64;
const ANSWER: usize = 1024;
const ANSWER_OF_A_ROLE: usize = 96;

/// How long the asker sleeps between looks. It rings for the launcher, which answers at once where it has nothing else to do.
const NAP: Duration = Duration::from_millis(5);

/// How often it asks itself whether there is still a launcher.
const LOOK: Duration = Duration::from_millis(100);

/// The launcher's end.
#[derive(Debug)]
pub struct ControlPort {
    server: Server<ipc::Service, [u8], ControlHeader, [u8], ControlHeader>,
    listener: Listener,
    /// Who will be answered later.
    waiting: Vec<ControlRequest>,
}

type ControlRequest = ActiveRequest<ipc::Service, [u8], ControlHeader, [u8], ControlHeader>;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
struct ControlHeader {
    version: u32,
    reserved: u32,
}

/// Why a launcher's answer was not had.
#[derive(Debug, thiserror::Error)]
pub enum ControlError {
    /// The channel does not work.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// There is no launcher any more.
    #[error("the launcher has ended")]
    Gone,
    /// Nobody answers.
    #[error("the launcher does not answer; is it stopped?")]
    Silence,
    /// The answer cannot be read.
    #[error("the launcher's answer cannot be read: {0}; is it another version of this program?")]
    Unreadable(String),
}

/// Readable when somebody has asked.
impl AsFd for ControlPort {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.listener.as_fd()
    }
}

impl ControlPort {
    /// The answering end.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub fn open(domain: &Domain) -> Result<Self, ChannelError> {
        let server = claim(|| {
            service(domain, Entry::Open)?
                .server_builder()
                .initial_max_slice_len(answer_length(domain.max_actors()))
                .create()
                .map_err(|cause| ChannelError::new(CHANNEL, "answer", cause))
        })?;
        Ok(Self {
            server,
            listener: Listener::of_launcher(domain)?,
            waiting: Vec::new(),
        })
    }

    /// Answers everything that was asked about `run`, which is in the directory `place`, since the last call; whom `answer`
    /// has no answer for waits.
    ///
    /// # Errors
    /// When the channel does not work, or `answer` fails.
    pub fn attend<E: From<ChannelError>>(
        &mut self,
        run: RunKey,
        place: &Path,
        mut answer: impl FnMut(Question) -> Result<Option<Answer>, E>,
    ) -> Result<(), E> {
        // Before the questions are looked for: who asks later rings again.
        self.listener.notified()?;
        loop {
            let received = self
                .server
                .receive()
                .map_err(|cause| ChannelError::new(CHANNEL, "hear a question", cause))?;
            let Some(request) = received else { return Ok(()) };
            let answer = match decode(request.user_header().version, request.payload()) {
                Ok(Asked { run: asked, .. }) if asked != run => Some(Answer::AnotherRun(place.display().to_string())),
                Ok(Asked { question, .. }) => answer(question)?,
                Err(reason) => Some(Answer::Refused(format!("the question cannot be read: {reason}"))),
            };
            match answer {
                Some(answer) => send(&request, &answer),
                None => self.waiting.push(request),
            }
        }
    }

    /// Answers those who wait, and gives them a moment to hear it; for the end.
    pub fn dismiss(&mut self, answer: &Answer) {
        if self.waiting.is_empty() {
            return;
        }
        self.waiting.drain(..).for_each(|request| send(&request, answer));
        std::thread::sleep(10 * NAP);
    }
}

/// An asker that has gone, or has no memory left, is no reason for the launcher to fail.
fn send(request: &ControlRequest, answer: &Answer) {
    let bytes = match encode(answer) {
        Ok(bytes) => bytes,
        Err(cause) => return tracing::warn!("a question went without an answer, which cannot be written: {cause}"),
    };
    let sent = request.loan_slice(bytes.len()).map(|mut response| {
        response.payload_mut().copy_from_slice(&bytes);
        response.user_header_mut().version = VERSION;
        response.send()
    });
    if !matches!(sent, Ok(Ok(()))) {
        tracing::debug!(?sent, "a question went without an answer");
    }
}

/// Asks the launcher of `run`, for as long as `lives` says that there is one.
///
/// # Errors
/// When there is no answer within `patience`, or none that can be read.
pub fn ask(
    domain: &Domain,
    run: RunKey,
    question: Question,
    patience: Duration,
    lives: impl Fn() -> bool,
) -> Result<Answer, ControlError> {
    let deadline = Instant::now() + patience;
    let make_client = || {
        service(domain, Entry::Open)?
            .client_builder()
            .initial_max_slice_len(QUESTION)
            .create()
            .map_err(cannot_ask)
    };
    // A launcher that starts has not made the service yet, and one that ends has it no more.
    let client = loop {
        match make_client() {
            Ok(client) => break client,
            Err(_) if !lives() => return Err(ControlError::Gone),
            Err(error) if will_not_pass(&error) || Instant::now() >= deadline => return Err(error.into()),
            Err(_) => std::thread::sleep(NAP),
        }
    };
    let ask = |bytes: &[u8]| {
        let mut request = client.loan_slice(bytes.len()).map_err(cannot_ask)?;
        request.payload_mut().copy_from_slice(bytes);
        request.user_header_mut().version = VERSION;
        request.send().map_err(cannot_ask)
    };
    let question = encode(&Asked { run, question }).map_err(cannot_ask)?;
    let launcher = Notifier::to_launcher(domain);
    let ring = || launcher.iter().for_each(Notifier::notify);
    let mut pending = ask(&question)?;
    ring();
    let mut looked = Instant::now();
    let mut gone = false;
    loop {
        let received = pending.receive().map_err(cannot_ask)?;
        if let Some(response) = received {
            return decode(response.user_header().version, response.payload()).map_err(ControlError::Unreadable);
        }
        if gone {
            return Err(ControlError::Gone);
        }
        if Instant::now() >= deadline {
            return Err(ControlError::Silence);
        }
        std::thread::sleep(NAP);
        if looked.elapsed() >= LOOK {
            looked = Instant::now();
            gone = !lives();
        }
        // The launcher may have opened its end only now.
        if pending.number_of_server_connections() == 0 {
            pending = ask(&question)?;
            ring();
        }
    }
}

fn cannot_ask(cause: impl Cause) -> ChannelError {
    ChannelError::new(CHANNEL, "ask", cause)
}

/// A launcher that makes its shared memory anew changes everything but these.
fn will_not_pass(error: &ChannelError) -> bool {
    matches!(
        error.kind,
        ChannelErrorKind::Permission | ChannelErrorKind::Incompatible
    )
}

/// Bytes of shared memory that the conversation reserves in a run of up to so many actors.
pub fn reserved(max_actors: usize) -> u64 {
    // As in the conversation with an environment server, and with iceoryx2's own numbers of loans.
    let questions = 2 * ACTIVE_REQUESTS + 2;
    let answers = 2 * ACTIVE_REQUESTS * 4;
    memory::service(NODES)
        + CLIENTS as u64 * memory::segment::<IoxRequestHeader, ControlHeader>(questions, QUESTION)
        + memory::segment::<IoxResponseHeader, ControlHeader>(CLIENTS * answers, answer_length(max_actors))
        + CLIENTS as u64 * memory::connection(1, ACTIVE_REQUESTS, questions, questions)
        + CLIENTS as u64 * memory::connection(2 * ACTIVE_REQUESTS, 1, 1, CLIENTS * answers)
}

/// Learner, evaluator with its server, and for each actor a server.
fn answer_length(max_actors: usize) -> usize {
    ANSWER + ANSWER_OF_A_ROLE * (2 * max_actors + 3)
}

/// Makes the service.
pub(super) fn create(domain: &Domain) -> Result<Held, ChannelError> {
    let service = service(domain, Entry::Create)?;
    Ok(Held::new(move |see| {
        let ports = service.dynamic_config();
        ports.list_clients(|port| see(port.node_id, port.client_id.value()));
        ports.list_servers(|port| see(port.node_id, port.server_id.value()));
    }))
}

type ControlService = PortFactory<ipc::Service, [u8], ControlHeader, [u8], ControlHeader>;

fn service(domain: &Domain, entry: Entry) -> Result<ControlService, ChannelError> {
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
    entry.service(CHANNEL, builder, |b| b.create(), |b| b.open())
}

#[cfg(test)]
mod tests {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};

    use super::*;
    use crate::Services;

    #[test]
    fn who_asks_wakes_the_launcher() {
        let run_id = format!("a{:x}", std::process::id());
        let domain = Domain::join(&run_id, 1).unwrap();
        let mut services = Services::new(&domain).unwrap();
        services.create_common(&domain).unwrap();
        let mut port = ControlPort::open(&domain).unwrap();
        let run = RunKey { device: 1, inode: 2 };
        let a_minute = Timespec { tv_sec: 60, tv_nsec: 0 };
        std::thread::scope(|scope| {
            let asker = scope.spawn(|| {
                let visitor = Domain::visit(&run_id, 1).unwrap();
                let answer = ask(&visitor, run, Question::Stop, Duration::from_secs(60), || true);
                visitor.leave().unwrap();
                answer
            });
            let mut asked = 0;
            while asked == 0 {
                let woken = poll(&mut [PollFd::new(&port, PollFlags::IN)], Some(&a_minute)).unwrap();
                assert_eq!(woken, 1, "nobody notified");
                port.attend::<ChannelError>(run, Path::new("run"), |question| {
                    assert_eq!(question, Question::Stop);
                    asked += 1;
                    Ok(Some(Answer::Accepted))
                })
                .unwrap();
            }
            assert_eq!(asker.join().unwrap().unwrap(), Answer::Accepted);
            let at_once = Timespec::default();
            assert_eq!(
                poll(&mut [PollFd::new(&port, PollFlags::IN)], Some(&at_once)).unwrap(),
                0
            );
        });
        drop((port, services));
        domain.leave().unwrap();
    }
}
