//! The services of a run. The launcher creates each of them before it starts a process that opens it, and holds them to
//! the end. Other processes only open services, so one that is killed while it starts leaves no unfinished service
//! behind.

use std::fs::OpenOptions;
use std::io;
use std::os::unix::fs::OpenOptionsExt;

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::prelude::CallbackProgression;
use shoal_base::report::{EpisodeReport, EvaluatedPeriod, EvaluationReport, Heartbeat, LearnerReport};
use shoal_base::role::Role;

use super::cleanup::{Sweeper, is_alive};
use super::domain::{Domain, DomainError, io_error};
use super::error::ChannelError;
use super::event::EventName;
use super::files::prefix;
use super::service::HeldService;
use super::{control, environment, event, policy, reports, transitions};

/// The services of a run that this process has created. A service is removed when this is dropped and no other process
/// has it open.
#[derive(Debug)]
pub struct Services {
    held: Vec<HeldService>,
    _sweeper: Sweeper,
}

impl Services {
    /// Starts with no services, and starts a [`Sweeper`] that removes unfinished files of killed processes.
    ///
    /// # Errors
    /// When the sweeper's thread cannot be started.
    pub fn new(domain: &Domain) -> Result<Self, ChannelError> {
        Ok(Self {
            held: Vec::new(),
            _sweeper: Sweeper::start(domain)?,
        })
    }

    /// Creates the services that a run has once: control, policy, reports, and the event services of launcher, learner
    /// and evaluator.
    ///
    /// # Errors
    /// When a service exists already, or shared memory is unavailable.
    pub fn create_common(&mut self, domain: &Domain) -> Result<(), ChannelError> {
        self.held.extend([
            event::create_of_launcher(domain)?,
            control::create(domain)?,
            policy::create(domain)?,
            reports::create::<Heartbeat>(domain)?,
            reports::create::<EpisodeReport>(domain)?,
            reports::create::<EvaluationReport>(domain)?,
            reports::create::<EvaluatedPeriod>(domain)?,
            reports::create::<LearnerReport>(domain)?,
            event::create(domain, EventName(Role::Learner, 0))?,
            event::create(domain, EventName(Role::Evaluator, 0))?,
        ]);
        Ok(())
    }

    /// Creates the services of environment server `index`.
    ///
    /// # Errors
    /// As [`create_common`](Self::create_common).
    pub fn create_environment(&mut self, domain: &Domain, index: u32) -> Result<(), ChannelError> {
        self.held.extend([
            environment::create(domain, index)?,
            event::create(domain, EventName(Role::EnvServer, index))?,
        ]);
        Ok(())
    }

    /// Creates the services of actor `index`, which may have `window` chunks uncommitted, and of its environment
    /// server.
    ///
    /// # Errors
    /// As [`create_common`](Self::create_common).
    pub fn create_actor(&mut self, domain: &Domain, index: u32, window: u32) -> Result<(), ChannelError> {
        self.create_environment(domain, index)?;
        self.create_transitions(domain, index, window)
    }

    /// Creates the services between actor `index` and the learner: all that the learner's host needs for an actor of
    /// another host.
    ///
    /// # Errors
    /// As [`create_common`](Self::create_common).
    pub fn create_transitions(&mut self, domain: &Domain, index: u32, window: u32) -> Result<(), ChannelError> {
        self.held.extend([
            transitions::create(domain, index, window)?,
            event::create(domain, EventName(Role::Actor, index))?,
        ]);
        Ok(())
    }

    /// Creates the service for the transitions of `actors` actors that have none of their own.
    ///
    /// # Errors
    /// As [`create_common`](Self::create_common).
    pub fn create_shared_transitions(&mut self, domain: &Domain, actors: u32, window: u32) -> Result<(), ChannelError> {
        self.held.push(transitions::create_shared(domain, actors, window)?);
        Ok(())
    }

    /// Creates the event service of one role alone.
    ///
    /// # Errors
    /// As [`create_common`](Self::create_common).
    pub fn create_event(&mut self, domain: &Domain, name: EventName) -> Result<(), ChannelError> {
        self.held.push(event::create(domain, name)?);
        Ok(())
    }

    /// How many services are held.
    pub fn count(&self) -> usize {
        self.held.len()
    }

    /// Restores missing port tags of dead processes. Without its tag iceoryx2 never frees a port, so call this before a
    /// clean-up.
    ///
    /// # Errors
    /// When a file cannot be created.
    pub fn restore_port_tags(&self, domain: &Domain) -> Result<(), DomainError> {
        let nodes = domain.directory()?.join("nodes");
        let mut restored = Ok(());
        self.each_port(|node, port| {
            let directory = nodes.join(node.value().to_string());
            let tag = directory.join(format!("{}{port}.port_tag", prefix(domain.run_id())));
            if restored.is_ok() && !is_alive(node) && directory.is_dir() && !tag.exists() {
                let made = OpenOptions::new()
                    .write(true)
                    .create(true)
                    .truncate(false)
                    .mode(0o600)
                    .open(&tag);
                restored = match made {
                    // The directory is gone: another clean-up has finished.
                    Err(cause) if cause.kind() == io::ErrorKind::NotFound => Ok(()),
                    made => made.map(drop).map_err(io_error("make", &tag)),
                };
            }
        });
        restored
    }

    /// Number of ports that dead processes occupy.
    pub fn ports_of_dead_processes(&self) -> usize {
        let mut occupied = 0;
        self.each_port(|node, _| occupied += usize::from(!is_alive(node)));
        occupied
    }

    /// Number of ports of all services.
    #[cfg(test)]
    pub(super) fn ports(&self) -> usize {
        let mut ports = 0;
        self.each_port(|_, _| ports += 1);
        ports
    }

    /// Visits every port of every service.
    fn each_port(&self, mut visit: impl FnMut(UniqueNodeId, u128)) {
        let mut visit = |node, port| {
            visit(node, port);
            CallbackProgression::Continue
        };
        self.held.iter().for_each(|held| held.list_ports(&mut visit));
    }
}
