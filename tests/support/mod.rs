//! Runs the real program as a user would, in a directory of its own, and checks what it leaves behind.

#![allow(dead_code, reason = "every suite uses a different part of this file")]
#![allow(clippy::print_stderr, reason = "a failed test explains itself")]

use std::collections::{BTreeMap, HashSet};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process, test_kill_process};
use shoal_common::channel::Domain;
use shoal_common::config::Config;
use shoal_learner::process::replay_layout;
use shoal_learner::replay::Replay;

/// A wait that takes longer has failed, even on a slow machine.
const TIMEOUT: Duration = Duration::from_secs(120);

/// The same for a command that may be a whole training run.
const COMMAND_TIMEOUT: Duration = Duration::from_secs(600);

/// Settings for a quick run: small networks, a short warm-up, a small replay, few evaluation episodes.
pub(crate) const QUICK: [&str; 10] = [
    "--set",
    "ddpg.hidden=[24, 16]",
    "--set",
    "replay.warmup=64",
    "--set",
    "replay.capacity=2000",
    "--set",
    "evaluation.episodes=2",
    "--set",
    "evaluation.final_episodes=3",
];

/// A directory to run the program in.
pub(crate) struct Workplace {
    directory: tempfile::TempDir,
    /// Log level of its runs (`SHOAL_LOG`).
    log: &'static str,
}

/// A running run. Dropping it kills the launcher and all roles.
pub(crate) struct Running {
    child: Child,
    pub(crate) run: PathBuf,
}

impl Workplace {
    pub(crate) fn new() -> Self {
        Self {
            directory: tempfile::tempdir().unwrap(),
            log: "info",
        }
    }

    /// A directory whose runs log every chunk that is sent.
    pub(crate) fn logging_chunks() -> Self {
        let mut place = Self::new();
        place.log = "debug";
        place
    }

    pub(crate) fn path(&self) -> &Path {
        self.directory.path()
    }

    pub(crate) fn shoal(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_shoal"));
        command.args(arguments).current_dir(self.path()).stdin(Stdio::null());
        command
    }

    /// Runs the program to its end.
    pub(crate) fn output(&self, arguments: &[&str]) -> Output {
        output_of(&mut self.shoal(arguments))
    }

