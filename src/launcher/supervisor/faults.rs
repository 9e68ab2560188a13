//! Invalid answers of environments. Too many end the run.

use anyhow::bail;
use shoal_actor::environment::EPISODES_DROPPED;
use shoal_common::channel::environment::ResponseFault;
use shoal_common::role::Role;
use shoal_run::records::recorder::{Incident, IncidentKind};

use super::Supervisor;
use crate::launcher::process::name;

/// The invalid answers since the launcher started.
#[derive(Debug)]
pub(super) struct Faults {
    pub(super) count: u32,
    /// The number that ends the run.
    pub(super) most: u32,
    /// Who gave the last one, and what it was.
    pub(super) last: String,
}

impl Supervisor {
    /// Counts an invalid answer of environment server `index`, which `client` has reported.
    pub(super) fn note_fault(&mut self, client: &str, index: u32) {
        self.faults.count = self.faults.count.saturating_add(1);
        let server = self.roles.iter().find(|it| it.is(Role::EnvServer, index));
        if let Some(server) = server {
            // A server that checks its own answers has logged the fault, otherwise its client has.
            let by_client = self
                .log
                .last_lines(client)
                .pop()
                .filter(|line| line.contains(EPISODES_DROPPED));
            let last = by_client.filter(|line| !line.contains(&ResponseFault::Reported.to_string()));
            let last = last
                .or_else(|| self.log.last_lines(&name(server.instance)).pop())
                .unwrap_or_default();
            self.log.write_left_out(&name(server.instance));
            let last = last.strip_prefix("error: ").unwrap_or(&last);
            self.faults.last = format!("{}: {last}", name(server.instance));
            self.incidents
                .push(Incident::of(server.instance, IncidentKind::Fault, last.into()));
        }
    }

    /// Checks that environments have not returned something invalid too often.
    ///
    /// # Errors
    /// When they have, with the last invalid answer.
    pub(crate) fn check_faults(&self) -> anyhow::Result<()> {
        let Faults { count, most, last } = &self.faults;
        if count < most {
            return Ok(());
        }
        bail!(
            "the environments returned something invalid {count} times, and environment.faults is {most}: correct the \
             environment, or raise environment.faults; the last time: {last}"
        );
    }
}
