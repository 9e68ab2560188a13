//! The end of the processes, at the end of a run.

use anyhow::bail;
use shoal_common::role::Role;
use shoal_run::records::recorder::{Incident, IncidentKind};

use super::Supervisor;
use crate::launcher::log::ALL_ENDED;
use crate::launcher::process::{describe_exit, name};

impl Supervisor {
    /// Asks the processes of a role to hand over what they have and then to end.
    pub(crate) fn ask_to_retire(&mut self, role: Role) {
        for supervised in self.roles.iter_mut().filter(|it| it.instance.role == role) {
            if let Some(process) = &mut supervised.process {
                supervised.is_asked_to_end = true;
                process.ask_to_retire();
            }
        }
    }

    /// Asks the processes of some roles to end.
    pub(crate) fn ask_to_end(&mut self, which: impl Fn(Role) -> bool) {
        for supervised in self.roles.iter_mut().filter(|it| which(it.instance.role)) {
            match &mut supervised.process {
                Some(process) => {
                    supervised.is_asked_to_end = true;
                    process.ask_to_end();
                }
                None if supervised.instance.role == Role::Learner && !self.learner_done => {
                    self.unsaved_learner = Some("it had died and was not restarted yet".into());
                }
                None => {}
            }
        }
    }

    /// Collects the exit statuses of some roles' processes. Returns whether all of them have ended.
    pub(crate) fn reap(&mut self, which: impl Fn(Role) -> bool) -> bool {
        let mut all = true;
        for supervised in self.roles.iter_mut().filter(|it| which(it.instance.role)) {
            let Some(process) = &mut supervised.process else {
                continue;
            };
            match process.exit_status() {
                Some(status) => {
                    (supervised.process, supervised.ended) = (None, Some(status));
                    if supervised.instance.role == Role::Learner {
                        self.learner_done = status.success();
                        self.unsaved_learner = (!status.success()).then(|| describe_exit(status));
                    }
                }
                None => all = false,
            }
        }
        all
    }

    /// Whether the only process of a role has ended by itself, and not in order.
    pub(crate) fn has_failed(&self, role: Role) -> bool {
        let mut roles = self.roles.iter();
        let ended = roles.find(|it| it.is(role, 0)).and_then(|it| it.ended);
        ended.is_some_and(|status| !status.success())
    }

    /// Kills the processes of some roles. `why` says what they did, as in "did not end when asked to".
    pub(crate) fn kill(&mut self, which: impl Fn(Role) -> bool, why: &str) {
        for supervised in self.roles.iter_mut().filter(|it| which(it.instance.role)) {
            if supervised.process.take().is_some() {
                let name = name(supervised.instance);
                self.log.note(&name, &format!("{why}, and was killed"));
                self.incidents
                    .push(Incident::of(supervised.instance, IncidentKind::Killed, why.into()));
                if supervised.instance.role == Role::Learner {
                    self.unsaved_learner = Some(format!("it {why}, and was killed"));
                }
            }
        }
    }

    /// Logs that every role has ended.
    ///
    /// # Errors
    /// When the learner did not save its state before it ended.
    pub(crate) fn check_saved(&self) -> anyhow::Result<()> {
        self.log.note("launcher", ALL_ENDED);
        let Some(how) = &self.unsaved_learner else {
            return Ok(());
        };
        let learner = self.learner().map(|learner| name(learner.instance));
        let lines = learner.map_or_else(Vec::new, |learner| self.log.last_lines(&learner));
        let message = lines.last().map_or_else(String::new, |line| format!(": {line}"));
        bail!(
            "the learner did not save its last state ({how}){message}; `shoal resume {}` continues from the newest \
             checkpoint",
            self.run.display()
        );
    }
}
