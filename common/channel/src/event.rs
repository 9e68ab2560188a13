//! Notifications between processes. Data channels wake no process. So each waiting process has an event service, and a
//! sender notifies that service after it has sent something.

use std::cell::Cell;
use std::fmt;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::time::{Duration, Instant};

use iceoryx2::port::listener::{Listener as IoxListener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier as IoxNotifier;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::event::PortFactory;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use shoal_base::exit::Exit;
use shoal_base::role::Role;
use shoal_base::stop::Stop;

use super::domain::{Domain, participants};
use super::error::{Cause, ChannelError};
use super::service::{HeldService, OpenMode, make_port, service_name};
use super::{descriptor, memory};

/// Polls before a waiting process blocks. A peer on another core usually answers during the polls. If both are on one
/// core, the polls delay the peer by some microseconds.
const POLLS: u32 = 200;

/// After this many waits in a row in which polling was in vain, a process blocks at once. A peer on the same core then
/// gets the core, and no core polls for a peer that always takes longer. With a smaller number, polling would stop too
/// often for a peer that is fast only now and then.
const MAX_MISSES: u32 = 64;

/// After that, one in this many waits polls again, because processes move from core to core.
const RETRY_EVERY: u32 = 32;

/// How long a process blocks before it refreshes its connections. A notification can be lost when its receiver
/// restarts.
const MAX_SLEEP: Duration = Duration::from_millis(50);

/// Names the event service of a process by its role and its index in that role (in shared memory
/// `bell/<role>/<index>`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EventName(pub Role, pub u32);

/// The event service of the launcher, which has no role.
const LAUNCHER: &str = "bell/launcher";

impl fmt::Display for EventName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "bell/{}/{}", self.0.name(), self.1)
    }
}

/// Receives the notifications of one event service.
#[derive(Debug)]
pub struct Listener {
    listener: IoxListener<ipc::Service>,
    channel: String,
    polling: Polling,
}

/// Decides whether a waiting process polls before it sleeps.
#[derive(Debug, Default)]
struct Polling {
    /// Waits in a row that had to sleep.
    misses: Cell<u32>,
}

impl Polling {
    /// Number of polls before the next sleep. It is at least one, because an earlier notification is not repeated.
    fn polls(&self) -> u32 {
        let misses = self.misses.get();
        if misses < MAX_MISSES || misses.is_multiple_of(RETRY_EVERY) {
            POLLS
        } else {
            1
        }
    }

    /// Records how a wait ended. Success at the first poll does not count either way.
    fn learn(&self, slept: bool, polls: u32) {
        if slept {
            self.misses.set(self.misses.get().wrapping_add(1));
        } else if polls > 0 {
            self.misses.set(0);
        }
    }
}

/// Notifies the event service of another process.
#[derive(Debug)]
pub struct Notifier {
    notifier: IoxNotifier<ipc::Service>,
}

impl Listener {
    /// Bytes of shared memory that an event service reserves in a run of up to `max_actors` actors.
    pub fn reserved(max_actors: usize) -> u64 {
        // The second file holds pending notifications: iceoryx2 makes a file of 2103 bytes for each listener.
        memory::service(2 * participants(max_actors)) + memory::pages(2103)
    }

    /// Opens the listener of the event service `name`.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub fn bind(domain: &Domain, name: EventName) -> Result<Self, ChannelError> {
        Self::on(domain, name.to_string())
    }

    /// Opens the listener of the launcher.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub(super) fn of_launcher(domain: &Domain) -> Result<Self, ChannelError> {
        Self::on(domain, LAUNCHER.into())
    }

    fn on(domain: &Domain, channel: String) -> Result<Self, ChannelError> {
        let listener = make_port(|| {
            service(domain, &channel, OpenMode::Open)?
                .listener_builder()
                .create()
                .map_err(|e| ChannelError::new(&channel, "listen", e))
        })?;
        Ok(Self {
            listener,
            channel,
            polling: Polling::default(),
        })
    }

    /// Blocks until there is a notification, at most `timeout`. Returns whether there was one.
    ///
    /// # Errors
    /// When the system cannot wait for the listener.
    pub fn wait(&self, timeout: Duration) -> Result<bool, ChannelError> {
        // The listener's own `timed_wait` does the same with twice as many system calls. The conversion fails only for
        // a `timeout` that is practically infinite; `None` then waits without a limit.
        let timeout = Timespec::try_from(timeout).ok();
        let mut ready = [PollFd::from_borrowed_fd(self.as_fd(), PollFlags::IN)];
        match poll(&mut ready, timeout.as_ref()) {
            // An interruption is not an error: a process that was stopped and continued also returns here.
            Ok(_) | Err(Errno::INTR) => {}
            Err(errno) => return Err(self.failed(io::Error::from(errno))),
        }
        self.notified()
    }

    /// Whether there was a notification since the last call. It does not block.
    pub(super) fn notified(&self) -> Result<bool, ChannelError> {
        let mut notified = false;
        match self.listener.try_wait(|_| notified = true) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(notified),
            Err(cause) => Err(self.failed(cause)),
        }
    }

    fn failed(&self, cause: impl Cause) -> ChannelError {
        ChannelError::new(self.channel.clone(), "wait", cause)
    }
}

