//! Requests of gate and relay to the launcher of their own host, asked by a thread of their own: the launcher may take
//! seconds to answer.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use shoal_common::channel::Domain;
use shoal_common::channel::control::{self, ControlRequest, ControlResponse, RunDirId};

/// How long the launcher may take.
const TIMEOUT: Duration = Duration::from_secs(5);

/// The thread that asks.
#[derive(Debug)]
pub(crate) struct LauncherRequests<T> {
    requests: Sender<(ControlRequest, T)>,
    answers: Receiver<(Result<ControlResponse, String>, T)>,
}

impl<T: Send + 'static> LauncherRequests<T> {
    /// Starts the thread. It ends when this is dropped.
    ///
    /// # Errors
    /// When it cannot be started.
    pub(crate) fn start(run_id: &str, max_actors: u32, run: RunDirId) -> std::io::Result<Self> {
        let (requests, asked) = channel::<(ControlRequest, T)>();
        let (answered, answers) = channel();
        let run_id = run_id.to_owned();
        std::thread::Builder::new().name("requests".into()).spawn(move || {
            for (request, what) in asked {
                let answer = ask(&run_id, max_actors, run, request);
                if answered.send((answer, what)).is_err() {
                    return;
                }
            }
        })?;
        Ok(Self { requests, answers })
    }

    /// Asks. The answer comes with `what`.
    pub(crate) fn ask(&self, request: ControlRequest, what: T) {
        // It fails only if the thread has panicked, and then no answer comes either.
        let _ = self.requests.send((request, what));
    }

    /// The next answer, if there is one.
    pub(crate) fn answer(&self) -> Option<(Result<ControlResponse, String>, T)> {
        self.answers.try_recv().ok()
    }
}

fn ask(run_id: &str, max_actors: u32, run: RunDirId, request: ControlRequest) -> Result<ControlResponse, String> {
    let domain = Domain::join_as_client(run_id, max_actors).map_err(|error| error.to_string())?;
    let answer = control::ask(&domain, run, request, TIMEOUT, || true);
    let left = domain.leave();
    let answer = answer.map_err(|error| error.to_string())?;
    left.map_err(|error| error.to_string())?;
    Ok(answer)
}
