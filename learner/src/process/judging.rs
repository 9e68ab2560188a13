//! Waiting for the evaluator: in lockstep for each period's policy, in a free run for the last one.

use std::time::{Duration, Instant};

use shoal_common::channel::reports::Reports;
use shoal_common::channel::{ChannelError, wait_for};
use shoal_common::exit::Exit;
use shoal_common::report::{Activity, JudgedReport};

use super::learner::Learner;
use super::settings::LearnerError;

/// What is known of the evaluator's work.
pub(crate) struct Judging {
    reports: Reports<JudgedReport>,
    /// The period of the policy judged last.
    judged: Option<u64>,
}

impl Judging {
    pub(crate) fn new(learner: &Learner<'_>) -> Result<Self, LearnerError> {
        Ok(Self {
            reports: Reports::open(learner.domain)?,
            judged: learner.settings.judged,
        })
    }

    /// Waits until a policy of this period is judged, the one just published if none was before, but no longer than
    /// `patience`. An evaluator that dies over it has a successor, which is given the same policy.
    pub(crate) fn wait(
        &mut self,
        learner: &mut Learner<'_>,
        patience: Option<Duration>,
    ) -> Result<(), Exit<LearnerError>> {
        let due = Some(learner.settings.config.evaluation.period(learner.rows));
        let Learner {
            bell,
            stop,
            publisher,
            pulse,
            ..
        } = learner;
        if self.judged >= due {
            return Ok(());
        }
        let begun = Instant::now();
        let waited = wait_for(
            bell,
            stop,
            || -> Result<Option<()>, ChannelError> {
                while let Some(report) = self.reports.receive()? {
                    self.judged = self.judged.max(Some(report.period));
                }
                let waited = patience.is_some_and(|patience| begun.elapsed() >= patience);
                Ok((self.judged >= due || waited).then_some(()))
            },
            || {
                pulse.beat(Activity::WaitingForPeer);
                publisher.look_after()
            },
        );
        waited.map_err(Exit::widen)
    }
}
