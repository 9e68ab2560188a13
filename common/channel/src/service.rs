//! Creating and opening services, and the ports in them.

use std::fmt;
use std::time::{Duration, Instant};

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::prelude::{CallbackProgression, IceoryxSend, ServiceName, ZeroCopySend, ipc};
use iceoryx2::service::port_factory::{PortFactory as _, publish_subscribe, request_response};

use super::domain::Domain;
use super::error::{Cause, ChannelError};

/// Whether a process creates or opens a service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum OpenMode {
    /// Creates it. Only the run's launcher does this, through [`Services`](super::Services).
    Create,
    /// Opens it. It exists before a process that opens it is started.
    Open,
}

impl OpenMode {
    /// Creates or opens the service that `builder` describes. The two methods are passed as arguments, because
    /// iceoryx2's builders have no trait in common.
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

/// The name of a channel's service, for the processes of the run and for iceoryx2's tools.
pub(super) fn service_name(domain: &Domain, channel: &str) -> Result<ServiceName, ChannelError> {
    let name = format!("shoal/{}/{channel}", domain.run_id());
    ServiceName::new(&name).map_err(|cause| ChannelError::new(channel, "name the service", cause))
}

/// How long to wait for a port that another process occupies, usually a dead predecessor.
pub const PORT_TIMEOUT: Duration = Duration::from_secs(5);

/// Calls `attempt`, which opens a service and creates a port in it, and retries for a while if the failure is
/// transient: a dead process may occupy the port until the launcher has cleaned up after it, and its unfinished files
/// exist until they are removed. Any other failure is returned at once.
pub(super) fn make_port<T>(mut attempt: impl FnMut() -> Result<T, ChannelError>) -> Result<T, ChannelError> {
    let deadline = Instant::now() + PORT_TIMEOUT;
    loop {
        match attempt() {
            Err(error) if error.is_transient() && Instant::now() < deadline => {
                std::thread::sleep(Duration::from_millis(5));
            }
            result => return result,
        }
    }
}

/// A callback for each port of a service. Its arguments are the node that created the port, and the port's id.
pub(super) type VisitPort<'a> = &'a mut dyn FnMut(UniqueNodeId, u128) -> CallbackProgression;

/// A service that this process keeps open, whatever its payload.
pub(super) struct HeldService {
    list_ports: Box<dyn Fn(VisitPort<'_>)>,
}

impl HeldService {
    /// Keeps the service open that `list_ports` owns. `list_ports` must visit its ports.
    pub(super) fn new(list_ports: impl Fn(VisitPort<'_>) + 'static) -> Self {
        Self {
            list_ports: Box::new(list_ports),
        }
    }

    /// Keeps a publish-subscribe service open.
    pub(super) fn of_publish_subscribe<P, H>(service: publish_subscribe::PortFactory<ipc::Service, P, H>) -> Self
    where
        P: fmt::Debug + IceoryxSend + ?Sized + 'static,
        H: fmt::Debug + ZeroCopySend + 'static,
    {
        Self::new(move |visit| {
            let ports = service.dynamic_config();
            ports.list_publishers(|port| visit(port.node_id, port.publisher_id.value()));
            ports.list_subscribers(|port| visit(port.node_id, port.subscriber_id.value()));
        })
    }

    /// Keeps a request-response service open whose requests and responses have payloads of one type.
    pub(super) fn of_request_response<P, Q, R>(service: request_response::PortFactory<ipc::Service, P, Q, P, R>) -> Self
    where
        P: fmt::Debug + IceoryxSend + ?Sized + 'static,
        Q: fmt::Debug + ZeroCopySend + 'static,
        R: fmt::Debug + ZeroCopySend + 'static,
    {
        Self::new(move |visit| {
            let ports = service.dynamic_config();
            ports.list_clients(|port| visit(port.node_id, port.client_id.value()));
            ports.list_servers(|port| visit(port.node_id, port.server_id.value()));
        })
    }

    /// Visits every port of the service.
    pub(super) fn list_ports(&self, visit: VisitPort<'_>) {
        (self.list_ports)(visit);
    }
}

impl fmt::Debug for HeldService {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("HeldService").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::OpenOptionsExt;
    use std::path::PathBuf;

    use iceoryx2::port::publisher::Publisher;
    use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

    use super::super::error::{ChannelErrorKind, PeerError};
    use super::*;

