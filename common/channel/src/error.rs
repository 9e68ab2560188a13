//! Errors of channels: the kind, which the program acts on, and the cause, for the user.

use std::error::Error;
use std::io;

use bincode::error::EncodeError;
use iceoryx2::port::client::RequestSendError;
use iceoryx2::port::listener::{ListenerCreateError, ListenerWaitError};
use iceoryx2::port::notifier::NotifierCreateError;
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::port::update_connections::ConnectionFailure;
use iceoryx2::port::{LoanError, ReceiveError, SendError};
use iceoryx2::service::builder::event::{EventCreateError, EventOpenError};
use iceoryx2::service::builder::publish_subscribe::{PublishSubscribeCreateError, PublishSubscribeOpenError};
use iceoryx2::service::builder::request_response::{RequestResponseCreateError, RequestResponseOpenError};
use iceoryx2::service::port_factory::client::ClientCreateError;
use iceoryx2::service::port_factory::server::ServerCreateError;
use iceoryx2::service::service_name::ServiceNameError;

use super::environment::ResponseFault;

/// Why a channel fails: its service or port is unavailable, memory is exhausted, or the other side violates the
/// protocol.
#[derive(Debug, thiserror::Error)]
#[error("channel {channel}: cannot {action}: {}", reason(*kind, source.as_ref()))]
pub struct ChannelError {
    /// Name of the channel within the run.
    pub channel: String,
    /// What was tried.
    pub action: &'static str,
    /// What kind of failure it is.
    pub kind: ChannelErrorKind,
    /// The exact cause: an error of iceoryx2 or the system, or a [`PeerError`].
    pub source: Box<dyn Error + Send + Sync>,
}

impl ChannelError {
    pub(super) fn new(channel: impl Into<String>, action: &'static str, cause: impl Cause) -> Self {
        Self {
            channel: channel.into(),
            action,
            kind: cause.kind(),
            source: Box::new(cause),
        }
    }

    /// The invalid answer of an environment server, if that is the cause. The server can continue with new episodes.
    pub fn fault(&self) -> Option<&ResponseFault> {
        match self.source.downcast_ref() {
            Some(PeerError::Invalid(fault)) => Some(fault),
            _ => None,
        }
    }

    /// Whether the same attempt may succeed a moment later without the user's help, once the launcher has cleaned up
    /// after killed processes.
    pub fn is_transient(&self) -> bool {
        match self.kind {
            ChannelErrorKind::Occupied | ChannelErrorKind::Unfinished | ChannelErrorKind::Interrupted => true,
            ChannelErrorKind::Missing
            | ChannelErrorKind::Permission
            | ChannelErrorKind::Incompatible
            | ChannelErrorKind::Corrupted
            | ChannelErrorKind::Exhausted
            | ChannelErrorKind::Unreachable
            | ChannelErrorKind::Peer
            | ChannelErrorKind::Internal => false,
        }
    }
}

/// A kind of failure of a channel. Its text states what to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ChannelErrorKind {
    /// All ports are taken. A killed process keeps its port until the launcher has cleaned up after it.
    #[error("all its ports are used by other processes; end those first")]
    Occupied,
    /// Another process is creating the service, or was killed while it did.
    #[error("it is unfinished, because the process that creates it was killed or is stopped; try again")]
    Unfinished,
    /// A signal interrupted the call.
    #[error("a signal interrupted the call; try again")]
    Interrupted,
    /// The service does not exist, or is being removed.
    #[error("it does not exist; has the launcher ended?")]
    Missing,
    /// The system denies access.
    #[error("the system denies access; does the run belong to another user?")]
    Permission,
    /// The service exists, but with other types or limits.
    #[error("it was created by another build of this program; use the same build for the whole run")]
    Incompatible,
    /// The service exists, but is damaged.
    #[error("it is damaged; stop the run and resume it")]
    Corrupted,
    /// Memory, files, threads, or the samples that may be held at the same time are used up.
    #[error("memory, files or threads are used up; is /dev/shm full, or a limit of `ulimit -a` reached?")]
    Exhausted,
    /// The other side exists, but its memory cannot be used.
    #[error("no connection to the other side")]
    Unreachable,
    /// The other side violates the protocol.
    #[error("the other side violates the protocol")]
    Peer,
    /// Anything else.
    #[error("an unexpected failure; is /dev/shm mounted and not full?")]
    Internal,
}

