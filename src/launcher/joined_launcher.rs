//! The launcher of a joined host: starts a relay, actors and environment servers, and watches them.

use std::time::{Duration, Instant};

use anyhow::bail;
use shoal_common::channel::Domain;
use shoal_common::channel::control::{ControlPort, ControlRequest, ControlResponse, JoinAgain, RunStatus};
use shoal_common::channel::reports::Reports;
use shoal_common::config::Config;
use shoal_common::message::one_line;
use shoal_common::report::Heartbeat;
use shoal_common::role::{Activity, Role};
use shoal_common::run_dir::LockedRun;
use shoal_run::preflight;
use shoal_run::signals::{self, Signals};

use super::end_roles::{EndRequest, EndRoles};
use super::log::Log;
use super::stall::StallDetector;
use super::supervisor::{RunCondition, SupervisedHost, Supervisor};
use super::{OTHERS_END_TIMEOUT, write_iox_config};

/// How often heartbeats are read if nothing wakes the launcher.
const TICK: Duration = Duration::from_millis(100);

/// How long actors may take to hand over what they have.
const ACTORS_HAND_OVER_TIMEOUT: Duration = Duration::from_secs(6);

/// How the work for another host's run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum JoinEnd {
    /// The run is over.
    Over,
    /// The run could not be reached, or did not admit this host again, for too long.
    GaveUp,
    /// The host must join again.
    JoinAgain(JoinAgain),
    /// The run listens at another endpoint now.
    Moved,
    /// `shoal stop` ended it.
    Stopped,
    /// This signal ended it.
    Interrupted(i32),
}

/// What a joined host does when its relay starts, and how it learns what the relay cannot hear.
pub(crate) struct JoinEvents<'a> {
    /// Called after the relay's first heartbeat. If there is none, it is dropped without being called.
    pub(crate) on_relay_ready: Box<dyn FnOnce() + 'a>,
    /// Asked whether the run is over while the relay has no connection.
    pub(crate) run_is_over: Box<dyn Fn() -> bool + 'a>,
    /// Asked whether the run listens at another endpoint, while the relay has no connection.
    pub(crate) run_has_moved: Box<dyn Fn() -> bool + 'a>,
}

/// Works for the run, and returns how that ended. `config` and `run` are those of this host.
pub(crate) fn run(
    config: Config,
    run: &LockedRun,
    signals: &Signals,
    actors: Vec<u32>,
    give_up: Duration,
    events: JoinEvents<'_>,
) -> anyhow::Result<JoinEnd> {
    Domain::remove_abandoned()?;
    let domain = Domain::join(&config.run.id, config.actors.max_on_a_host())?;
    let ending = preflight::reserve_for_host(&config, &domain)
        .and_then(|()| JoinedLauncher::new(config, run, &domain, signals, actors))
        .and_then(|launcher| launcher.run(give_up, events));
    // Also after an error: no role is left by now.
    let left = domain.leave();
    let ending = ending?;
    left?;
    Ok(ending)
}

struct JoinedLauncher<'a> {
    config: Config,
    run: &'a LockedRun,
    domain: &'a Domain,
    control: ControlPort,
    supervisor: Supervisor,
    signals: &'a Signals,
    stalls: StallDetector,
    log: Log,
    heartbeats: Reports<Heartbeat>,
    /// The first request to end the work.
    end_request: Option<EndRequest<JoinEnd>>,
    join_again: Option<JoinAgain>,
    /// Since when the relay has had no connection.
    cut_off_since: Option<Instant>,
}

impl<'a> JoinedLauncher<'a> {
    fn new(
        config: Config,
        run: &'a LockedRun,
        domain: &'a Domain,
        signals: &'a Signals,
        actors: Vec<u32>,
    ) -> anyhow::Result<Self> {
        let log = Log::open(&run.log())?;
        write_iox_config(domain, run)?;
        // Creates the services that are opened below.
        let supervisor = Supervisor::new(&config, run, domain, log.clone(), SupervisedHost::Joined { actors })?;
        Ok(Self {
            control: ControlPort::open(domain, config.actors.max)?,
            heartbeats: Reports::open(domain)?,
            stalls: StallDetector::of_joined_host(Duration::from_secs(config.run.stall_seconds)),
            supervisor,
            run,
            domain,
            signals,
            log,
            config,
            end_request: None,
            join_again: None,
            cut_off_since: None,
        })
    }

    fn run(mut self, give_up: Duration, events: JoinEvents<'_>) -> anyhow::Result<JoinEnd> {
        let JoinEvents {
            on_relay_ready,
            run_is_over,
            run_has_moved,
        } = events;
        // Kept until the end of this function: dropping it gives the host's actors back, and a relay that starts
        // meanwhile still needs them.
        let mut on_relay_ready = Some(on_relay_ready);
        let ending = self.watch(give_up, &mut on_relay_ready, (&run_is_over, &run_has_moved));
        // The roles are ended in every case, also after an error. The relay stays while actors hand over what they
        // have. If the run is over, they try only briefly: its learner accepts no more than it needs.
        match ending {
            Ok(JoinEnd::Over | JoinEnd::GaveUp | JoinEnd::Moved | JoinEnd::JoinAgain(JoinAgain::LostActors)) => {
                self.supervisor.ask_to_end(|role| role == Role::Actor)
            }
            _ => self.supervisor.ask_to_retire(Role::Actor),
        }
        let hands_over = matches!(
            ending,
            Ok(JoinEnd::JoinAgain(JoinAgain::Scaled(_)) | JoinEnd::Stopped | JoinEnd::Interrupted(_))
        );
        self.await_end(
            |role| role == Role::Actor,
            ACTORS_HAND_OVER_TIMEOUT,
            hands_over.then_some(Role::Relay),
        );
        self.supervisor.ask_to_end(|_| true);
        self.await_end(|_| true, OTHERS_END_TIMEOUT, None);
        self.control.answer_waiting(&ControlResponse::Accepted);
        let ending = match (ending, &self.end_request) {
            // The request came while the actors handed over what they had.
            (Ok(JoinEnd::JoinAgain(_) | JoinEnd::Moved), Some(request)) => Ok(request.end),
            (ending, _) => ending,
        };
        if let Err(error) = &ending {
            self.log.note("launcher", &one_line(error));
        }
        ending
    }

