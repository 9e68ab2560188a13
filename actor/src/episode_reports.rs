//! What an actor reports about the episodes that end.

use std::time::{Duration, Instant};

use shoal_common::channel::reports::{Report, Reporter};
use shoal_common::channel::{ChannelError, Domain};
use shoal_common::report::EpisodeReport;

/// The span of the limit on reports: in it, an actor reports at most half as many episodes as their channel holds. The
/// launcher reads the channel at least twice in this time, so no report is lost.
const REPORT_SPAN: Duration = Duration::from_millis(40);

/// The episodes that end in the chunk that is being filled. They are reported when it is sent.
pub(crate) struct EpisodeReports {
    reporter: Reporter<EpisodeReport>,
    ended: Vec<EpisodeReport>,
    /// When the current [`REPORT_SPAN`] began.
    since: Instant,
    /// The episodes reported in it.
    sent: usize,
}

impl EpisodeReports {
    /// Opens the sending end.
    pub(crate) fn open(domain: &Domain) -> Result<Self, ChannelError> {
        Ok(Self {
            reporter: Reporter::open(domain)?,
            ended: Vec::new(),
            since: Instant::now(),
            sent: 0,
        })
    }

    /// Adds an episode that has ended.
    pub(crate) fn push(&mut self, episode: EpisodeReport) {
        self.ended.push(episode);
    }

    /// Drops the episodes that have not been reported.
    pub(crate) fn clear(&mut self) {
        self.ended.clear();
    }

    /// Whether an episode has ended that has not been reported.
    pub(crate) fn has_ended(&self) -> bool {
        !self.ended.is_empty()
    }

    /// Reports the episodes that have ended.
    pub(crate) fn send(&mut self) {
        for episode in self.ended.drain(..) {
            if self.since.elapsed() >= REPORT_SPAN {
                (self.since, self.sent) = (Instant::now(), 0);
            } else if self.sent == EpisodeReport::BUFFER / 2 {
                // The launcher must have read these: a full channel loses its oldest reports.
                std::thread::sleep(REPORT_SPAN);
                (self.since, self.sent) = (Instant::now(), 0);
            }
            self.sent += 1;
            self.reporter.send(episode);
        }
    }
}