    /// Trains quickly and returns what `--json` printed.
    pub(crate) fn train(&self, arguments: &[&str]) -> serde_json::Value {
        let output = self.output(&[&["train"], arguments, &QUICK[..], &["--json"]].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        json(&output)
    }

    /// Starts a quick run in `name` and waits until every role is ready.
    pub(crate) fn start(&self, name: &str, arguments: &[&str]) -> Running {
        self.start_in(name, "pendulum", arguments)
    }

    /// Starts a quick run of `what` in `name` and waits until every role is ready.
    pub(crate) fn start_in(&self, name: &str, what: &str, arguments: &[&str]) -> Running {
        self.launch(name, &[&["train", what, "--run", name], arguments, &QUICK[..]].concat())
    }

    /// Starts a run in `name` with these arguments and no others, and waits until every role is ready.
    pub(crate) fn start_as(&self, name: &str, arguments: &[&str]) -> Running {
        self.launch(name, &[&["train", "pendulum", "--run", name], arguments].concat())
    }

    /// Resumes the run in `name` and waits until every role is ready.
    pub(crate) fn resume(&self, name: &str, arguments: &[&str]) -> Running {
        self.launch(name, &[&["resume", name], arguments].concat())
    }

    /// The program, started with these signals ignored.
    pub(crate) fn shoal_ignoring(&self, signals: &str, arguments: &[&str]) -> Command {
        let mut shell = Command::new("sh");
        shell.args(["-c", &format!("trap '' {signals}; exec \"$@\""), "sh"]);
        shell.arg(env!("CARGO_BIN_EXE_shoal")).args(arguments);
        shell.current_dir(self.path()).stdin(Stdio::null());
        shell
    }

    /// Starts a command that trains in the run directory `name`, and waits until every role is ready.
    pub(crate) fn launch(&self, name: &str, arguments: &[&str]) -> Running {
        self.launch_command(name, &mut self.shoal(&[arguments, &["--json"]].concat()))
    }

    /// The same for a command with all its arguments.
    pub(crate) fn launch_command(&self, name: &str, command: &mut Command) -> Running {
        let run = self.path().join(name);
        let log = || std::fs::read_to_string(run.join("shoal.log")).unwrap_or_default();
        let ready = || log().matches("every role is ready").count();
        let before = ready();
        let child = command
            .stdout(Stdio::piped())
            .stderr(std::fs::File::create(self.path().join("stderr")).unwrap())
            .env("SHOAL_LOG", self.log)
            // So that signals to the test runner's group do not reach the run.
            .process_group(0)
            .spawn()
            .unwrap();
        let mut running = Running {
            child,
            run: run.clone(),
        };
        until("every role is ready", || {
            let ended = running.child.try_wait().unwrap();
            // A short run may have ended before it was seen running.
            let is_ready = ready() > before || ended.is_some_and(|status| status.success());
            assert!(ended.is_none() || is_ready, "{}", self.stderr());
            is_ready
        });
        running
    }

    /// Standard error of the launcher that was started last.
    pub(crate) fn stderr(&self) -> String {
        std::fs::read_to_string(self.path().join("stderr")).unwrap_or_default()
    }

    /// What `shoal status --json` prints of the run in `name`.
    pub(crate) fn status(&self, name: &str) -> serde_json::Value {
        json(&self.output(&["status", name, "--json"]))
    }

    /// The entry of a role, like `actor-0`, in the status of a running run.
    pub(crate) fn role(&self, name: &str, who: &str) -> serde_json::Value {
        let status = self.status(name);
        let roles = status["roles"].as_array().unwrap();
        let has_name =
            |role: &&serde_json::Value| format!("{}-{}", role["role"].as_str().unwrap(), role["index"]) == who;
        let found = roles.iter().find(has_name);
        found.unwrap_or_else(|| panic!("no {who}: {status}")).clone()
    }

    /// Copies the run directory `from` in its current state, whether the run is running or not.
    pub(crate) fn copy(&self, from: &str, to: &str) {
        copy_directory(&self.path().join(from), &self.path().join(to));
    }
}

/// A running run renames its temporary files: files that are gone are left out.
fn copy_directory(from: &Path, to: &Path) {
    std::fs::create_dir(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            copy_directory(&entry.path(), &to);
        } else if let Err(error) = std::fs::copy(entry.path(), to) {
            assert_eq!(
                error.kind(),
                std::io::ErrorKind::NotFound,
                "{}: {error}",
                entry.path().display()
            );
        }
    }
}

impl Running {
    pub(crate) fn log(&self) -> String {
        std::fs::read_to_string(self.run.join("shoal.log")).unwrap_or_default()
    }

    /// Waits until the learner has reported more updates than at the time of the call.
    pub(crate) fn wait_for_learning(&self) {
        let before = self.learned("updates");
        until("the learner has made more updates", || self.learned("updates") > before);
    }

    /// The highest number that the learner has reported in a column of `learner.csv`; 0 before the first report.
    pub(crate) fn learned(&self, column: &str) -> u64 {
        let learned = std::fs::read_to_string(self.run.join("learner.csv")).unwrap_or_default();
        let mut rows = csv::Reader::from_reader(learned.as_bytes());
        let column = rows.headers().unwrap().iter().position(|name| name == column);
        let number = |row: csv::StringRecord| row.get(column?)?.parse().ok();
        rows.records().flatten().filter_map(number).max().unwrap_or(0)
    }

    /// Process ids of a role, like `actor-0`, in the order of its starts.
    pub(crate) fn pids(&self, who: &str) -> Vec<i32> {
        pids(&self.log())
            .into_iter()
            .filter(|(name, _)| name == who)
            .map(|(_, pid)| pid)
            .collect()
    }