/// The other side of a channel violates the protocol, or sends something that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PeerError {
    /// A description has another number of bounds than its spaces need.
    #[error("the environment server's description has another number of bounds than its spaces need")]
    DescriptionLength,
    /// A snapshot is of another environment, or of another number of environments.
    #[error("the snapshot has {found} words instead of {expected}")]
    SnapshotLength {
        /// Words in the snapshot.
        found: usize,
        /// Words in a snapshot of the environments.
        expected: usize,
    },
    /// An environment returned something invalid.
    #[error(transparent)]
    Invalid(ResponseFault),
    /// The environment server refused a request.
    #[error("the environment server refused the request")]
    Refused,
    /// The environment server says that its episodes have not begun, although they have.
    #[error(
        "the environment server says that its episodes have not begun, although they have: it violates the protocol"
    )]
    EpisodesDenied,
    /// Repeated attempts to connect to the environment server have failed, although it exists.
    #[error("the environment server exists, but cannot be connected to")]
    NoConnection,
    /// A chunk claims more rows than it has space for, or has another length than the layout.
    #[error("a chunk of {numbers} numbers claims {rows} rows")]
    ChunkLength {
        /// Numbers in the chunk.
        numbers: usize,
        /// Rows that it claims to have.
        rows: usize,
    },
    /// A policy has another layout than the reader expects.
    #[error("the learner's networks have another layout")]
    PolicyLayout,
}

/// The reason in an error's message. The text of a [`PeerError`] is sufficient; errors of iceoryx2 are only names, so
/// the text of the kind comes first.
fn reason(kind: ChannelErrorKind, source: &(dyn Error + Send + Sync)) -> String {
    match kind {
        ChannelErrorKind::Peer => source.to_string(),
        _ => format!("{kind} ({source})"),
    }
}

/// An error that can be the cause of a [`ChannelError`].
pub(super) trait Cause: Error + Send + Sync + 'static {
    fn kind(&self) -> ChannelErrorKind;
}

impl Cause for PeerError {
    fn kind(&self) -> ChannelErrorKind {
        ChannelErrorKind::Peer
    }
}

impl Cause for io::Error {
    fn kind(&self) -> ChannelErrorKind {
        match self.kind() {
            io::ErrorKind::PermissionDenied => ChannelErrorKind::Permission,
            io::ErrorKind::Interrupted => ChannelErrorKind::Interrupted,
            io::ErrorKind::OutOfMemory | io::ErrorKind::StorageFull | io::ErrorKind::WouldBlock => {
                ChannelErrorKind::Exhausted
            }
            _ => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for EncodeError {
    fn kind(&self) -> ChannelErrorKind {
        ChannelErrorKind::Internal
    }
}

impl Cause for ServiceNameError {
    fn kind(&self) -> ChannelErrorKind {
        ChannelErrorKind::Internal
    }
}

impl Cause for EventOpenError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::Interrupt => ChannelErrorKind::Interrupted,
            Self::HangsInCreation => ChannelErrorKind::Unfinished,
            Self::ExceedsMaxNumberOfNodes => ChannelErrorKind::Occupied,
            Self::DoesNotExist | Self::IsMarkedForDestruction => ChannelErrorKind::Missing,
            Self::InsufficientPermissions => ChannelErrorKind::Permission,
            Self::ServiceInCorruptedState => ChannelErrorKind::Corrupted,
            Self::IncompatibleMessagingPattern
            | Self::IncompatibleAttributes
            | Self::IncompatibleDeadline
            | Self::IncompatibleNotifierCreatedEvent
            | Self::IncompatibleNotifierDroppedEvent
            | Self::IncompatibleNotifierDeadEvent
            | Self::DoesNotSupportRequestedAmountOfNotifiers
            | Self::DoesNotSupportRequestedAmountOfListeners
            | Self::DoesNotSupportRequestedMaxEventId
            | Self::DoesNotSupportRequestedAmountOfNodes
            | Self::VersionMismatch => ChannelErrorKind::Incompatible,
            Self::InternalFailure | Self::UnableToCreateServiceTag => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for EventCreateError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::Interrupt => ChannelErrorKind::Interrupted,
            Self::IsBeingCreatedByAnotherInstance => ChannelErrorKind::Unfinished,
            Self::AlreadyExists => ChannelErrorKind::Occupied,
            Self::InsufficientPermissions => ChannelErrorKind::Permission,
            Self::ServiceInCorruptedState => ChannelErrorKind::Corrupted,
            Self::ServiceConfigCouldNotBeCreated => ChannelErrorKind::Exhausted,
            Self::InternalFailure
            | Self::UnableToCreateServiceTag
            | Self::EventIdExceedsMaxSupportedValue
            | Self::UnableToGenerateUniqueServiceId => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for PublishSubscribeOpenError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::Interrupt => ChannelErrorKind::Interrupted,
            Self::HangsInCreation => ChannelErrorKind::Unfinished,
            Self::ExceedsMaxNumberOfNodes => ChannelErrorKind::Occupied,
            Self::DoesNotExist | Self::IsMarkedForDestruction => ChannelErrorKind::Missing,
            Self::InsufficientPermissions => ChannelErrorKind::Permission,
            Self::ServiceInCorruptedState | Self::InvalidTypeDefinition => ChannelErrorKind::Corrupted,
            Self::IncompatibleTypes
            | Self::IncompatibleMessagingPattern
            | Self::IncompatibleAttributes
            | Self::IncompatibleOverflowBehavior
            | Self::DoesNotSupportRequestedMinBufferSize
            | Self::DoesNotSupportRequestedMinHistorySize
            | Self::DoesNotSupportRequestedMinSubscriberBorrowedSamples
            | Self::DoesNotSupportRequestedAmountOfPublishers
            | Self::DoesNotSupportRequestedAmountOfSubscribers
            | Self::DoesNotSupportRequestedAmountOfNodes
            | Self::VersionMismatch => ChannelErrorKind::Incompatible,
            Self::InternalFailure | Self::UnableToCreateServiceTag | Self::UnableToAcquireTypeDefinition => {
                ChannelErrorKind::Internal
            }
        }
    }
}

