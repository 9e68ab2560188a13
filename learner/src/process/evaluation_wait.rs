//! Waiting for the evaluator: in lockstep for each period's policy, in a free run for the last one.

use std::time::{Duration, Instant};

use shoal_common::channel::reports::Reports;
use shoal_common::channel::{ChannelError, wait_for};
use shoal_common::exit::Exit;
use shoal_common::report::EvaluatedPeriod;
use shoal_common::role::Activity;

use super::error::LearnerError;
use super::learner::Learner;

/// The evaluator's progress, as far as the learner knows it.
pub(crate) struct EvaluationWait {
    reports: Reports<EvaluatedPeriod>,
    /// The period of the policy evaluated last.
    evaluated_period: Option<u64>,
}

impl EvaluationWait {
    pub(crate) fn new(learner: &Learner<'_>) -> Result<Self, LearnerError> {
        Ok(Self {
            reports: Reports::open(learner.domain)?,
            evaluated_period: learner.settings.evaluated_period,
        })
    }

    /// Waits until a policy of the current period has been evaluated, but no longer than `timeout`. If none has been,
    /// the evaluator evaluates the policy just published. If the evaluator dies during the evaluation, its successor
    /// evaluates the same policy.
    pub(crate) fn wait(
        &mut self,
        learner: &mut Learner<'_>,
        timeout: Option<Duration>,
    ) -> Result<(), Exit<LearnerError>> {
        let due = Some(learner.settings.config.evaluation.period(learner.env_steps));
        let Learner {
            listener,
            stop,
            publisher,
            heartbeat,
            ..
        } = learner;
        if self.evaluated_period >= due {
            return Ok(());
        }
        let begun = Instant::now();
        let waited = wait_for(
            listener,
            stop,
            || -> Result<Option<()>, ChannelError> {
                while let Some(report) = self.reports.receive()? {
                    self.evaluated_period = self.evaluated_period.max(Some(report.period));
                }
                let timed_out = timeout.is_some_and(|timeout| begun.elapsed() >= timeout);
                Ok((self.evaluated_period >= due || timed_out).then_some(()))
            },
            || {
                heartbeat.beat(Activity::WaitingForPeer);
                publisher.refresh_connections()
            },
        );
        waited.map_err(Exit::convert)
    }
}
