//! The services of a run. Whoever hosts it makes each of them before a process that opens it is started, and holds them to
//! the end; all others only open. So a process that is killed while it starts leaves no half-made service behind.

use std::fs::OpenOptions;
use std::io;
use std::os::unix::fs::OpenOptionsExt;

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::prelude::CallbackProgression;
use shoal_base::report::{EpisodeReport, EvaluatedReport, EvaluationReport, Heartbeat, LearnerReport, Role};

use super::cleanup::{Sweeper, lives};
use super::domain::{Domain, DomainError, io_error};
use super::error::ChannelError;
use super::event::EventName;
use super::files::prefix;
use super::service::Held;
use super::{control, environment, event, policy, reports, transitions};

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

    /// Makes what a run has once: control, policy, reports, and what wakes launcher, learner and evaluator.
    ///
    /// # Errors
    /// When a service is there already, or shared memory cannot be had.
    pub fn create_common(&mut self, domain: &Domain) -> Result<(), ChannelError> {
        self.held.extend([
            event::create_of_launcher(domain)?,
            control::create(domain)?,
            policy::create(domain)?,
            reports::create::<Heartbeat>(domain)?,
            reports::create::<EpisodeReport>(domain)?,
            reports::create::<EvaluationReport>(domain)?,
            reports::create::<EvaluatedReport>(domain)?,
            reports::create::<LearnerReport>(domain)?,
            event::create(domain, EventName(Role::Learner, 0))?,
            event::create(domain, EventName(Role::Evaluator, 0))?,
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
            event::create(domain, EventName(Role::EnvServer, index))?,
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
            event::create(domain, EventName(Role::Actor, index))?,
        ]);
        Ok(())
    }

    /// Makes what wakes one role, for who has no use of the rest.
    ///
    /// # Errors
    /// As [`create_common`](Self::create_common).
    pub fn create_event(&mut self, domain: &Domain, name: EventName) -> Result<(), ChannelError> {
        self.held.push(event::create(domain, name)?);
        Ok(())
    }

    /// Puts back what tells iceoryx2 of dead processes' ports, where it is gone and the port is not. To be called before a
    /// clean-up.
    ///
    /// # Errors
    /// When a file cannot be made.
    pub fn restore_port_tags(&self, domain: &Domain) -> Result<(), DomainError> {
        let nodes = domain.directory()?.join("nodes");
        let mut restored = Ok(());
        self.each_port(|node, port| {
            let directory = nodes.join(node.value().to_string());
            let tag = directory.join(format!("{}{port}.port_tag", prefix(domain.run_id())));
            if restored.is_ok() && !lives(node) && directory.is_dir() && !tag.exists() {
                let made = OpenOptions::new()
                    .write(true)
                    .create(true)
                    .truncate(false)
                    .mode(0o600)
                    .open(&tag);
                restored = match made {
                    // Another clean-up has done all there is to do.
                    Err(cause) if cause.kind() == io::ErrorKind::NotFound => Ok(()),
                    made => made.map(drop).map_err(io_error("make", &tag)),
                };
            }
        });
        restored
    }

    /// Ports that dead processes occupy.
    pub fn occupied_by_the_dead(&self) -> usize {
        let mut occupied = 0;
        self.each_port(|node, _| occupied += usize::from(!lives(node)));
        occupied
    }

    /// Shows every port of every service.
    fn each_port(&self, mut see: impl FnMut(UniqueNodeId, u128)) {
        let mut see = |node, port| {
            see(node, port);
            CallbackProgression::Continue
        };
        self.held.iter().for_each(|held| held.list_ports(&mut see));
    }
}