impl Cause for PublishSubscribeCreateError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::Interrupt => ChannelErrorKind::Interrupted,
            Self::HangsInCreation | Self::IsBeingCreatedByAnotherInstance => ChannelErrorKind::Unfinished,
            Self::AlreadyExists => ChannelErrorKind::Occupied,
            Self::InsufficientPermissions => ChannelErrorKind::Permission,
            Self::ServiceInCorruptedState | Self::InvalidTypeDefinition => ChannelErrorKind::Corrupted,
            Self::ServiceConfigCouldNotBeCreated => ChannelErrorKind::Exhausted,
            Self::InternalFailure
            | Self::SubscriberBufferMustBeLargerThanHistorySize
            | Self::UnableToCreateServiceTag
            | Self::UnableToAcquireTypeDefinition
            | Self::UnableToGenerateUniqueServiceId => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for RequestResponseOpenError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::Interrupt => ChannelErrorKind::Interrupted,
            Self::HangsInCreation => ChannelErrorKind::Unfinished,
            Self::ExceedsMaxNumberOfNodes => ChannelErrorKind::Occupied,
            Self::DoesNotExist | Self::IsMarkedForDestruction => ChannelErrorKind::Missing,
            Self::InsufficientPermissions => ChannelErrorKind::Permission,
            Self::ServiceInCorruptedState | Self::InvalidTypeDefinition => ChannelErrorKind::Corrupted,
            Self::IncompatibleRequestOrResponseType
            | Self::IncompatibleAttributes
            | Self::IncompatibleMessagingPattern
            | Self::IncompatibleOverflowBehaviorForRequests
            | Self::IncompatibleOverflowBehaviorForResponses
            | Self::IncompatibleBehaviorForFireAndForgetRequests
            | Self::DoesNotSupportRequestedAmountOfClientRequestLoans
            | Self::DoesNotSupportRequestedAmountOfActiveRequestsPerClient
            | Self::DoesNotSupportRequestedResponseBufferSize
            | Self::DoesNotSupportRequestedAmountOfServers
            | Self::DoesNotSupportRequestedAmountOfClients
            | Self::DoesNotSupportRequestedAmountOfNodes
            | Self::DoesNotSupportRequestedAmountOfBorrowedResponsesPerPendingResponse
            | Self::VersionMismatch => ChannelErrorKind::Incompatible,
            Self::InternalFailure | Self::UnableToCreateServiceTag | Self::UnableToAcquireTypeDefinition => {
                ChannelErrorKind::Internal
            }
        }
    }
}