    const CHANNEL: &str = "test";

    type Numbers = PortFactory<ipc::Service, u64, ()>;

    fn domain(name: &str) -> Domain {
        Domain::join(&format!("{name}{:x}", std::process::id()), 1).unwrap()
    }

    /// A service for numbers of type `T`, with at most one publisher.
    fn service<T: fmt::Debug + ZeroCopySend>(
        domain: &Domain,
        mode: OpenMode,
    ) -> Result<PortFactory<ipc::Service, T, ()>, ChannelError> {
        let builder = domain.node().service_builder(&service_name(domain, CHANNEL)?);
        let builder = builder.publish_subscribe::<T>().max_publishers(1);
        mode.service(CHANNEL, builder, |b| b.create(), |b| b.open())
    }

    fn publisher(service: &Numbers) -> Result<Publisher<ipc::Service, u64, ()>, ChannelError> {
        let made = service.publisher_builder().create();
        made.map_err(|cause| ChannelError::new(CHANNEL, "publish", cause))
    }

    #[test]
    fn a_port_can_be_claimed_after_its_dead_owner_is_cleaned_up() {
        let domain = domain("ca");
        let held = service(&domain, OpenMode::Create).unwrap();
        let mut predecessor = Some(publisher(&held).unwrap());
        assert_eq!(publisher(&held).unwrap_err().kind, ChannelErrorKind::Occupied);
        let mut attempts = 0;
        let port = make_port(|| {
            attempts += 1;
            if attempts == 3 {
                predecessor = None;
            }
            publisher(&service(&domain, OpenMode::Open)?)
        });
        assert!(port.is_ok(), "{port:?}");
        assert_eq!(attempts, 3);
        drop((port, held));
        domain.leave().unwrap();
    }

    #[test]
    fn opening_an_unfinished_service_is_retried() {
        let domain = domain("cb");
        let held = service::<u64>(&domain, OpenMode::Create).unwrap();
        let services = domain.directory().unwrap().join("services");
        let files = std::fs::read_dir(services).unwrap().map(|entry| entry.unwrap().path());
        let [file]: [PathBuf; 1] = files.collect::<Vec<_>>().try_into().unwrap();
        drop(held);
        // An unfinished file of a service: iceoryx2 makes it read-only at the end.
        let mut options = std::fs::OpenOptions::new();
        options.write(true).create_new(true).mode(0o600).open(&file).unwrap();
        let (mut failures, mut made) = (Vec::new(), None);
        let port = make_port(|| {
            let attempt = service::<u64>(&domain, OpenMode::Open);
            if let Err(error) = &attempt {
                failures.push(error.kind);
                std::fs::remove_file(&file).unwrap();
                made = Some(service::<u64>(&domain, OpenMode::Create).unwrap());
            }
            attempt
        });
        assert!(port.is_ok(), "{port:?}");
        assert_eq!(failures, [ChannelErrorKind::Unfinished]);
        drop((port, made));
        domain.leave().unwrap();
    }

    #[test]
    fn a_permanent_failure_is_returned_at_once_and_states_what_to_do() {
        let domain = domain("cc");
        let error_of = |attempt: &dyn Fn() -> Result<(), ChannelError>| {
            let (begun, mut attempts) = (Instant::now(), 0);
            let error = make_port(|| {
                attempts += 1;
                attempt()
            });
            assert_eq!(attempts, 1, "{error:?}");
            assert!(begun.elapsed() < PORT_TIMEOUT);
            error.unwrap_err()
        };
        let missing = error_of(&|| service::<u64>(&domain, OpenMode::Open).map(drop));
        assert_eq!(missing.kind, ChannelErrorKind::Missing);
        assert_eq!(
            missing.to_string(),
            "channel test: cannot open: it does not exist; has the launcher ended? \
             (PublishSubscribeOpenError::DoesNotExist)"
        );
        let held = service::<u64>(&domain, OpenMode::Create).unwrap();
        let incompatible = error_of(&|| service::<u8>(&domain, OpenMode::Open).map(drop));
        assert_eq!(incompatible.kind, ChannelErrorKind::Incompatible);
        let refused = error_of(&|| Err(ChannelError::new(CHANNEL, "ask", PeerError::Refused)));
        assert_eq!(
            refused.to_string(),
            "channel test: cannot ask: the environment server refused the request"
        );
        drop(held);
        domain.leave().unwrap();
    }
}
