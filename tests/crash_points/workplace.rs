//! The program of one user, and a temporary directory for one run. An environment variable marks every process of the
//! run, and none of them outlives the directory.

use std::fs::{self, File};
use std::os::unix::fs::{PermissionsExt, chown};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

/// The environment variable that marks processes. Its value is the run's directory.
const MARK: &str = "SHOAL_CRASH_POINTS_PLACE";

/// The ordinary user as which root runs the program.
const NOBODY: u32 = 65534;

/// Longest wait for the end of killed processes.
const KILL_TIMEOUT: Duration = Duration::from_secs(10);

/// The user who runs the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum User {
    /// The user who runs the tests.
    Own,
    /// An ordinary user, while root runs the tests.
    Nobody,
}

/// The program, in a place where its user can start it.
pub(crate) struct Program {
    path: PathBuf,
    pub(crate) user: User,
    _copy: Option<TempDir>,
}

impl Program {
    pub(crate) fn of(user: User) -> Self {
        let built = Path::new(env!("CARGO_BIN_EXE_shoal"));
        if user == User::Own {
            return Self {
                path: built.into(),
                user,
                _copy: None,
            };
        }
        // Other users may not have access to the build directory.
        let copy = tempfile::tempdir().unwrap();
        fs::set_permissions(copy.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let path = copy.path().join("shoal");
        fs::copy(built, &path).unwrap();
        Self {
            path,
            user,
            _copy: Some(copy),
        }
    }
}

/// A directory for a run of one user.
pub(crate) struct Workplace<'a> {
    directory: TempDir,
    program: &'a Program,
}