    /// Kills the running process of a role with SIGKILL.
    pub(crate) fn kill(&self, who: &str) {
        self.signal_role(who, Signal::KILL);
    }

    /// Kills the newest process of a role, if it is alive.
    pub(crate) fn kill_if_alive(&self, who: &str) {
        self.signal_if_alive(who, Signal::KILL);
    }

    /// Stops the newest process of a role for this long, if it is alive.
    pub(crate) fn pause_if_alive(&self, who: &str, length: Duration) {
        self.signal_if_alive(who, Signal::STOP);
        std::thread::sleep(length);
        self.signal_if_alive(who, Signal::CONT);
    }

    fn signal_if_alive(&self, who: &str, signal: Signal) {
        if let Some(pid) = self.pids(who).last().copied().filter(|pid| is_ours(*pid, &self.run)) {
            // It may end in between.
            let _ = kill_process(Pid::from_raw(pid).unwrap(), signal);
        }
    }

    /// Stops the running process of a role with SIGSTOP.
    pub(crate) fn stop_role(&self, who: &str) {
        self.signal_role(who, Signal::STOP);
    }

    /// Continues the stopped process of a role with SIGCONT.
    pub(crate) fn continue_role(&self, who: &str) {
        self.signal_role(who, Signal::CONT);
    }

    fn signal_role(&self, who: &str, signal: Signal) {
        let pid = *self.pids(who).last().unwrap();
        kill_process(Pid::from_raw(pid).unwrap(), signal).unwrap();
    }

    /// Kills all processes of the run at once and waits until they are gone. They are stopped first, so that none can
    /// react to the end of another.
    pub(crate) fn kill_all(&self) {
        let processes = self.leftovers().processes();
        for signal in [Signal::STOP, Signal::KILL] {
            self.signal(signal);
            for pid in &processes {
                // It may have ended in between.
                let _ = kill_process(Pid::from_raw(*pid).unwrap(), signal);
            }
        }
        until("every process has ended", || self.leftovers().processes().is_empty());
    }

