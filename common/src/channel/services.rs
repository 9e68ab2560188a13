//! The services of a run. Whoever hosts it makes each of them before a process that opens it is started, and holds them to
//! the end; all others only open. So a process that is killed while it starts leaves no half-made service behind.

use std::fmt;

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::prelude::CallbackProgression;

use super::cleanup::Sweeper;
use super::{ChannelError, Domain, Place, bell, control, environment, policy, reports, transitions};
use crate::report::{EpisodeReport, EvaluationReport, Heartbeat, JudgedReport, LearnerReport, Role};

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
}

impl fmt::Debug for Held {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Held").finish_non_exhaustive()
    }
}

/// The services of a run that this process has made. They are gone when this is dropped and nobody else has them open.
#[derive(Debug)]
pub struct Services {
    held: Vec<Held>,
    _sweeper: Sweeper,
}

impl Services {
    /// None yet. From now on, what killed processes have half made in the run's shared memory is removed.
    ///
    /// # Errors
    /// When no thread can be started.
    pub fn new(domain: &Domain) -> Result<Self, ChannelError> {
        Ok(Self {
            held: Vec::new(),
            _sweeper: Sweeper::start(domain)?,
        })
    }

    /// Makes what a run has once: control, policy, reports, and what wakes learner and evaluator.
    ///
    /// # Errors
    /// When a service is there already, or shared memory cannot be had.
    pub fn create_common(&mut self, domain: &Domain) -> Result<(), ChannelError> {
        self.held.extend([
            control::create(domain)?,
            policy::create(domain)?,
            reports::create::<Heartbeat>(domain)?,
            reports::create::<EpisodeReport>(domain)?,
            reports::create::<EvaluationReport>(domain)?,
            reports::create::<JudgedReport>(domain)?,
            reports::create::<LearnerReport>(domain)?,
            bell::create(domain, Place(Role::Learner, 0))?,
            bell::create(domain, Place(Role::Evaluator, 0))?,
        ]);
        Ok(())
    }

    /// Makes what environment server `index` needs.
    ///
    /// # Errors
    /// As [`create_common`](Self::create_common).
    pub fn create_environment(&mut self, domain: &Domain, index: u32) -> Result<(), ChannelError> {
        self.held.extend([
            environment::create(domain, index)?,
            bell::create(domain, Place(Role::EnvServer, index))?,
        ]);
        Ok(())
    }

    /// Makes what actor `index` needs, which may have `window` chunks uncommitted, and its environment server.
    ///
    /// # Errors
    /// As [`create_common`](Self::create_common).
    pub fn create_actor(&mut self, domain: &Domain, index: u32, window: u32) -> Result<(), ChannelError> {
        self.create_environment(domain, index)?;
        self.held.extend([
            transitions::create(domain, index, window)?,
            bell::create(domain, Place(Role::Actor, index))?,
        ]);
        Ok(())
    }

    /// Makes what wakes one role, for who has no use of the rest.
    ///
    /// # Errors
    /// As [`create_common`](Self::create_common).
    pub fn create_bell(&mut self, domain: &Domain, place: Place) -> Result<(), ChannelError> {
        self.held.push(bell::create(domain, place)?);
        Ok(())
    }

    /// Shows every port of every service.
    pub(super) fn each_port(&self, mut see: impl FnMut(UniqueNodeId, u128)) {
        let mut see = |node, port| {
            see(node, port);
            CallbackProgression::Continue
        };
        self.held.iter().for_each(|held| (held.list_ports)(&mut see));
    }
}