impl<'a> Workplace<'a> {
    pub(crate) fn new(program: &'a Program) -> Self {
        let directory = tempfile::tempdir().unwrap();
        if program.user == User::Nobody {
            chown(directory.path(), Some(NOBODY), Some(NOBODY)).unwrap();
        }
        Self { directory, program }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    pub(crate) fn read(&self, name: &str) -> String {
        let bytes = fs::read(self.path(name)).unwrap_or_default();
        String::from_utf8_lossy(&bytes).into_owned()
    }

    /// The command line that starts the program with these arguments.
    pub(crate) fn command_line(&self, arguments: &[&str]) -> Vec<String> {
        let program = self.program.path.display().to_string();
        std::iter::once(program)
            .chain(arguments.iter().map(|word| (*word).into()))
            .collect()
    }

    /// Makes a command run in this directory as the user, with its output in `NAME.out` and `NAME.err`.
    pub(crate) fn prepare(&self, command: &mut Command, name: &str) {
        let file = |end: &str| File::create(self.path(&format!("{name}.{end}"))).unwrap();
        command
            .current_dir(self.directory.path())
            .env(MARK, self.directory.path())
            .env("HOME", self.directory.path())
            .stdin(Stdio::null())
            .stdout(file("out"))
            .stderr(file("err"))
            // So that signals to the process group of the tests do not reach the run.
            .process_group(0);
        if self.program.user == User::Nobody {
            command.uid(NOBODY).gid(NOBODY);
        }
    }

    /// Starts the program.
    pub(crate) fn start(&self, name: &str, arguments: &[&str]) -> Child {
        let words = self.command_line(arguments);
        let mut command = Command::new(&words[0]);
        command.args(&words[1..]);
        self.prepare(&mut command, name);
        command.spawn().unwrap()
    }

    /// Runs the program to its end. Returns its exit code, or the negated signal that ended it.
    pub(crate) fn run(&self, name: &str, arguments: &[&str], limit: Duration) -> Result<i32, String> {
        let child = self.start(name, arguments);
        self.wait(child, name, limit)
    }

    /// Waits for the end of a child, with the result of [`Workplace::run`]. After `limit` it kills all processes.
    pub(crate) fn wait(&self, mut child: Child, what: &str, limit: Duration) -> Result<i32, String> {
        use std::os::unix::process::ExitStatusExt;
        let deadline = Instant::now() + limit;
        loop {
            if let Some(status) = child.try_wait().unwrap() {
                return Ok(status.code().unwrap_or_else(|| -status.signal().unwrap_or(0)));
            }
            if Instant::now() >= deadline {
                let running = self.process_list();
                self.kill_all();
                let _ = child.wait();
                return Err(format!("{what} did not end within {limit:?}; still running: {running}"));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Id and command line of every process of this directory.
    pub(crate) fn processes(&self) -> Vec<(i32, String)> {
        let mark = format!("{MARK}={}\0", self.directory.path().display()).into_bytes();
        let is_marked = |pid: &i32| {
            let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
            environment.windows(mark.len()).any(|part| part == mark)
        };
        let words = |pid: i32| {
            let words = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            (
                pid,
                String::from_utf8_lossy(&words).replace('\0', " ").trim_end().to_owned(),
            )
        };
        let listing = fs::read_dir("/proc").unwrap().flatten();
        let pids = listing.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
        pids.filter(is_marked).map(words).collect()
    }

    /// Text for the user: id and beginning of the command line of each process, and what it waits for.
    fn process_list(&self) -> String {
        let mut lines = Vec::new();
        for (pid, words) in self.processes() {
            let words: Vec<&str> = words.split(' ').skip(1).take(3).collect();
            let waits = fs::read_to_string(format!("/proc/{pid}/wchan")).unwrap_or_default();
            lines.push(format!("{pid} {} [{waits}]", words.join(" ")));
        }
        lines.join(", ")
    }

    /// Kills every process of this directory and waits until all are gone.
    pub(crate) fn kill_all(&self) {
        let deadline = Instant::now() + KILL_TIMEOUT;
        loop {
            let left = self.processes();
            if left.is_empty() || Instant::now() >= deadline {
                return;
            }
            for (pid, _) in left {
                kill(pid);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Waits until no process of this directory is left.
    pub(crate) fn wait_until_empty(&self, limit: Duration) -> Result<(), String> {
        let deadline = Instant::now() + limit;
        while !self.processes().is_empty() {
            if Instant::now() >= deadline {
                return Err(format!("still running after {limit:?}: {}", self.process_list()));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(())
    }

    /// Files of a run outside this directory.
    pub(crate) fn leftovers(&self, run: &str) -> Vec<PathBuf> {
        let Some(id) = self.run_id(run) else { return Vec::new() };
        let prefix = format!("shoal_{id}_");
        let listing = fs::read_dir("/dev/shm").unwrap().flatten();
        let ours = listing.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix));
        let mut leftovers: Vec<_> = ours.map(|entry| entry.path()).collect();
        let user = match self.program.user {
            User::Own => rustix::process::getuid().as_raw(),
            User::Nobody => NOBODY,
        };
        leftovers.extend(Some(PathBuf::from(format!("/tmp/shoal-{user}/{id}"))).filter(|root| root.exists()));
        leftovers
    }

    fn run_id(&self, run: &str) -> Option<String> {
        let table: toml::Table = self.read(&format!("{run}/config.toml")).parse().ok()?;
        Some(table.get("run")?.get("id")?.as_str()?.to_owned())
    }
}

impl Drop for Workplace<'_> {
    fn drop(&mut self) {
        self.kill_all();
        // A failed run may leave files that the program would remove at its next start.
        let runs = fs::read_dir(self.directory.path()).into_iter().flatten().flatten();
        for run in runs.filter_map(|entry| entry.file_name().into_string().ok()) {
            for leftover in self.leftovers(&run) {
                let _ = fs::remove_file(&leftover).or_else(|_| fs::remove_dir_all(&leftover));
            }
        }
    }
}

/// Kills a process. Returns whether it existed.
pub(crate) fn kill(pid: i32) -> bool {
    Pid::from_raw(pid).is_some_and(|pid| kill_process(pid, Signal::KILL).is_ok())
}

/// Kills every process of a directory after a time limit, so that a thread that waits for them can continue. Dropping
/// it cancels this.
pub(crate) struct Watchdog<'scope> {
    waker: Option<std::sync::mpsc::Sender<()>>,
    watching: Option<std::thread::ScopedJoinHandle<'scope, Option<String>>>,
}

impl<'scope> Watchdog<'scope> {
    pub(crate) fn new<'env>(
        scope: &'scope std::thread::Scope<'scope, 'env>,
        place: &'env Workplace<'env>,
        limit: Duration,
    ) -> Self {
        use std::sync::mpsc::{RecvTimeoutError, channel};
        let (waker, over) = channel();
        let watching = scope.spawn(move || {
            let mut found = None;
            let mut wait = limit;
            while over.recv_timeout(wait) == Err(RecvTimeoutError::Timeout) {
                let running = format!("did not end within {limit:?}; still running: {}", place.process_list());
                found.get_or_insert(running);
                place.kill_all();
                wait = Duration::from_millis(100);
            }
            found
        });
        Self {
            waker: Some(waker),
            watching: Some(watching),
        }
    }

    /// Ends the watchdog. Returns the processes that it had to kill, as text.
    pub(crate) fn found(mut self) -> Option<String> {
        drop(self.waker.take());
        self.watching.take().and_then(|watching| watching.join().unwrap())
    }
}
