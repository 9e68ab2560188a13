//! The run directory, which contains all files of a run.

mod not_a_run;

use std::fs::{DirBuilder, File};
use std::io::{self, ErrorKind, Write};
use std::ops::Deref;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use shoal_base::durable::write_atomically;
use shoal_base::file_lock;
use shoal_channel::control::RunDirId;

use crate::config::{Config, ConfigError};

/// A run directory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunDir {
    path: PathBuf,
}

/// Why a run directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunDirError {
    /// A run directory is never overwritten.
    #[error("{0} exists already; choose another directory, or remove it")]
    Exists(PathBuf),
    /// There is no run in this directory.
    #[error("{path} is not a run directory: {why}")]
    NotARun {
        /// The directory.
        path: PathBuf,
        /// What it is instead, and perhaps which one was meant.
        why: String,
    },
    /// Another launcher is running the run.
    #[error("the run in {0} is already running: a launcher holds its lock; end that one first")]
    Busy(PathBuf),
    /// Somebody has removed or renamed it, or deleted its `config.toml`.
    #[error(
        "the run directory {0} was removed or renamed, or its config.toml was deleted, while the run was running; the \
         run has ended, and what it had not written is lost"
    )]
    Gone(PathBuf),
    /// The system refused.
    #[error("cannot {action} {path}: {cause}")]
    Io {
        /// What was tried, as a verb.
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The system's reason.
        cause: io::Error,
    },
}

/// The first line of `config/used.toml`.
const USED: &str = "# What this run was last used with. To change it, edit config.toml or use `shoal resume --set`.\n";

/// Writes a configuration after these first lines, atomically.
fn write(path: &Path, head: &str, config: &Config) -> Result<(), RunDirError> {
    let io = |cause| RunDirError::Io {
        action: "write",
        path: path.to_owned(),
        cause,
    };
    let text = config.to_toml().map_err(|error| io(io::Error::other(error)))?;
    write_atomically(path, |file| write!(file, "{head}{text}")).map_err(io)
}

fn id_of(directory: &std::fs::Metadata) -> RunDirId {
    RunDirId {
        device: directory.dev(),
        inode: directory.ino(),
    }
}

/// How long `config.toml` may be missing: some editors rename the old file before they write the new one.
const EDITOR_RENAME_TIMEOUT: Duration = Duration::from_millis(300);

/// How long a launcher may take to end after the process that started it was killed: the system first ends its writes.
const ORPHAN_END_TIMEOUT: Duration = Duration::from_secs(10);

/// A run that this process has locked. The launcher keeps it locked while the run is running; the system releases the
/// lock when the launcher dies.
#[derive(Debug)]
pub struct LockedRun {
    run: RunDir,
    id: RunDirId,
    /// Its handle holds the lock.
    _directory: File,
}

impl Deref for LockedRun {
    type Target = RunDir;

    fn deref(&self) -> &RunDir {
        &self.run
    }
}

impl LockedRun {
    /// Releases the lock.
    pub fn unlock(self) -> RunDir {
        self.run
    }

    /// What distinguishes the directory from its copies.
    pub fn id(&self) -> RunDirId {
        self.id
    }