    /// The launcher's process id.
    pub(crate) fn launcher(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal to the launcher.
    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    /// Waits until the launcher has ended. Returns its exit code, its standard output and the run's leftovers.
    pub(crate) fn wait(self) -> (Option<i32>, String, Leftovers) {
        let run = self.run.clone();
        let (code, printed) = self.wait_for_launcher();
        (code, printed, Leftovers::of(&run))
    }

    /// Waits until the launcher has ended. Returns its exit code and its standard output.
    pub(crate) fn wait_for_launcher(mut self) -> (Option<i32>, String) {
        until_within(COMMAND_TIMEOUT, "the launcher has ended", || {
            self.child.try_wait().unwrap().is_some()
        });
        let code = self.child.wait().unwrap().code();
        let mut printed = String::new();
        std::io::Read::read_to_string(self.child.stdout.as_mut().unwrap(), &mut printed).unwrap();
        (code, printed)
    }

    /// Kills a role and removes the files that the launcher needs to clean up after it. What the process occupied in
    /// shared memory stays occupied.
    pub(crate) fn kill_beyond_cleaning(&self, who: &str) {
        let pid = *self.pids(who).last().unwrap();
        let node = node_of(pid);
        assert!(node.len() > 1, "{node:?}");
        // The launcher must find the process dead and the files gone.
        self.signal(Signal::STOP);
        self.kill(who);
        until("the process is dead", || {
            let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
            stat.contains(") Z ")
        });
        for path in node {
            let removed = if path.is_dir() {
                std::fs::remove_dir_all(&path)
            } else {
                std::fs::remove_file(&path)
            };
            removed.unwrap();
        }
        self.signal(Signal::CONT);
    }

    /// Processes and shared memory of this run.
    pub(crate) fn leftovers(&self) -> Leftovers {
        Leftovers::of(&self.run)
    }
}

/// Lines of the log that are shown when a test has failed.
const SHOWN_LINES: usize = 30;

impl Running {
    /// What is known of the run, to explain the failure of its test: outcome, log, and where its processes wait.
    fn state(&self) -> String {
        let outcome = std::fs::read_to_string(self.run.join("outcome.json")).unwrap_or_default();
        let log = self.log();
        let lines: Vec<&str> = log.lines().collect();
        let mut text = format!("{}: {outcome}\n", self.run.display());
        for line in &lines[lines.len().saturating_sub(SHOWN_LINES)..] {
            text += &format!("  {line}\n");
        }
        let roles = pids(&log).into_iter().filter(|(_, pid)| is_ours(*pid, &self.run));
        for (name, pid) in roles.chain([("launcher".to_owned(), self.child.id() as i32)]) {
            let threads = std::fs::read_dir(format!("/proc/{pid}/task"))
                .into_iter()
                .flatten()
                .flatten();
            for thread in threads {
                let read = |file| std::fs::read_to_string(thread.path().join(file)).unwrap_or_default();
                let [thread, waits, call] = ["comm", "wchan", "syscall"].map(read);
                let (thread, call) = (thread.trim_end(), call.trim_end());
                text += &format!("  {name} {pid}, thread {thread}: in {waits}, system call {call}\n");
            }
        }
        text
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("{}", self.state());
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
        let processes = pids(&self.log());
        for (_, pid) in &processes {
            if is_ours(*pid, &self.run) {
                let _ = kill_process(Pid::from_raw(*pid).unwrap(), Signal::KILL);
            }
        }
        // Not `until`: a panic while another one unwinds would abort the suite.
        let begun = Instant::now();
        while processes.iter().any(|(_, pid)| is_ours(*pid, &self.run)) && begun.elapsed() < TIMEOUT {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// Killed processes leave their shared memory to the next start of a run. This test may be the last to start one.
impl Drop for Workplace {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let said = self.stderr();
            let lines: Vec<&str> = said.lines().collect();
            let shown = &lines[lines.len().saturating_sub(SHOWN_LINES)..];
            eprintln!("standard error of the run:\n{}", shown.join("\n"));
        }
        let _ = Domain::remove_abandoned();
    }
}

/// The files in a directory, at any depth, with their bytes.
pub(crate) fn contents(directory: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(directory).unwrap().map(Result::unwrap) {
        let path = entry.path();
        if path.is_dir() {
            found.append(&mut contents(&path));
        } else {
            let bytes = std::fs::read(&path).unwrap();
            found.insert(path, bytes);
        }
    }
    found
}

/// Processes and shared memory of a run.
pub(crate) struct Leftovers {
    run: PathBuf,
    run_id: String,
    pids: Vec<i32>,
}

impl Leftovers {
    pub(crate) fn of(run: &Path) -> Self {
        let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
        let table: toml::Table = config.parse().unwrap();
        let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
        Self {
            run: run.into(),
            run_id: table["run"]["id"].as_str().unwrap().into(),
            pids: pids(&log).into_iter().map(|(_, pid)| pid).collect(),
        }
    }

    /// Processes of the run that still exist.
    pub(crate) fn processes(&self) -> Vec<i32> {
        self.pids
            .iter()
            .copied()
            .filter(|pid| is_ours(*pid, &self.run))
            .collect()
    }

    /// Files of the run that are still in shared memory.
    pub(crate) fn files(&self) -> Vec<String> {
        std::fs::read_dir("/dev/shm")
            .unwrap()
            .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
            .filter(|name| name.contains(&self.run_id))
            .collect()
    }

    /// The run's name in shared memory.
    pub(crate) fn run_id(&self) -> &str {
        &self.run_id
    }

