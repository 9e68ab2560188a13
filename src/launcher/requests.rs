//! The launcher's answers to requests from other terminals.

use shoal_common::channel::control::{ControlResponse, RunStatus, ScaleRequest};
use shoal_common::commit::OpenError;
use shoal_common::config::{Config, Mode};
use shoal_common::role::{Activity, Role};
use shoal_common::run_dir::RunDir;
use shoal_run::records::recorder::Moment;
use shoal_run::{plan, status};

use super::progress::ProgressLine;
use super::shares::shares;
use super::supervisor::Supervisor;

/// The run's status. `initial` is its status when the launcher started.
pub(super) fn status(
    config: &Config,
    run: &RunDir,
    supervisor: &Supervisor,
    progress: &ProgressLine,
    initial: &RunStatus,
) -> Result<RunStatus, OpenError> {
    let mut status = RunStatus {
        replay_rows: status::replay_rows(run)?,
        actors: supervisor.actor_count(),
        ..initial.clone()
    };
    if let Some(learner) = progress.learner() {
        status.env_steps = learner.env_steps;
        status.episodes = learner.episodes;
        status.updates = learner.updates;
        status.policy_version = learner.policy_version;
        status.ratio = config.replay.ratio(status.updates, status.env_steps).unwrap_or(0.0);
    }
    (status.updates_per_second, status.env_steps_per_second) = progress.rates().unwrap_or_default();
    if let Some(report) = progress.evaluated() {
        status.eval_return_mean = Some(report.return_mean);
    }
    status.roles = supervisor.status(status.policy_version);
    status.hosts = supervisor.joined_hosts();
    status.waiting = waiting(supervisor).map(|who| {
        let (ratio, configured) = (status.ratio, status.updates_per_step);
        format!("{who}: ratio {ratio:.2} of {configured:.2}")
    });
    Ok(status)
}

/// Changes the numbers of actors. That of this host is also stored for `resume`, with the moment `now`.
pub(super) fn scale(
    config: &mut Config,
    run: &RunDir,
    supervisor: &mut Supervisor,
    request: &ScaleRequest,
    now: Moment,
) -> anyhow::Result<ControlResponse> {
    if config.run.mode == Mode::Lockstep {
        let reason = "the number of actors of a lockstep run cannot change: its results depend on it";
        return Ok(ControlResponse::Refused(reason.into()));
    }
    let shares = match shares(request, &supervisor.actor_hosts(), config.actors.max) {
        Ok(shares) => shares,
        Err(reason) => return Ok(ControlResponse::Refused(reason)),
    };
    let here = shares.first().copied().unwrap_or_default();
    // Before the actors start, so that a learner that is started now reads the new number.
    match plan::store_actors(run, config, here, now) {
        Ok(scaled) => *config = scaled,
        Err(error) => return Ok(ControlResponse::Refused(format!("{error:#}"))),
    }
    supervisor.scale(&shares);
    let total = shares.iter().sum();
    Ok(ControlResponse::Scaled { here, total })
}

/// Who waits for whom, in words, by the last heartbeats of actors and learner.
pub(super) fn waiting(supervisor: &Supervisor) -> Option<&'static str> {
    match (supervisor.activity(Role::Actor), supervisor.activity(Role::Learner)) {
        (Some(Activity::WaitingForRatio), _) => Some("actors wait"),
        (_, Some(Activity::WaitingForRatio)) => Some("learner waits"),
        (_, Some(Activity::WaitingForPeer)) => Some("learner waits for rows"),
        (Some(Activity::WaitingForPeer), _) => Some("actors wait for a policy"),
        _ => None,
    }
}
