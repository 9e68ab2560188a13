//! The state and the view of `shoal top`. `command/top.rs` handles the terminal and its keys.

mod keys;
mod link;
mod view;

use std::collections::VecDeque;

pub(crate) use keys::{Key, keys};
pub(crate) use link::{LauncherLink, Request, RunEvent};
use shoal_common::channel::control::RunStatus;
pub(crate) use view::draw;

/// Number of polls whose throughput is kept.
const KEPT: usize = 240;

/// Number of polls for which a notice is shown.
const NOTICE_POLLS: u8 = 4;

/// The state of the run's launcher.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum LauncherState {
    /// Not known yet.
    Unknown,
    /// It answers.
    Running,
    /// It exists but does not answer, for this reason.
    Silent(String),
    /// It has ended.
    Ended,
}

/// A box shown over the screen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Overlay {
    /// No box.
    Nothing,
    /// The list of keys.
    Help,
    /// The question whether to stop the run.
    Stop,
}

/// Everything that is drawn.
#[derive(Clone, Debug)]
pub(crate) struct Screen {
    /// The run's directory, as given by the user.
    pub(crate) run: String,
    /// Environment, algorithm and mode.
    pub(crate) task: String,
    pub(crate) launcher: LauncherState,
    pub(crate) status: RunStatus,
    /// Environment steps and mean return of every evaluation.
    pub(crate) evaluations: Vec<(f64, f64)>,
    /// Updates per second at each poll, the newest last.
    pub(crate) throughput: VecDeque<u64>,
    pub(crate) overlay: Overlay,
    /// The result of the last key, shown for a few polls.
    pub(crate) notice: Option<String>,
    polls_since: u8,
    /// The number of actors that was requested and is not confirmed yet.
    pub(crate) wanted: Option<u32>,
    /// Whether to use colours.
    pub(crate) colours: bool,
}

impl Screen {
    /// The screen before the first event.
    pub(crate) fn new(run: String, task: String, colours: bool) -> Self {
        Self {
            run,
            task,
            launcher: LauncherState::Unknown,
            status: RunStatus::default(),
            evaluations: Vec::new(),
            throughput: VecDeque::new(),
            overlay: Overlay::Nothing,
            notice: None,
            polls_since: 0,
            wanted: None,
            colours,
        }
    }

    /// Applies an event.
    pub(crate) fn handle(&mut self, event: RunEvent) {
        match event {
            RunEvent::Running(status, evaluations) => {
                if self.throughput.len() == KEPT {
                    self.throughput.pop_front();
                }
                self.throughput.push_back(status.updates_per_second.max(0.0) as u64);
                if self.wanted == Some(status.actors) {
                    self.wanted = None;
                }
                self.polls_since = self.polls_since.saturating_add(1);
                if self.polls_since > NOTICE_POLLS {
                    self.notice = None;
                }
                self.launcher = LauncherState::Running;
                (self.status, self.evaluations) = (*status, evaluations);
            }
            RunEvent::Ended(status, evaluations) => {
                self.launcher = LauncherState::Ended;
                (self.status, self.evaluations) = (*status, evaluations);
                self.overlay = Overlay::Nothing;
                self.notice = None;
            }
            RunEvent::Silent(why) => self.launcher = LauncherState::Silent(why),
            RunEvent::Answered(text) => {
                self.wanted = None;
                self.set_notice(text);
            }
        }
    }

    /// Handles a key; returns the request to send, if any.
    pub(crate) fn press(&mut self, key: char) -> Option<Request> {
        let overlay = std::mem::replace(&mut self.overlay, Overlay::Nothing);
        match (overlay, key) {
            (Overlay::Stop, 'y') => {
                self.set_notice("stopping: the learner saves its state".into());
                return Some(Request::Stop);
            }
            (Overlay::Stop | Overlay::Help, _) => {}
            (Overlay::Nothing, '?') => self.overlay = Overlay::Help,
            // A silent launcher can still be asked: it may only be busy for a moment.
            (Overlay::Nothing, 's' | '+' | '=' | '-')
                if matches!(self.launcher, LauncherState::Unknown | LauncherState::Ended) =>
            {
                self.set_notice("the run is not running: it cannot be scaled or stopped".into());
            }
            (Overlay::Nothing, 's') => self.overlay = Overlay::Stop,
            (Overlay::Nothing, '+' | '=') => return Some(self.scale(1)),
            (Overlay::Nothing, '-') => return Some(self.scale(-1)),
            (Overlay::Nothing, _) => {}
        }
        None
    }

    fn set_notice(&mut self, text: String) {
        (self.notice, self.polls_since) = (Some(text), 0);
    }

    fn scale(&mut self, by: i32) -> Request {
        let now = self.wanted.unwrap_or(self.status.actors);
        let wanted = now.saturating_add_signed(by);
        self.wanted = Some(wanted);
        self.set_notice(format!("requesting {wanted} actors"));
        Request::Scale(wanted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn running(actors: u32) -> Screen {
        let mut screen = Screen::new("run".into(), "pendulum".into(), false);
        let status = RunStatus {
            actors,
            ..RunStatus::default()
        };
        screen.handle(RunEvent::Running(Box::new(status), Vec::new()));
        screen
    }

    #[test]
    fn two_key_presses_request_two_more_actors() {
        let mut screen = running(2);
        assert_eq!(screen.press('+'), Some(Request::Scale(3)));
        assert_eq!(screen.press('+'), Some(Request::Scale(4)));
        assert_eq!(screen.press('-'), Some(Request::Scale(3)));
        screen.handle(RunEvent::Answered("refused".into()));
        assert_eq!(
            screen.press('-'),
            Some(Request::Scale(1)),
            "a refused request does not count"
        );
    }

    #[test]
    fn a_run_is_stopped_only_after_confirmation() {
        let mut screen = running(1);
        assert_eq!((screen.press('s'), screen.overlay), (None, Overlay::Stop));
        assert_eq!((screen.press('n'), screen.overlay), (None, Overlay::Nothing));
        assert_eq!(screen.press('y'), None);
        screen.press('s');
        assert_eq!(screen.press('y'), Some(Request::Stop));
    }

    #[test]
    fn a_silent_launcher_can_still_be_asked() {
        let mut screen = running(1);
        screen.handle(RunEvent::Silent("no answer".into()));
        assert_eq!(screen.press('+'), Some(Request::Scale(2)));
        screen.press('s');
        assert_eq!(screen.press('y'), Some(Request::Stop));
    }

    #[test]
    fn an_ended_run_is_neither_scaled_nor_stopped() {
        let mut screen = running(1);
        screen.handle(RunEvent::Ended(Box::default(), Vec::new()));
        for key in ['+', '-', 's'] {
            assert_eq!(screen.press(key), None);
            assert_eq!(screen.overlay, Overlay::Nothing);
        }
    }
}
