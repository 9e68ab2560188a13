//! How a process comes to a service and to a port in it.

use std::fmt;
use std::time::{Duration, Instant};

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::prelude::{CallbackProgression, ServiceName};

use super::domain::Domain;
use super::error::{Cause, ChannelError};

/// How a process comes to a service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Entry {
    /// Makes it: for the run's host alone, through [`Services`](super::Services).
    Create,
    /// Opens it. It is there before whoever opens it is started.
    Open,
}

impl Entry {
    /// Makes or opens the service that `builder` describes. iceoryx2's builders have no trait in common, so their two
    /// methods are given.
    pub(super) fn service<B, S, C: Cause, O: Cause>(
        self,
        channel: &str,
        builder: B,
        create: impl FnOnce(B) -> Result<S, C>,
        open: impl FnOnce(B) -> Result<S, O>,
    ) -> Result<S, ChannelError> {
        match self {
            Self::Create => create(builder).map_err(|cause| ChannelError::new(channel, "create", cause)),
            Self::Open => open(builder).map_err(|cause| ChannelError::new(channel, "open", cause)),
        }
    }
}

/// The service name of a channel; every process of the run and the ecosystem's tools see it under this name.
pub(super) fn service_name(domain: &Domain, channel: &str) -> Result<ServiceName, ChannelError> {
    let name = format!("shoal/{}/{channel}", domain.run_id());
    ServiceName::new(&name).map_err(|cause| ChannelError::new(channel, "be named", cause))
}

/// How long a dead predecessor may occupy a port before we give up.
pub(super) const CLAIM_PATIENCE: Duration = Duration::from_secs(5);

/// Opens a service and makes a port in it. A process that died may still hold the place until the launcher has cleaned up
/// after it, and what it had half made is there until it is swept away. So where the failure may pass, the attempt is made
/// again for a while; any other failure is returned at once.
pub(super) fn claim<T>(mut attempt: impl FnMut() -> Result<T, ChannelError>) -> Result<T, ChannelError> {
    let deadline = Instant::now() + CLAIM_PATIENCE;
    loop {
        match attempt() {
            Err(error) if error.may_pass() && Instant::now() < deadline => {
                std::thread::sleep(Duration::from_millis(5));
            }
            result => return result,
        }
    }
}

/// Is shown each port of a service: the node that made it, and its number.
pub(super) type SeePort<'a> = &'a mut dyn FnMut(UniqueNodeId, u128) -> CallbackProgression;

/// A service that is held, whatever its payload.
pub(super) struct Held {
    list_ports: Box<dyn Fn(SeePort<'_>)>,
}

impl Held {
    /// Holds the service that `list_ports` owns, and whose ports it shows.
    pub(super) fn new(list_ports: impl Fn(SeePort<'_>) + 'static) -> Self {
        Self {
            list_ports: Box::new(list_ports),
        }
    }

    /// Shows every port of the service.
    pub(super) fn list_ports(&self, see: SeePort<'_>) {
        (self.list_ports)(see);
    }
}

impl fmt::Debug for Held {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Held").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::OpenOptionsExt;
    use std::path::PathBuf;

    use iceoryx2::port::publisher::Publisher;
    use iceoryx2::prelude::{ZeroCopySend, ipc};
    use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

    use super::super::error::{ChannelErrorKind, PeerError};
    use super::*;

    const CHANNEL: &str = "test";

    type Numbers = PortFactory<ipc::Service, u64, ()>;

    fn domain(name: &str) -> Domain {
        Domain::join(&format!("{name}{:x}", std::process::id()), 1).unwrap()
    }

    /// A service for numbers of type `T`, with room for one publisher.
    fn service<T: fmt::Debug + ZeroCopySend>(
        domain: &Domain,
        entry: Entry,
    ) -> Result<PortFactory<ipc::Service, T, ()>, ChannelError> {
        let builder = domain.node().service_builder(&service_name(domain, CHANNEL)?);
        let builder = builder.publish_subscribe::<T>().max_publishers(1);
        entry.service(CHANNEL, builder, |b| b.create(), |b| b.open())
    }

    fn publisher(service: &Numbers) -> Result<Publisher<ipc::Service, u64, ()>, ChannelError> {
        let made = service.publisher_builder().create();
        made.map_err(|cause| ChannelError::new(CHANNEL, "publish", cause))
    }

    #[test]
    fn a_port_is_claimed_once_its_dead_holder_is_cleaned_up_after() {
        let domain = domain("ca");
        let held = service(&domain, Entry::Create).unwrap();
        let mut predecessor = Some(publisher(&held).unwrap());
        assert_eq!(publisher(&held).unwrap_err().kind, ChannelErrorKind::Occupied);
        let mut attempts = 0;
        let claimed = claim(|| {
            attempts += 1;
            if attempts == 3 {
                predecessor = None;
            }
            publisher(&service(&domain, Entry::Open)?)
        });
        assert!(claimed.is_ok(), "{claimed:?}");
        assert_eq!(attempts, 3);
        drop((claimed, held));
        domain.leave().unwrap();
    }

    #[test]
    fn a_service_that_is_half_made_is_tried_again() {
        let domain = domain("cb");
        let held = service::<u64>(&domain, Entry::Create).unwrap();
        let services = domain.directory().unwrap().join("services");
        let files = std::fs::read_dir(services).unwrap().map(|entry| entry.unwrap().path());
        let [file]: [PathBuf; 1] = files.collect::<Vec<_>>().try_into().unwrap();
        drop(held);
        // As it stands before its maker has written it: iceoryx2 makes it read-only at last.
        let mut options = std::fs::OpenOptions::new();
        options.write(true).create_new(true).mode(0o600).open(&file).unwrap();
        let (mut failures, mut made) = (Vec::new(), None);
        let claimed = claim(|| {
            let attempt = service::<u64>(&domain, Entry::Open);
            if let Err(error) = &attempt {
                failures.push(error.kind);
                std::fs::remove_file(&file).unwrap();
                made = Some(service::<u64>(&domain, Entry::Create).unwrap());
            }
            attempt
        });
        assert!(claimed.is_ok(), "{claimed:?}");
        assert_eq!(failures, [ChannelErrorKind::Unfinished]);
        drop((claimed, made));
        domain.leave().unwrap();
    }

    #[test]
    fn what_cannot_pass_fails_at_once_and_says_what_to_do() {
        let domain = domain("cc");
        let claimed = |attempt: &dyn Fn() -> Result<(), ChannelError>| {
            let (begun, mut attempts) = (Instant::now(), 0);
            let error = claim(|| {
                attempts += 1;
                attempt()
            });
            assert_eq!(attempts, 1, "{error:?}");
            assert!(begun.elapsed() < CLAIM_PATIENCE);
            error.unwrap_err()
        };
        let missing = claimed(&|| service::<u64>(&domain, Entry::Open).map(drop));
        assert_eq!(missing.kind, ChannelErrorKind::Missing);
        assert_eq!(
            missing.to_string(),
            "channel test: cannot open: it is not there; has the launcher ended? (PublishSubscribeOpenError::DoesNotExist)"
        );
        let held = service::<u64>(&domain, Entry::Create).unwrap();
        let incompatible = claimed(&|| service::<u8>(&domain, Entry::Open).map(drop));
        assert_eq!(incompatible.kind, ChannelErrorKind::Incompatible);
        let refused = claimed(&|| Err(ChannelError::new(CHANNEL, "ask", PeerError::Refused)));
        assert_eq!(
            refused.to_string(),
            "channel test: cannot ask: the environment server refused the request"
        );
        drop(held);
        domain.leave().unwrap();
    }
}