    /// Whether another directory, or nothing, is at the path now. What cannot be inspected for the moment, as on a busy
    /// network file system, is not gone.
    fn is_elsewhere(&self) -> bool {
        match std::fs::metadata(&self.run.path) {
            Ok(there) => id_of(&there) != self.id,
            Err(error) => matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory),
        }
    }

    /// Checks that the run is still where it was when it was locked.
    ///
    /// # Errors
    /// When its directory was removed or renamed, even if there is another one now, or its `config.toml` was deleted.
    pub fn check(&self) -> Result<(), RunDirError> {
        let run = &self.run;
        let since = Instant::now();
        while !self.is_elsewhere() {
            if !matches!(run.config_file().try_exists(), Ok(false)) {
                return Ok(());
            }
            if since.elapsed() >= EDITOR_RENAME_TIMEOUT {
                break;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Err(RunDirError::Gone(run.path.clone()))
    }
}

impl RunDir {
    /// Creates a new, empty run directory, accessible to its owner alone.
    ///
    /// # Errors
    /// When `path` exists already, or cannot be created.
    pub fn create(path: &Path) -> Result<Self, RunDirError> {
        let io = |action, path: &Path| {
            let path = path.to_owned();
            move |cause| RunDirError::Io { action, path, cause }
        };
        let is_missing = |above: &&Path| !above.as_os_str().is_empty() && !above.exists();
        let missing: Vec<&Path> = path.ancestors().skip(1).take_while(is_missing).collect();
        let make = || {
            if let Some(parent) = path.parent() {
                std::fs::create_dir_all(parent).map_err(io("create the directory", parent))?;
            }
            DirBuilder::new()
                .mode(0o700)
                .create(path)
                .map_err(|cause| match cause.kind() {
                    ErrorKind::AlreadyExists => RunDirError::Exists(path.to_owned()),
                    _ => io("create the run directory", path)(cause),
                })
        };
        make().inspect_err(|_| {
            // A directory that another process has begun to use is not empty, so it stays.
            for above in missing {
                let _ = std::fs::remove_dir(above);
            }
        })?;
        // The path is absolute, because roles may have another working directory.
        let path = std::fs::canonicalize(path).map_err(io("resolve", path))?;
        Ok(Self { path })
    }

    /// Creates the first of `<parent>/<name>-1`, `<parent>/<name>-2`, … that does not exist yet.
    ///
    /// # Errors
    /// When the directory cannot be created.
    pub fn create_next(parent: &Path, name: &str) -> Result<Self, RunDirError> {
        let mut n = 1_u64;
        loop {
            match Self::create(&parent.join(format!("{name}-{n}"))) {
                Err(RunDirError::Exists(_)) => n += 1,
                other => return other,
            }
        }
    }

    /// The run directory at this path, whether it exists or not. The file system is neither read nor changed.
    pub fn at(path: &Path) -> Self {
        Self { path: path.into() }
    }

    /// Opens an existing run directory.
    ///
    /// # Errors
    /// When there is no run in it.
    pub fn open(path: &Path) -> Result<Self, RunDirError> {
        if !path.join("config.toml").is_file() {
            return Err(RunDirError::NotARun {
                path: path.to_owned(),
                why: not_a_run::reason(path),
            });
        }
        let path = std::fs::canonicalize(path).map_err(|cause| RunDirError::Io {
            action: "resolve",
            path: path.to_owned(),
            cause,
        })?;
        Ok(Self { path })
    }

    /// Claims the run for this process until the result is dropped.
    ///
    /// # Errors
    /// When another process has locked it.
    pub fn lock(&self) -> Result<LockedRun, RunDirError> {
        let io = |cause| RunDirError::Io {
            action: "lock",
            path: self.path.clone(),
            cause,
        };
        let file = File::open(&self.path).map_err(io)?;
        if !file_lock::lock(&file, file_lock::RELEASE_TIMEOUT).map_err(io)? {
            return Err(RunDirError::Busy(self.path.clone()));
        }
        let locked = LockedRun {
            run: self.clone(),
            id: id_of(&file.metadata().map_err(io)?),
            _directory: file,
        };
        // Before the lock was taken, its last owner may have removed it.
        if locked.is_elsewhere() {
            return Err(RunDirError::Gone(self.path.clone()));
        }
        Ok(locked)
    }

    /// Whether a launcher is running the run.
    ///
    /// # Errors
    /// When the state of the lock cannot be determined.
    pub fn is_running(&self) -> Result<bool, RunDirError> {
        let io = |cause| RunDirError::Io {
            action: "check the lock of",
            path: self.path.clone(),
            cause,
        };
        let file = File::open(&self.path).map_err(io)?;
        file_lock::is_locked(&file).map_err(io)
    }

    /// As [`is_running`](Self::is_running), but a launcher whose parent was just killed is given a moment to end.
    ///
    /// # Errors
    /// As [`is_running`](Self::is_running).
    pub fn keeps_running(&self) -> Result<bool, RunDirError> {
        let since = Instant::now();
        while self.is_running()? {
            if since.elapsed() >= ORPHAN_END_TIMEOUT {
                return Ok(true);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(false)
    }

    /// What distinguishes the directory from its copies.
    ///
    /// # Errors
    /// When the directory cannot be inspected.
    pub fn directory_id(&self) -> Result<RunDirId, RunDirError> {
        let metadata = std::fs::metadata(&self.path).map_err(|cause| RunDirError::Io {
            action: "inspect",
            path: self.path.clone(),
            cause,
        })?;
        Ok(id_of(&metadata))
    }

    /// The resolved configuration that the run was last used with, which its files belong to. `config.toml` may have
    /// been edited since; such an edit takes effect when the run is resumed.
    ///
    /// # Errors
    /// When it is missing or invalid.
    pub fn config(&self) -> Result<Config, ConfigError> {
        match Config::load(&self.used_config_file()) {
            // A run of an earlier version, or a run that has just been made.
            Err(ConfigError::Unreadable { cause, .. }) if cause.kind() == ErrorKind::NotFound => {
                Config::load(&self.config_file())
            }
            loaded => loaded,
        }
    }

    /// Writes `config.toml` atomically. Only the launcher calls this.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write_config(&self, config: &Config) -> Result<(), RunDirError> {
        write(&self.config_file(), "", config)
    }

    /// Writes the configuration that the run is used with from now on. Only the launcher calls this.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write_used_config(&self, config: &Config) -> Result<(), RunDirError> {
        let path = self.used_config_file();
        let made = path.parent().map_or(Ok(()), std::fs::create_dir_all);
        made.map_err(|cause| RunDirError::Io {
            action: "create the directory of",
            path: path.clone(),
            cause,
        })?;
        write(&path, USED, config)
    }

    /// Removes the directory with everything in it, `origin.json` first and `config.toml` last. If this is interrupted,
    /// what is left can be removed like any run, and a run that lacks what it begins with does not look whole.
    ///
    /// # Errors
    /// When something in it cannot be removed.
    pub fn remove(&self) -> io::Result<()> {
        let remove_if_any = |file: &Path| match std::fs::remove_file(file) {
            Err(cause) if cause.kind() != ErrorKind::NotFound => Err(cause),
            _ => Ok(()),
        };
        remove_if_any(&self.origin())?;
        let config = self.config_file();
        for entry in std::fs::read_dir(&self.path)? {
            let entry = entry?;
            if entry.path() == config {
                continue;
            }
            if entry.file_type()?.is_dir() {
                std::fs::remove_dir_all(entry.path())?;
            } else {
                std::fs::remove_file(entry.path())?;
            }
        }
        remove_if_any(&config)?;
        std::fs::remove_dir(&self.path)
    }

    /// The directory itself.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The directory's own name.
    pub fn name(&self) -> String {
        self.path
            .file_name()
            .map_or_else(|| "run".into(), |name| name.to_string_lossy().into_owned())
    }

    /// `config.toml`: the resolved configuration, which the user may edit.
    pub fn config_file(&self) -> PathBuf {
        self.path.join("config.toml")
    }

    /// `config/used.toml`: the configuration that the run was last used with.
    pub fn used_config_file(&self) -> PathBuf {
        self.path.join("config/used.toml")
    }

    /// `changes.csv`: every change of the configuration since the run was created.
    pub fn changes(&self) -> PathBuf {
        self.path.join("changes.csv")
    }

    /// `replay.bin`: the mapped ring of transitions.
    pub fn replay_file(&self) -> PathBuf {
        self.path.join("replay.bin")
    }

    /// `replay.removed`: exists if `shoal rm --replay` has removed the replay.
    pub fn replay_removed(&self) -> PathBuf {
        self.path.join("replay.removed")
    }

    /// `checkpoints/`: the learner's state.
    pub fn checkpoints(&self) -> PathBuf {
        self.path.join("checkpoints")
    }

    /// `checkpoints/best.policy`: the policy with the best evaluation so far.
    pub fn best_policy(&self) -> PathBuf {
        self.checkpoints().join("best.policy")
    }

    /// `checkpoints/evaluator.state`: what the evaluator leaves to its successor.
    pub fn evaluator_state(&self) -> PathBuf {
        self.checkpoints().join("evaluator.state")
    }

    /// `policies/`: every evaluated policy, if `evaluation.keep_policies` is set.
    pub fn policies(&self) -> PathBuf {
        self.path.join("policies")
    }

    /// `policies/<steps>.policy`: the policy that was learned from this many environment steps.
    pub fn evaluated_policy(&self, env_steps: u64) -> PathBuf {
        self.policies().join(format!("{env_steps:012}.policy"))
    }

    /// `checkpoints/last.policy`: the learner's last policy.
    pub fn last_policy(&self) -> PathBuf {
        self.checkpoints().join("last.policy")
    }

    /// `episodes.csv`: every exploration episode.
    pub fn episodes(&self) -> PathBuf {
        self.path.join("episodes.csv")
    }

    /// `evaluations.csv`: every evaluation.
    pub fn evaluations(&self) -> PathBuf {
        self.path.join("evaluations.csv")
    }

    /// `learner.csv`: losses, rates and ratio over time.
    pub fn learner_records(&self) -> PathBuf {
        self.path.join("learner.csv")
    }

    /// `hosts.csv`: other hosts that have joined, and how they did.
    pub fn hosts(&self) -> PathBuf {
        self.path.join("hosts.csv")
    }

    /// `incidents.csv`: processes that were killed, failed, stalled, started again, given up or retired, invalid
    /// answers of environments, and when the run was scaled or resumed.
    pub fn incidents(&self) -> PathBuf {
        self.path.join("incidents.csv")
    }

    /// `tensorboard/`: the same records as TensorBoard event files.
    pub fn tensorboard(&self) -> PathBuf {
        self.path.join("tensorboard")
    }

    /// `incarnations`: the number of processes started for the run so far, written before each start.
    pub fn incarnations(&self) -> PathBuf {
        self.path.join("incarnations")
    }

    /// `actors.json`: which actors the learner's host has, if they are not the first ones.
    pub fn local_actors(&self) -> PathBuf {
        self.path.join("actors.json")
    }

    /// `origin.json`: the run or the dataset that this one began with.
    pub fn origin(&self) -> PathBuf {
        self.path.join("origin.json")
    }

    /// `outcome.json`: how the run ended.
    pub fn outcome(&self) -> PathBuf {
        self.path.join("outcome.json")
    }

    /// `server.json`: where the run's environment server is started, if it is another program.
    pub fn server_file(&self) -> PathBuf {
        self.path.join("server.json")
    }

    /// `description.json`: what the numbers of the run's environment mean, if another program serves it and says so.
    pub fn description(&self) -> PathBuf {
        self.path.join("description.json")
    }

    /// `final-evaluation.json`: the results of the evaluation at the end of the run.
    pub fn final_evaluation(&self) -> PathBuf {
        self.path.join("final-evaluation.json")
    }

    /// `shoal.log`: the log of all processes.
    pub fn log(&self) -> PathBuf {
        self.path.join("shoal.log")
    }

    /// `config/iceoryx2.toml`: the configuration with which other iceoryx2 programs find the run in shared memory.
    pub fn iceoryx2_config(&self) -> PathBuf {
        self.path.join("config/iceoryx2.toml")
    }

    /// `learning-curve.svg`: mean evaluation returns over environment steps.
    pub fn learning_curve(&self) -> PathBuf {
        self.path.join("learning-curve.svg")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_suite_that_is_taken_for_a_run_names_its_runs() {
        let parent = tempfile::tempdir().unwrap();
        let suite = parent.path().join("s");
        std::fs::create_dir(&suite).unwrap();
        std::fs::write(suite.join("suite.json"), "").unwrap();
        let refused = || RunDir::open(&suite).unwrap_err().to_string();
        assert!(
            refused().contains("none of its runs has begun: shoal resume "),
            "{}",
            refused()
        );
        for seed in [10, 2, 1, 3, 4] {
            let run = suite.join(format!("seed={seed}"));
            std::fs::create_dir(&run).unwrap();
            std::fs::write(run.join("config.toml"), "").unwrap();
        }
        std::fs::create_dir(suite.join("notes")).unwrap();
        let here = suite.display();
        let expected = format!(
            "{here} is not a run directory: it is a suite of runs (seed=1, seed=2, seed=3, and 2 more, which \
             `shoal list {here}` shows); name one of them, as in {here}/seed=1"
        );
        assert_eq!(refused(), expected);
    }

    #[test]
    fn a_run_directory_is_never_overwritten_and_has_only_one_launcher() {
        let parent = tempfile::tempdir().unwrap();
        let first = RunDir::create_next(parent.path(), "pendulum").unwrap();
        let second = RunDir::create_next(parent.path(), "pendulum").unwrap();
        assert_eq!(
            (first.name().as_str(), second.name().as_str()),
            ("pendulum-1", "pendulum-2")
        );
        assert!(matches!(RunDir::create(first.path()), Err(RunDirError::Exists(_))));
        assert!(matches!(RunDir::open(first.path()), Err(RunDirError::NotARun { .. })));

        // A name that no file system takes.
        let nowhere = parent.path().join("a/b").join("x".repeat(300)).join("run");
        assert!(matches!(RunDir::create(&nowhere), Err(RunDirError::Io { .. })));
        assert!(!parent.path().join("a").exists(), "what it made is removed");

        let locked = first.lock().unwrap();
        assert!(matches!(first.lock(), Err(RunDirError::Busy(_))));
        std::fs::write(first.config_file(), "").unwrap();
        locked.check().unwrap();
        std::fs::remove_dir_all(first.path()).unwrap();
        assert!(matches!(locked.check(), Err(RunDirError::Gone(_))));
        let first = RunDir::create(first.path()).unwrap();
        std::fs::write(first.config_file(), "").unwrap();
        assert!(locked.check().is_err(), "this is another one");
        drop(locked);
        first.lock().unwrap();
    }
}