impl AsFd for Listener {
    fn as_fd(&self) -> BorrowedFd<'_> {
        descriptor::of(&self.listener)
    }
}

impl Notifier {
    /// Opens a notifier for the event service `name`. The service need not have a listener yet.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub fn new(domain: &Domain, name: EventName) -> Result<Self, ChannelError> {
        let channel = name.to_string();
        make_port(|| Self::on(domain, &channel))
    }

    /// Opens a notifier for the launcher, if that is possible at once. Otherwise the launcher finds the request when it
    /// next checks for requests.
    pub(super) fn to_launcher(domain: &Domain) -> Option<Self> {
        Self::on(domain, LAUNCHER).ok()
    }

    fn on(domain: &Domain, channel: &str) -> Result<Self, ChannelError> {
        let notifier = service(domain, channel, OpenMode::Open)?
            .notifier_builder()
            .create()
            .map_err(|e| ChannelError::new(channel, "notify", e))?;
        Ok(Self { notifier })
    }

    /// Sends a notification. A failure is only logged: the receiver may be restarting, and then looks for messages
    /// anyway.
    pub fn notify(&self) {
        if let Err(cause) = self.notifier.notify() {
            tracing::debug!(?cause, "a notification was not delivered");
        }
    }
}

/// Waits until `poll` returns something. It polls for a short while, if that has helped recently, and then sleeps at
/// the listener. Some twenty times a second it calls `refresh`, which must renew the connections.
///
/// # Errors
/// [`Exit::Stopped`] once `stop` is requested, and the errors of `poll`, `refresh` and the listener.
pub fn wait_for<T>(
    listener: &Listener,
    stop: &Stop,
    mut poll: impl FnMut() -> Result<Option<T>, ChannelError>,
    mut refresh: impl FnMut() -> Result<(), ChannelError>,
) -> Result<T, Exit<ChannelError>> {
    // The time of the last refresh. The clock is not read if polling alone succeeds.
    let mut refreshed = None;
    let most = listener.polling.polls();
    loop {
        for polls in 0..most {
            if let Some(found) = poll()? {
                listener.polling.learn(refreshed.is_some(), polls);
                return Ok(found);
            }
            std::hint::spin_loop();
        }
        if stop.requested() {
            return Err(Exit::Stopped);
        }
        let since = refreshed.get_or_insert_with(Instant::now);
        listener.wait(MAX_SLEEP)?;
        // Decided by the clock, so that needless notifications cannot prevent the refresh.
        if since.elapsed() >= MAX_SLEEP {
            *since = Instant::now();
            refresh()?;
        }
    }
}

/// Creates the event service `name`.
pub(super) fn create(domain: &Domain, name: EventName) -> Result<HeldService, ChannelError> {
    create_on(domain, &name.to_string())
}

/// Creates the event service of the launcher.
pub(super) fn create_of_launcher(domain: &Domain) -> Result<HeldService, ChannelError> {
    create_on(domain, LAUNCHER)
}

fn create_on(domain: &Domain, channel: &str) -> Result<HeldService, ChannelError> {
    let service = service(domain, channel, OpenMode::Create)?;
    Ok(HeldService::new(move |visit| {
        let ports = service.dynamic_config();
        ports.list_listeners(|port| visit(port.node_id, port.listener_id.value()));
        ports.list_notifiers(|port| visit(port.node_id, port.notifier_id.value()));
    }))
}

fn service(domain: &Domain, channel: &str, mode: OpenMode) -> Result<PortFactory<ipc::Service>, ChannelError> {
    let participants = participants(domain.max_actors());
    let builder = domain
        .node()
        .service_builder(&service_name(domain, channel)?)
        .event()
        .max_listeners(2)
        .max_notifiers(participants)
        .max_nodes(participants);
    mode.service(channel, builder, |b| b.create(), |b| b.open())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polling_stops_after_many_misses_and_is_retried_now_and_then() {
        let polling = Polling::default();
        let polled_waits = |times| {
            (0..times).filter(|_| {
                let polled = polling.polls() == POLLS;
                polling.learn(true, 0);
                polled
            })
        };
        assert_eq!(polled_waits(MAX_MISSES).count(), MAX_MISSES as usize);
        assert_eq!(polled_waits(4 * RETRY_EVERY).count(), 4);
        polling.learn(true, 0);
        polling.learn(false, 0);
        assert_eq!(polling.polls(), 1, "success at the first poll does not count");
        polling.learn(false, 3);
        assert_eq!(polling.polls(), POLLS);
    }
}
