//! Waking each other: data channels never wake anybody, so whoever waits has a bell, and whoever has news for it rings.

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
use shoal_base::report::Role;
use shoal_base::stop::Stop;

use super::domain::Domain;
use super::error::{Cause, ChannelError};
use super::service::{Entry, Held, claim, service_name};
use super::{descriptor, memory};

/// Polls before a waiting process blocks. A peer that is at work on another core answers within them; on a shared core
/// they cost it some microseconds.
const POLLS: u32 = 200;

/// Waits in a row over which polling was in vain, after which a process blocks without it: an answerer that shares the
/// asker's core gets that core at once, and one that always takes longer is not waited for by burning a core. Fewer, and
/// one that answers in time every other try would be given up too often.
const IN_VAIN: u32 = 64;

/// One of so many waits polls all the same: processes move from core to core.
const TRIED_AGAIN: u32 = 32;

/// How long a process blocks before it looks after its connections. Rings can be lost when their hearer restarts.
const NAP: Duration = Duration::from_millis(50);

/// Where a bell hangs: a role of the run, and which one of that role.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EventName(pub Role, pub u32);

/// The channel of the launcher's own bell, which is no role.
const LAUNCHER: &str = "bell/launcher";

impl fmt::Display for EventName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "bell/{}/{}", self.0.name(), self.1)
    }
}

/// Hears rings.
#[derive(Debug)]
pub struct Listener {
    listener: IoxListener<ipc::Service>,
    channel: String,
    polling: Polling,
}

/// Whether polling pays for who waits at a bell.
#[derive(Debug, Default)]
struct Polling {
    /// Waits in a row that ended asleep.
    in_vain: Cell<u32>,
}

impl Polling {
    /// Polls before the next sleep; at least one, for what came before the sleep is not rung for again.
    fn polls(&self) -> u32 {
        let in_vain = self.in_vain.get();
        if in_vain < IN_VAIN || in_vain.is_multiple_of(TRIED_AGAIN) {
            POLLS
        } else {
            1
        }
    }

    /// Takes note of how a wait ended. What was there at the first poll says nothing.
    fn learn(&self, slept: bool, polls: u32) {
        if slept {
            self.in_vain.set(self.in_vain.get().wrapping_add(1));
        } else if polls > 0 {
            self.in_vain.set(0);
        }
    }
}

/// Rings the bell of another process.
#[derive(Debug)]
pub struct Notifier {
    notifier: IoxNotifier<ipc::Service>,
}

impl Listener {
    /// Bytes of shared memory that a bell reserves in a run of up to so many actors.
    pub fn reserved(max_actors: usize) -> u64 {
        // The second file holds what has rung: iceoryx2 has one of 2103 bytes for each listener.
        memory::service(2 * parties(max_actors)) + memory::pages(2103)
    }