    /// Waits until no process and no file in shared memory is left.
    pub(crate) fn wait_until_gone(&self) {
        assert!(!self.pids.is_empty());
        until("no process of the run is left", || self.processes().is_empty());
        until("no file of the run is left in shared memory", || {
            self.files().is_empty()
        });
    }
}

/// Rows that an actor has sent in all its incarnations, according to the log of a run in [`Workplace::logging_chunks`].
pub(crate) fn sent(run: &Path, actor: u32) -> u64 {
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    let number = |line: &str, name: &str| -> u64 {
        let from = line.split_once(&format!("{name}=")).unwrap().1;
        from.split_whitespace().next().unwrap().parse().unwrap()
    };
    let who = format!("actor-{actor} ");
    let chunks = log
        .lines()
        .filter(|line| line.starts_with(&who) && line.contains("sent a chunk"));
    chunks.map(|line| number(line, "rows")).sum()
}

/// Rows of an actor in the replay.
pub(crate) fn committed(run: &Path, actor: usize) -> u64 {
    let commits = shoal_common::commit::CommitReader::open(&run.join("replay.bin")).unwrap();
    commits.actor(actor).rows
}

/// Checks that every row in a pendulum run's replay is whole and unique, and returns how many were ever committed. None
/// may be terminal: the pendulum never terminates.
pub(crate) fn check_stored_rows(run: &Path, config: &Config) -> u64 {
    let replay = Replay::open(&run.join("replay.bin"), &replay_layout(config)).unwrap();
    assert_eq!(replay.warnings(), [] as [String; 0]);
    let layout = replay.layout().row;
    let mut seen = HashSet::new();
    for index in replay.rows() {
        let row = replay.row(index);
        let transition = layout.read(row);
        assert_eq!(transition.discount, config.algorithm.gamma() as f32);
        // A pendulum that spins at full speed under full torque may return to exactly the same state.
        if transition.a[0].abs() < 2.0 {
            let bits: Vec<u32> = row.iter().map(|x| x.to_bits()).collect();
            assert!(seen.insert(bits), "row {index} is there twice");
        }
    }
    // How many there are depends on the machine, and on how often the torque is at its limit.
    assert!(
        seen.len() > 100,
        "{} of {} rows were compared",
        seen.len(),
        replay.rows().count()
    );
    replay.head()
}

/// Waits until a run has ended successfully. Returns its final weights and its evaluations without their times.
pub(crate) fn final_result(running: Running) -> (serde_json::Value, Vec<String>) {
    let run = running.run.clone();
    let (code, printed, leftovers) = running.wait();
    assert_eq!(
        code,
        Some(0),
        "{}",
        std::fs::read_to_string(run.join("shoal.log")).unwrap()
    );
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let evaluations = std::fs::read_to_string(run.join("evaluations.csv")).unwrap();
    let without_time = |line: &str| line.split_once(',').unwrap().1.to_owned();
    (
        parse(&printed)["weights_sha256"].clone(),
        evaluations.lines().map(without_time).collect(),
    )
}

/// Waits until the replay has `by` more rows than at the time of the call. Returns false if the run ends before.
pub(crate) fn gets_rows(running: &Running, by: u64) -> bool {
    let wanted = committed_rows(running) + by;
    let ends = || running.log().matches("every role has ended").count();
    let ends_before = ends();
    let mut has_ended = false;
    until("more rows are committed, or the run ends", || {
        has_ended = ends() > ends_before;
        has_ended || committed_rows(running) >= wanted
    });
    !has_ended
}

/// The same for a run that is long enough.
pub(crate) fn wait_for_rows(running: &Running, by: u64) {
    assert!(gets_rows(running, by), "the run has ended before: {}", running.log());
}

/// Committed rows of a run; 0 before its replay exists.
pub(crate) fn committed_rows(running: &Running) -> u64 {
    shoal_common::commit::CommitReader::open(&running.run.join("replay.bin")).map_or(0, |commits| commits.rows())
}

/// The error message of a failed command, which must be one line and its only output, apart from a line that names an
/// environment which takes long to start.
pub(crate) fn error_line(output: &Output) -> String {
    let printed = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "{printed}");
    assert!(output.stdout.is_empty());
    let lines: Vec<&str> = printed
        .lines()
        .filter(|line| !line.starts_with("waiting for "))
        .collect();
    let [message] = lines[..] else {
        panic!("one line: {printed}")
    };
    format!("{message}\n")
}

/// Asserts that each of the first `actors` actors has sent rows and that all of them are in the replay.
pub(crate) fn assert_all_rows_committed(run: &Path, actors: u32) {
    for actor in 0..actors {
        let (sent, committed) = (sent(run, actor), committed(run, actor as usize));
        assert!(
            sent > 0 && sent == committed,
            "actor {actor} sent {sent} rows, {committed} are committed"
        );
    }
}

/// The only line of a command's standard output, as JSON.
pub(crate) fn json(output: &Output) -> serde_json::Value {
    parse(&String::from_utf8_lossy(&output.stdout))
}

/// The only line printed, as JSON.
pub(crate) fn parse(printed: &str) -> serde_json::Value {
    assert_eq!(
        printed.lines().count(),
        1,
        "exactly one line on standard output: {printed}"
    );
    serde_json::from_str(printed).unwrap()
}

/// Runs a command to its end. A command that hangs is killed, and the test fails.
pub(crate) fn output_of(command: &mut Command) -> Output {
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let pid = Pid::from_child(&child);
    let (sender, ended) = std::sync::mpsc::channel();
    std::thread::spawn(move || sender.send(child.wait_with_output()));
    match ended.recv_timeout(COMMAND_TIMEOUT) {
        Ok(output) => output.unwrap(),
        Err(_) => {
            kill_process(pid, Signal::KILL).unwrap();
            panic!("{command:?} does not end");
        }
    }
}

/// Polls until `holds` returns true.
pub(crate) fn until(what: &str, holds: impl FnMut() -> bool) {
    until_within(TIMEOUT, what, holds);
}

fn until_within(limit: Duration, what: &str, mut holds: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !holds() {
        assert!(begun.elapsed() < limit, "waited {limit:?} without success until {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// iceoryx2's files for a process of the run: the directory of its node, and the files that show whether it is alive.
fn node_of(pid: i32) -> Vec<PathBuf> {
    let open = std::fs::read_dir(format!("/proc/{pid}/fd")).unwrap().flatten();
    let mut open = open.filter_map(|file| std::fs::read_link(file.path()).ok());
    let details = open
        .find(|file| file.to_string_lossy().ends_with("node.details"))
        .unwrap();
    let directory = details.parent().unwrap();
    let id = directory.file_name().unwrap().to_string_lossy().into_owned();
    let nodes = std::fs::read_dir(directory.parent().unwrap()).unwrap().flatten();
    nodes
        .map(|entry| entry.path())
        .filter(|path| path.to_string_lossy().contains(&id))
        .collect()
}

pub(crate) fn pids(log: &str) -> Vec<(String, i32)> {
    let started = |line: &str| {
        let pid = line.split_once("started as process ")?.1.trim().parse().ok()?;
        Some((line.split_whitespace().next()?.to_owned(), pid))
    };
    log.lines().filter_map(started).collect()
}

/// Whether the process exists and belongs to this run. Its id may have been reused, even by a role of another run.
fn is_ours(pid: i32, run: &Path) -> bool {
    let alive = test_kill_process(Pid::from_raw(pid).unwrap()).is_ok();
    let command = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    let names = |part: &[u8]| command.windows(part.len()).any(|window| window == part);
    // The run itself may have been renamed.
    let place = run.parent().unwrap();
    let place = place.canonicalize().unwrap_or_else(|_| place.into());
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap_or_default();
    let id = config
        .parse::<toml::Table>()
        .ok()
        .and_then(|table| Some(table.get("run")?.get("id")?.as_str()?.to_owned()));
    // A server of another program knows the run by its id alone.
    let serves = id.is_some_and(|id| names(format!("--run\0{id}\0").as_bytes()));
    alive && (names(place.as_os_str().as_encoded_bytes()) || serves)
}
