//! Why a channel does not work: the kind, by which the program decides, and the cause, for people.

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

use super::environment::Fault;

/// A channel does not work: its service or port cannot be had, memory is exhausted, or the other side breaks the rules.
#[derive(Debug, thiserror::Error)]
#[error("channel {channel}: cannot {action}: {}", reason(*kind, source.as_ref()))]
pub struct ChannelError {
    /// Name of the channel within the run.
    pub channel: String,
    /// What was tried.
    pub action: &'static str,
    /// What kind of failure it is.
    pub kind: ChannelErrorKind,
    /// What exactly happened, as iceoryx2 or the system says it, or a [`PeerError`].
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

    /// What an environment returned that it may not, if that is why; it can go on with new episodes.
    pub fn fault(&self) -> Option<&Fault> {
        match self.source.downcast_ref() {
            Some(PeerError::Invalid(fault)) => Some(fault),
            _ => None,
        }
    }

    /// Whether the same attempt may succeed a moment later, without anybody's help but the launcher's: it cleans up after
    /// processes that were killed.
    pub fn may_pass(&self) -> bool {
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

/// A kind of failure of a channel. Its text says what to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ChannelErrorKind {
    /// Every place is taken. A process that was killed has its place until the launcher has cleaned up after it.
    #[error("its places are taken by other processes; end those first")]
    Occupied,
    /// Somebody is making it, or was killed over that.
    #[error("it is half made, by a process that was killed or is stopped; try again")]
    Unfinished,
    /// A signal came in between.
    #[error("a signal came in between; try again")]
    Interrupted,
    /// It is not there, or is just being removed.
    #[error("it is not there; has the launcher ended?")]
    Missing,
    /// The system does not allow it.
    #[error("the system does not allow it; does the run belong to another user?")]
    Permission,
    /// It is there, and made for other types or numbers.
    #[error("it was made by another build of this program; use the same build for the whole run")]
    Incompatible,
    /// It is there, and damaged.
    #[error("it is damaged; stop the run and resume it")]
    Corrupted,
    /// Memory, files, or what may be in hand at the same time are used up.
    #[error("nothing is left to make it of; is /dev/shm full?")]
    Exhausted,
    /// The other side is there, and its memory cannot be used.
    #[error("no connection to the other side")]
    Unreachable,
    /// The other side says what it must not say.
    #[error("the other side breaks the rules")]
    Peer,
    /// Anything else.
    #[error("an unexpected failure; is /dev/shm mounted and not full?")]
    Internal,
}

/// The other side of a channel says what it must not say, or what cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PeerError {
    /// A description has not all its numbers.
    #[error("the answer is too short")]
    ShortAnswer,
    /// A snapshot is of another environment, or another number of them.
    #[error("{found} words for a snapshot of {expected}")]
    SnapshotLength {
        /// Words there are.
        found: usize,
        /// Words that the environments' states have.
        expected: usize,
    },
    /// An environment returned what it may not.
    #[error(transparent)]
    Invalid(Fault),
    /// The environment server does not do what it is asked.
    #[error("the environment server refused the request")]
    Refused,
    /// The environment server denies what it has answered before.
    #[error("the environment server has begun episodes and says that it has not: it breaks the protocol")]
    EpisodesDenied,
    /// The environment server cannot be connected to, however often that is tried.
    #[error("no connection to the environment server, which is there")]
    NoConnection,
    /// A chunk says that it has more rows than it has room for, or has another length.
    #[error("a chunk of {numbers} numbers claims {rows} rows")]
    ChunkLength {
        /// Numbers in the chunk.
        numbers: usize,
        /// Rows it claims to have.
        rows: usize,
    },
    /// A policy has other parameters than the reader's.
    #[error("the learner's networks have another layout")]
    PolicyLayout,
}

/// What a peer did says itself what it is; the errors of iceoryx2 are names, after which people would have to search.
fn reason(kind: ChannelErrorKind, source: &(dyn Error + Send + Sync)) -> String {
    match kind {
        ChannelErrorKind::Peer => source.to_string(),
        _ => format!("{kind} ({source})"),
    }
}

/// An error that a channel may fail with, and its kind.
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