    /// Hangs the bell of this process.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub fn bind(domain: &Domain, name: EventName) -> Result<Self, ChannelError> {
        Self::on(domain, name.to_string())
    }

    /// Hangs the launcher's bell.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub(super) fn of_launcher(domain: &Domain) -> Result<Self, ChannelError> {
        Self::on(domain, LAUNCHER.into())
    }

    fn on(domain: &Domain, channel: String) -> Result<Self, ChannelError> {
        let listener = claim(|| {
            service(domain, &channel, Entry::Open)?
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

    /// Blocks until a ring or until `patience` is over; whether there was a ring.
    ///
    /// # Errors
    /// When waiting is impossible.
    pub fn wait(&self, patience: Duration) -> Result<bool, ChannelError> {
        // The listener's own `timed_wait` does the same with twice as many system calls. No wait is so long that it could not
        // be said.
        let patience = Timespec::try_from(patience).ok();
        let mut ready = [PollFd::from_borrowed_fd(self.as_fd(), PollFlags::IN)];
        match poll(&mut ready, patience.as_ref()) {
            // A process that was stopped and goes on has only been interrupted.
            Ok(_) | Err(Errno::INTR) => {}
            Err(errno) => return Err(self.failed(io::Error::from(errno))),
        }
        self.notified()
    }

    /// Whether there was a ring since this was asked last. It does not block.
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
    /// Holds the cord of the bell at `place`, whether it hangs there yet or not.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub fn new(domain: &Domain, name: EventName) -> Result<Self, ChannelError> {
        let channel = name.to_string();
        claim(|| Self::on(domain, &channel))
    }

    /// Holds the cord of the launcher's bell, if it can be had at once: a launcher without one looks for itself.
    pub(super) fn to_launcher(domain: &Domain) -> Option<Self> {
        Self::on(domain, LAUNCHER).ok()
    }

    fn on(domain: &Domain, channel: &str) -> Result<Self, ChannelError> {
        let notifier = service(domain, channel, Entry::Open)?
            .notifier_builder()
            .create()
            .map_err(|e| ChannelError::new(channel, "ring", e))?;
        Ok(Self { notifier })
    }

    /// Rings. A ring that finds nobody is no error: the hearer may be restarting, and looks for itself then.
    pub fn notify(&self) {
        if let Err(cause) = self.notifier.notify() {
            tracing::debug!(?cause, "a ring was not heard");
        }
    }
}

/// Waits until `poll` yields something: polls a short while, where that has helped of late, then sleeps at the bell; while
/// it waits, `look_after` renews connections, some twenty times a second.
///
/// # Errors
/// [`Exit::Stopped`] once `stop` is requested, and whatever `poll` or `look_after` fail with.
pub fn wait_for<T>(
    listener: &Listener,
    stop: &Stop,
    mut poll: impl FnMut() -> Result<Option<T>, ChannelError>,
    mut look_after: impl FnMut() -> Result<(), ChannelError>,
) -> Result<T, Exit<ChannelError>> {
    // The clock is not read for an answer that comes while it polls.
    let mut looked_after = None;
    let most = listener.polling.polls();
    loop {
        for polls in 0..most {
            if let Some(found) = poll()? {
                listener.polling.learn(looked_after.is_some(), polls);
                return Ok(found);
            }
            std::hint::spin_loop();
        }
        if stop.requested() {
            return Err(Exit::Stopped);
        }
        let since = looked_after.get_or_insert_with(Instant::now);
        listener.wait(NAP)?;
        // By the clock: rings that bring nothing must not keep it from its connections.
        if since.elapsed() >= NAP {
            *since = Instant::now();
            look_after()?;
        }
    }
}

/// Makes the service of the bell at `place`.
pub(super) fn create(domain: &Domain, name: EventName) -> Result<Held, ChannelError> {
    create_on(domain, &name.to_string())
}

/// Makes the service of the launcher's bell.
pub(super) fn create_of_launcher(domain: &Domain) -> Result<Held, ChannelError> {
    create_on(domain, LAUNCHER)
}

fn create_on(domain: &Domain, channel: &str) -> Result<Held, ChannelError> {
    let service = service(domain, channel, Entry::Create)?;
    Ok(Held::new(move |see| {
        let ports = service.dynamic_config();
        ports.list_listeners(|port| see(port.node_id, port.listener_id.value()));
        ports.list_notifiers(|port| see(port.node_id, port.notifier_id.value()));
    }))
}

fn parties(max_actors: usize) -> usize {
    2 * max_actors + 8
}

fn service(domain: &Domain, channel: &str, entry: Entry) -> Result<PortFactory<ipc::Service>, ChannelError> {
    let parties = parties(domain.max_actors());
    let builder = domain
        .node()
        .service_builder(&service_name(domain, channel)?)
        .event()
        .max_listeners(2)
        .max_notifiers(parties)
        .max_nodes(parties);
    entry.service(channel, builder, |b| b.create(), |b| b.open())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_polls_in_vain_sleeps_at_once_and_tries_again_now_and_then() {
        let polling = Polling::default();
        let asleep = |times| {
            (0..times).filter(|_| {
                let polled = polling.polls() == POLLS;
                polling.learn(true, 0);
                polled
            })
        };
        assert_eq!(asleep(IN_VAIN).count(), IN_VAIN as usize);
        assert_eq!(asleep(4 * TRIED_AGAIN).count(), 4);
        polling.learn(true, 0);
        polling.learn(false, 0);
        assert_eq!(polling.polls(), 1, "what was there at once says nothing");
        polling.learn(false, 3);
        assert_eq!(polling.polls(), POLLS);
    }
}