    fn watch(
        &mut self,
        give_up: Duration,
        on_relay_ready: &mut Option<Box<dyn FnOnce() + '_>>,
        (run_is_over, run_has_moved): (&dyn Fn() -> bool, &dyn Fn() -> bool),
    ) -> anyhow::Result<JoinEnd> {
        self.supervisor.start_all(self.domain)?;
        loop {
            if let Some(signal) = self.signals.received()
                && self.end_request.is_none()
            {
                let what = format!("{} ends the work for the run", signals::describe(signal));
                self.log.note("launcher", &what);
                self.end_request = Some(EndRequest::new(JoinEnd::Interrupted(signal)));
            }
            self.run.check()?;
            self.read_heartbeats()?;
            self.answer_requests()?;
            let condition = match (self.supervisor.maintain(self.domain), self.end_request) {
                // A host that is about to end needs no role that cannot work.
                (Err(_), Some(request)) => return Ok(request.end),
                (condition, _) => condition?,
            };
            match condition {
                RunCondition::AtWork => {}
                RunCondition::SharedMemoryOccupied | RunCondition::FilesRemoved if self.end_request.is_some() => {}
                RunCondition::LearnerDone => bail!("a learner has ended on a host that has none"),
                RunCondition::SharedMemoryOccupied => {
                    bail!("dead processes occupy shared memory permanently: join again")
                }
                RunCondition::FilesRemoved => bail!(
                    "another program has removed files of this host in {}: join again",
                    self.domain.directory()?.display()
                ),
            }
            self.supervisor.check_progress(&mut self.stalls);
            if let Some(request) = self.end_request
                && request.may_begin(&self.supervisor, Role::Relay)
            {
                return Ok(request.end);
            }
            if let (Some(why), None) = (self.join_again, &self.end_request) {
                return Ok(JoinEnd::JoinAgain(why));
            }
            let activity = self.supervisor.activity(Role::Relay);
            if let Some(on_relay_ready) = on_relay_ready.take_if(|_| activity.is_some()) {
                on_relay_ready();
            }
            match activity {
                Some(Activity::Done) => return Ok(JoinEnd::Over),
                Some(Activity::Working) => self.cut_off_since = None,
                _ if run_is_over() => return Ok(JoinEnd::Over),
                _ if run_has_moved() => return Ok(JoinEnd::Moved),
                _ => {
                    let since = self.cut_off_since.get_or_insert_with(Instant::now);
                    if since.elapsed() >= give_up && self.end_request.is_none() {
                        return Ok(JoinEnd::GaveUp);
                    }
                }
            }
            self.sleep(TICK.min(self.supervisor.time_to_next_task()));
        }
    }

    fn read_heartbeats(&mut self) -> anyhow::Result<()> {
        while let Some(heartbeat) = self.heartbeats.receive()? {
            self.supervisor.record(&heartbeat);
        }
        // The learner's host keeps the records.
        self.supervisor.take_incidents();
        self.supervisor.check_faults()
    }
}

impl EndRoles for JoinedLauncher<'_> {
    fn parts(&mut self) -> (&mut Supervisor, &Domain) {
        (&mut self.supervisor, self.domain)
    }

    fn answer_requests(&mut self) -> anyhow::Result<()> {
        let Self {
            control,
            run,
            supervisor,
            end_request,
            join_again,
            config,
            ..
        } = self;
        control.answer_requests(run.id(), run.path(), |request| {
            Ok::<_, anyhow::Error>(match request {
                ControlRequest::Status => Some(ControlResponse::Status(RunStatus {
                    roles: supervisor.status(0),
                    actors: supervisor.actor_count(),
                    steps: config.run.steps,
                    ..RunStatus::default()
                })),
                ControlRequest::Stop => {
                    end_request.get_or_insert_with(|| EndRequest::new(JoinEnd::Stopped));
                    None
                }
                ControlRequest::Replace { actor, incarnation } => {
                    supervisor.replace_actor(actor, incarnation);
                    Some(ControlResponse::Accepted)
                }
                ControlRequest::JoinAgain(why) => {
                    *join_again = Some(why);
                    Some(ControlResponse::Accepted)
                }
                ControlRequest::Scale(_) | ControlRequest::Admit(_) | ControlRequest::Hosts(_) => {
                    let why = "this is a joined host: ask on the learner's host";
                    Some(ControlResponse::Refused(why.into()))
                }
            })
        })
    }

    fn sleep(&mut self, most: Duration) {
        self.supervisor.sleep(self.signals, &self.control, most);
    }
}
