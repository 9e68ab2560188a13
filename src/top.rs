//! What `shoal top` knows and shows of a run. The terminal itself, and its keys, are `command/top.rs`'s.

mod link;
mod view;

use std::collections::VecDeque;

pub(crate) use link::{Link, News, Order};
use shoal_common::channel::control::RunStatus;
pub(crate) use view::draw;

/// Looks that the throughput is kept of.
const KEPT: usize = 240;

/// Looks that a notice stays for.
const NOTICED: u8 = 4;

/// Whether the run lives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Life {
    /// Nothing is known yet.
    Unknown,
    /// Its launcher answers.
    Running,
    /// There is a launcher, and it does not answer: why.
    Silent(String),
    /// There is no launcher any more.
    Ended,
}

/// What lies over the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Over {
    /// Nothing.
    Nothing,
    /// What the keys do.
    Help,
    /// Whether the run is to be stopped.
    Stop,
}

/// Everything that is drawn.
#[derive(Clone, Debug)]
pub(crate) struct Screen {
    /// The run's directory, as it was typed.
    pub(crate) run: String,
    /// Environment, method and mode.
    pub(crate) task: String,
    pub(crate) life: Life,
    pub(crate) status: RunStatus,
    /// Environment steps and mean return of every evaluation.
    pub(crate) evaluations: Vec<(f64, f64)>,
    /// Updates a second, one for each look; the newest last.
    pub(crate) throughput: VecDeque<u64>,
    pub(crate) over: Over,
    /// What came of the last key, for a few looks.
    pub(crate) notice: Option<String>,
    looks_since: u8,
    /// The actors that were asked for and are not confirmed yet.
    pub(crate) wanted: Option<u32>,
    /// Whether colours are welcome.
    pub(crate) colours: bool,
}

impl Screen {
    /// Before anything is heard.
    pub(crate) fn new(run: String, task: String, colours: bool) -> Self {
        Self {
            run,
            task,
            life: Life::Unknown,
            status: RunStatus::default(),
            evaluations: Vec::new(),
            throughput: VecDeque::new(),
            over: Over::Nothing,
            notice: None,
            looks_since: 0,
            wanted: None,
            colours,
        }
    }

    /// Takes in what was heard of the run.
    pub(crate) fn hear(&mut self, news: News) {
        match news {
            News::Running(status, evaluations) => {
                if self.throughput.len() == KEPT {
                    self.throughput.pop_front();
                }
                self.throughput.push_back(status.updates_per_second.max(0.0) as u64);
                if self.wanted == Some(status.actors) {
                    self.wanted = None;
                }
                self.looks_since = self.looks_since.saturating_add(1);
                if self.looks_since > NOTICED {
                    self.notice = None;
                }
                self.life = Life::Running;
                (self.status, self.evaluations) = (*status, evaluations);
            }
            News::Ended(status, evaluations) => {
                self.life = Life::Ended;
                (self.status, self.evaluations) = (*status, evaluations);
                self.over = Over::Nothing;
                self.notice = None;
            }
            News::Silent(why) => self.life = Life::Silent(why),
            News::Answered(words) => {
                self.wanted = None;
                self.say(words);
            }
        }
    }

    /// Takes in a key; gives what is to be asked of the run, if anything.
    pub(crate) fn press(&mut self, key: char) -> Option<Order> {
        let over = std::mem::replace(&mut self.over, Over::Nothing);
        match (over, key) {
            (Over::Stop, 'y') => {
                self.say("stopping: the learner saves its state".into());
                return Some(Order::Stop);
            }
            (Over::Stop | Over::Help, _) => {}
            (Over::Nothing, '?') => self.over = Over::Help,
            // A launcher that is silent may hear it all the same, or be busy for a moment only.
            (Over::Nothing, 's' | '+' | '=' | '-') if matches!(self.life, Life::Unknown | Life::Ended) => {
                self.say("nothing runs that could be scaled or stopped".into());
            }
            (Over::Nothing, 's') => self.over = Over::Stop,
            (Over::Nothing, '+' | '=') => return Some(self.scale(1)),
            (Over::Nothing, '-') => return Some(self.scale(-1)),
            (Over::Nothing, _) => {}
        }
        None
    }

    fn say(&mut self, words: String) {
        (self.notice, self.looks_since) = (Some(words), 0);
    }

    fn scale(&mut self, by: i32) -> Order {
        let now = self.wanted.unwrap_or(self.status.actors);
        let wanted = now.saturating_add_signed(by);
        self.wanted = Some(wanted);
        self.say(format!("asking for {wanted} actors"));
        Order::Scale(wanted)
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
        screen.hear(News::Running(Box::new(status), Vec::new()));
        screen
    }

    #[test]
    fn two_presses_ask_for_two_actors_more() {
        let mut screen = running(2);
        assert_eq!(screen.press('+'), Some(Order::Scale(3)));
        assert_eq!(screen.press('+'), Some(Order::Scale(4)));
        assert_eq!(screen.press('-'), Some(Order::Scale(3)));
        screen.hear(News::Answered("no room".into()));
        assert_eq!(screen.press('-'), Some(Order::Scale(1)), "a refusal counts for nothing");
    }

    #[test]
    fn a_run_is_stopped_only_after_a_yes() {
        let mut screen = running(1);
        assert_eq!((screen.press('s'), screen.over), (None, Over::Stop));
        assert_eq!((screen.press('n'), screen.over), (None, Over::Nothing));
        assert_eq!(screen.press('y'), None);
        screen.press('s');
        assert_eq!(screen.press('y'), Some(Order::Stop));
    }

    #[test]
    fn a_run_whose_launcher_is_silent_can_still_be_asked() {
        let mut screen = running(1);
        screen.hear(News::Silent("no answer".into()));
        assert_eq!(screen.press('+'), Some(Order::Scale(2)));
        screen.press('s');
        assert_eq!(screen.press('y'), Some(Order::Stop));
    }

    #[test]
    fn what_has_ended_is_neither_scaled_nor_stopped() {
        let mut screen = running(1);
        screen.hear(News::Ended(Box::default(), Vec::new()));
        for key in ['+', '-', 's'] {
            assert_eq!(screen.press(key), None);
            assert_eq!(screen.over, Over::Nothing);
        }
    }
}
