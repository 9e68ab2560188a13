//! A test's run: its name in shared memory, its directory and its processes.

use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{self, Sender};
use std::time::{Duration, Instant};

use shoal_common::channel::Domain;
use shoal_common::commit::CommitReader;
use shoal_common::stop::Stop;
use tempfile::TempDir;

use crate::children::MAX_ACTORS;
use crate::process::Process;

/// Longest wait for any event.
pub(crate) const TIMEOUT: Duration = Duration::from_secs(30);

/// A run. Dropping it asserts that nothing is left in shared memory.
pub(crate) struct Run {
    id: String,
    directory: TempDir,
    /// Holds the run's services.
    host: Mutex<Option<Process>>,
}

/// A stop flag that is set if the test hangs.
pub(crate) struct Watchdog {
    pub(crate) stop: Stop,
    _ends: Sender<()>,
}

impl Run {
    pub(crate) fn new() -> Self {
        iceoryx2::prelude::set_log_level(iceoryx2::prelude::LogLevel::Fatal);
        static RUNS: AtomicU32 = AtomicU32::new(0);
        let id = format!("t{}-{}", std::process::id(), RUNS.fetch_add(1, Ordering::Relaxed));
        let run = Self {
            id,
            directory: TempDir::new().unwrap(),
            host: Mutex::new(None),
        };
        *run.host.lock().unwrap() = Some(run.start("host"));
        run
    }

    /// Ends the process that holds the run's services.
    pub(crate) fn end_host(&self) {
        self.host.lock().unwrap().take().unwrap().end();
    }

    /// Kills the process that holds the run's services.
    pub(crate) fn kill_host(&self) {
        *self.host.lock().unwrap() = None;
    }

    /// Makes this process a member of the run.
    pub(crate) fn join(&self) -> Domain {
        Domain::join(&self.id, MAX_ACTORS).unwrap()
    }

    /// Starts a process with a `role` of `children::main`.
    pub(crate) fn launch(&self, role: &str) -> Process {
        Process::launch(role, &self.id, self.directory.path())
    }

    /// Starts a process and waits until its channels are open.
    pub(crate) fn start(&self, role: &str) -> Process {
        let process = self.launch(role);
        process.expect_line("ready");
        process
    }

    pub(crate) fn replay(&self) -> PathBuf {
        self.directory.path().join("replay.rows")
    }

    /// The replay's commit record. Waits until a learner has created the replay.
    pub(crate) fn commits(&self) -> CommitReader {
        let mut reader = None;
        eventually("a learner creates the replay", || {
            reader = CommitReader::open_if_ready(&self.replay()).unwrap();
            reader.is_some()
        });
        reader.unwrap()
    }

    /// Every file of the run outside its directory.
    pub(crate) fn leftovers(&self) -> Vec<PathBuf> {
        let prefix = format!("shoal_{}_", self.id);
        let listing = std::fs::read_dir("/dev/shm").unwrap().flatten();
        let mut leftovers: Vec<_> = listing
            .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
            .map(|entry| entry.path())
            .collect();
        let user = rustix::process::getuid().as_raw();
        leftovers.extend(Some(PathBuf::from(format!("/tmp/shoal-{user}/{}", self.id))).filter(|root| root.exists()));
        leftovers
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        let host = self.host.get_mut().ok().and_then(Option::take);
        match host {
            Some(host) if !std::thread::panicking() => host.end(),
            _ => {}
        }
        let left = self.join().leave();
        if !std::thread::panicking() {
            left.unwrap();
            assert_eq!(self.leftovers(), [] as [PathBuf; 0], "left by run {}", self.id);
        }
    }
}

impl Watchdog {
    pub(crate) fn new() -> Self {
        let stop = Stop::default();
        let (ends, ended) = mpsc::channel();
        let hanging = stop.clone();
        std::thread::spawn(move || {
            if ended.recv_timeout(TIMEOUT) == Err(mpsc::RecvTimeoutError::Timeout) {
                hanging.request();
            }
        });
        Self { stop, _ends: ends }
    }
}

/// Polls until `holds` returns true.
pub(crate) fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let start = Instant::now();
    while !holds() {
        assert!(start.elapsed() < TIMEOUT, "waited {TIMEOUT:?} without success: {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}