impl Cause for RequestResponseCreateError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::Interrupt => ChannelErrorKind::Interrupted,
            Self::HangsInCreation | Self::IsBeingCreatedByAnotherInstance => ChannelErrorKind::Unfinished,
            Self::AlreadyExists => ChannelErrorKind::Occupied,
            Self::InsufficientPermissions => ChannelErrorKind::Permission,
            Self::ServiceInCorruptedState | Self::InvalidTypeDefinition => ChannelErrorKind::Corrupted,
            Self::ServiceConfigCouldNotBeCreated => ChannelErrorKind::Exhausted,
            Self::InternalFailure
            | Self::UnableToCreateServiceTag
            | Self::UnableToAcquireTypeDefinition
            | Self::UnableToGenerateUniqueServiceId => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for ListenerCreateError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::ExceedsMaxSupportedListeners => ChannelErrorKind::Occupied,
            Self::ResourceCreationFailed => ChannelErrorKind::Exhausted,
            Self::FailedToDeployThreadsafetyPolicy
            | Self::UnableToCreatePortTag
            | Self::UnableToGenerateUniqueListenerId => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for NotifierCreateError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::ExceedsMaxSupportedNotifiers => ChannelErrorKind::Occupied,
            Self::FailedToDeployThreadsafetyPolicy
            | Self::UnableToCreatePortTag
            | Self::UnableToGenerateUniqueNotifierId => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for PublisherCreateError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::ExceedsMaxSupportedPublishers => ChannelErrorKind::Occupied,
            Self::UnableToCreateDataSegment => ChannelErrorKind::Exhausted,
            Self::FailedToDeployThreadsafetyPolicy
            | Self::UnableToCreatePortTag
            | Self::UnableToGenerateUniquePublisherId => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for SubscriberCreateError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::ExceedsMaxSupportedSubscribers => ChannelErrorKind::Occupied,
            Self::BufferSizeExceedsMaxSupportedBufferSizeOfService
            | Self::HistoryRequestExceedsHistorySizeOfService
            | Self::HistoryRequestExceedsBufferSizeOfSubscriber => ChannelErrorKind::Incompatible,
            Self::FailedToDeployThreadsafetyPolicy
            | Self::UnableToCreatePortTag
            | Self::UnableToGenerateUniqueSubscriberId => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for ClientCreateError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::ExceedsMaxSupportedClients => ChannelErrorKind::Occupied,
            Self::UnableToCreateDataSegment => ChannelErrorKind::Exhausted,
            Self::MaxActiveRequestsExceedsMaxSupportedActiveRequestsOfService => ChannelErrorKind::Incompatible,
            Self::FailedToDeployThreadsafetyPolicy
            | Self::UnableToCreatePortTag
            | Self::UnableToGenerateUniqueClientId => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for ServerCreateError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::ExceedsMaxSupportedServers => ChannelErrorKind::Occupied,
            Self::UnableToCreateDataSegment => ChannelErrorKind::Exhausted,
            Self::FailedToDeployThreadsafetyPolicy
            | Self::UnableToCreatePortTag
            | Self::UnableToGenerateUniqueServerId => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for ConnectionFailure {
    fn kind(&self) -> ChannelErrorKind {
        ChannelErrorKind::Unreachable
    }
}

impl Cause for LoanError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::OutOfMemory | Self::ExceedsMaxLoans => ChannelErrorKind::Exhausted,
            Self::ExceedsMaxLoanSize => ChannelErrorKind::Incompatible,
            Self::InternalFailure => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for SendError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::LoanError(cause) => cause.kind(),
            Self::ConnectionError(cause) => cause.kind(),
            Self::ConnectionBrokenSinceSenderNoLongerExists | Self::UnableToDeliver => ChannelErrorKind::Unreachable,
            Self::ConnectionCorrupted => ChannelErrorKind::Corrupted,
            Self::InternalError => ChannelErrorKind::Internal,
        }
    }
}

impl Cause for RequestSendError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::ExceedsMaxActiveRequests => ChannelErrorKind::Exhausted,
            Self::SendError(cause) => cause.kind(),
        }
    }
}

impl Cause for ReceiveError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::ExceedsMaxBorrows => ChannelErrorKind::Exhausted,
            Self::ConnectionFailure(cause) => cause.kind(),
        }
    }
}

impl Cause for ListenerWaitError {
    fn kind(&self) -> ChannelErrorKind {
        match self {
            Self::InterruptSignal => ChannelErrorKind::Interrupted,
            Self::ContractViolation | Self::InternalFailure => ChannelErrorKind::Internal,
        }
    }
}
