//! The connection to the run's launcher, on its own thread, so that a slow answer does not delay the keys.

use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender, channel, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::Context;
use shoal_common::channel::control::{RunStatus, ScaleRequest};
use shoal_run::client::RunClient;
use shoal_run::records::recorder::read_evaluations;
use shoal_run::status::saved_status;

/// Time between two polls.
const INTERVAL: Duration = Duration::from_secs(1);

/// How long to wait for a poll in progress at the end.
const END_TIMEOUT: Duration = Duration::from_secs(1);

/// Events that wait for the screen. A terminal that is stopped, as with Ctrl-S, draws none.
const MAX_UNREAD: usize = 8;

/// A request to the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Request {
    /// Change the number of actors.
    Scale(u32),
    /// Save the state and end.
    Stop,
}

/// An event of the run. The pairs of numbers are the environment steps and mean returns of its evaluations.
#[derive(Clone, Debug)]
pub(crate) enum RunEvent {
    Running(Box<RunStatus>, Vec<(f64, f64)>),
    Ended(Box<RunStatus>, Vec<(f64, f64)>),
    /// The launcher did not answer, for this reason.
    Silent(String),
    /// The result of a request.
    Answered(String),
}

/// The thread that polls the run about once a second.
#[derive(Debug)]
pub(crate) struct LauncherLink {
    requests: Option<Sender<Request>>,
    events: Receiver<RunEvent>,
    thread: JoinHandle<()>,
}

impl LauncherLink {
    /// Starts to poll.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub(crate) fn new(client: RunClient) -> anyhow::Result<Self> {
        let (requests, incoming) = channel();
        // While the terminal is stopped, the thread waits.
        let (outgoing, events) = sync_channel(MAX_UNREAD);
        let thread = thread::Builder::new()
            .name("poll".into())
            .spawn(move || poll_until_closed(&client, &incoming, &outgoing))
            .context("cannot start a thread")?;
        Ok(Self {
            requests: Some(requests),
            events,
            thread,
        })
    }

    /// Sends a request to the run. Its result arrives as an event.
    pub(crate) fn request(&self, request: Request) {
        // If the thread has ended, the next call of `events` reports it.
        let _ = self.requests.as_ref().map(|requests| requests.send(request));
    }

    /// The events since the last call.
    ///
    /// # Errors
    /// When the thread has ended.
    pub(crate) fn events(&self) -> anyhow::Result<Vec<RunEvent>> {
        let events = self.events.try_iter().collect();
        anyhow::ensure!(
            !self.thread.is_finished(),
            "the thread that watches the run has failed; start again"
        );
        Ok(events)
    }

    /// Ends the thread. Gives up on one that still waits for an answer; the run's launcher then cleans up after it.
    pub(crate) fn close(mut self) {
        self.requests = None;
        let asked = Instant::now();
        while !self.thread.is_finished() && asked.elapsed() < END_TIMEOUT {
            thread::sleep(Duration::from_millis(5));
        }
    }
}

fn poll_until_closed(client: &RunClient, requests: &Receiver<Request>, events: &SyncSender<RunEvent>) {
    let mut ended = false;
    loop {
        let event = poll(client, ended);
        ended = matches!(event, Some(RunEvent::Ended(..))) || (ended && event.is_none());
        if event.is_some_and(|event| events.send(event).is_err()) {
            return;
        }
        match requests.recv_timeout(INTERVAL) {
            Err(RecvTimeoutError::Disconnected) => return,
            Err(RecvTimeoutError::Timeout) => {}
            Ok(request) => {
                if events.send(RunEvent::Answered(carry_out(client, request))).is_err() {
                    return;
                }
            }
        }
    }
}

/// The state of the run; `None` if it was already known to have `ended` and has not been resumed.
fn poll(client: &RunClient, ended: bool) -> Option<RunEvent> {
    let polled = || -> anyhow::Result<Option<RunEvent>> {
        if let Some(status) = client.status()? {
            return Ok(Some(RunEvent::Running(Box::new(status), evaluations(client)?)));
        }
        if ended {
            return Ok(None);
        }
        let status = saved_status(&client.run.config()?, &client.run)?;
        Ok(Some(RunEvent::Ended(Box::new(status), evaluations(client)?)))
    };
    polled().unwrap_or_else(|error| Some(RunEvent::Silent(format!("{error:#}"))))
}

fn evaluations(client: &RunClient) -> anyhow::Result<Vec<(f64, f64)>> {
    let evaluations = read_evaluations(&client.run.evaluations())?;
    let points = evaluations.iter().map(|row| (row.env_steps as f64, row.return_mean));
    Ok(points.collect())
}

fn carry_out(client: &RunClient, request: Request) -> String {
    let (result, success) = match request {
        Request::Scale(actors) => {
            let request = ScaleRequest {
                here: Some(actors),
                ..ScaleRequest::default()
            };
            (client.scale(request).map(drop), format!("scaled to {actors} actors"))
        }
        Request::Stop => (client.stop(), "stopped; the state is saved".into()),
    };
    result.map_or_else(|error| format!("{error:#}"), |()| success)
}
