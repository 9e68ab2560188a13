//! The way to the run's launcher, on a thread of its own: an answer that takes its time keeps no key waiting.

use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::Context;
use shoal_common::channel::control::RunStatus;
use shoal_run::recorder::read_evaluations;
use shoal_run::remote::Remote;
use shoal_run::status::at_rest;

/// From one look to the next.
const EVERY: Duration = Duration::from_secs(1);

/// How long a look that is under way may take to end when nobody wants to know any more.
const FAREWELL: Duration = Duration::from_secs(1);

/// What can be asked of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Order {
    /// Go on with so many actors.
    Scale(u32),
    /// End in order.
    Stop,
}

/// What is heard of the run. The numbers are the environment steps and mean returns of its evaluations.
#[derive(Clone, Debug)]
pub(crate) enum News {
    Running(Box<RunStatus>, Vec<(f64, f64)>),
    Ended(Box<RunStatus>, Vec<(f64, f64)>),
    /// The launcher did not answer, and why.
    Silent(String),
    /// What came of an order.
    Answered(String),
}

/// The thread that looks after the run about once a second.
#[derive(Debug)]
pub(crate) struct Link {
    orders: Option<Sender<Order>>,
    news: Receiver<News>,
    thread: JoinHandle<()>,
}

impl Link {
    /// Begins to look.
    ///
    /// # Errors
    /// When there can be no thread.
    pub(crate) fn new(remote: Remote) -> anyhow::Result<Self> {
        let (orders, to_do) = channel();
        let (told, news) = channel();
        let thread = thread::Builder::new()
            .name("look".into())
            .spawn(move || look_on(&remote, &to_do, &told))
            .context("cannot start a thread")?;
        Ok(Self {
            orders: Some(orders),
            news,
            thread,
        })
    }

    /// Has something asked of the run; what comes of it is news.
    pub(crate) fn order(&self, order: Order) {
        // Without the thread the next look at the news says so.
        let _ = self.orders.as_ref().map(|orders| orders.send(order));
    }

    /// What was heard since the last call.
    ///
    /// # Errors
    /// When the thread has ended.
    pub(crate) fn heard(&self) -> anyhow::Result<Vec<News>> {
        let news = self.news.try_iter().collect();
        anyhow::ensure!(
            !self.thread.is_finished(),
            "whoever looked after the run has failed; start again"
        );
        Ok(news)
    }

    /// Ends the thread, unless it waits for an answer for too long: the run's launcher cleans up after it then.
    pub(crate) fn close(mut self) {
        self.orders = None;
        let asked = Instant::now();
        while !self.thread.is_finished() && asked.elapsed() < FAREWELL {
            thread::sleep(Duration::from_millis(5));
        }
    }
}

fn look_on(remote: &Remote, orders: &Receiver<Order>, told: &Sender<News>) {
    let mut ended = false;
    loop {
        let news = look(remote, ended);
        ended = matches!(news, Some(News::Ended(..))) || (ended && news.is_none());
        if news.is_some_and(|news| told.send(news).is_err()) {
            return;
        }
        match orders.recv_timeout(EVERY) {
            Err(RecvTimeoutError::Disconnected) => return,
            Err(RecvTimeoutError::Timeout) => {}
            Ok(order) => {
                if told.send(News::Answered(carry_out(remote, order))).is_err() {
                    return;
                }
            }
        }
    }
}

/// How the run gets on; `None` where it is known to have ended and has not been resumed.
fn look(remote: &Remote, ended: bool) -> Option<News> {
    let heard = || -> anyhow::Result<Option<News>> {
        if let Some(status) = remote.status()? {
            return Ok(Some(News::Running(Box::new(status), evaluations(remote)?)));
        }
        if ended {
            return Ok(None);
        }
        let status = at_rest(&remote.run.config()?, &remote.run)?;
        Ok(Some(News::Ended(Box::new(status), evaluations(remote)?)))
    };
    heard().unwrap_or_else(|error| Some(News::Silent(format!("{error:#}"))))
}

fn evaluations(remote: &Remote) -> anyhow::Result<Vec<(f64, f64)>> {
    let evaluations = read_evaluations(&remote.run.evaluations())?;
    let points = evaluations.iter().map(|row| (row.env_steps as f64, row.return_mean));
    Ok(points.collect())
}

fn carry_out(remote: &Remote, order: Order) -> String {
    let (done, words) = match order {
        Order::Scale(actors) => (remote.scale(actors), format!("{actors} actors from now on")),
        Order::Stop => (remote.stop(), "stopped in order".into()),
    };
    done.map_or_else(|error| format!("{error:#}"), |()| words)
}
