//! `shoal rm`: removes runs, or their replays alone.

use std::fs::File;
use std::io::{BufRead, ErrorKind, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, bail};
use clap::Args;
use shoal_common::channel::Domain;
use shoal_common::durable::write_atomically;
use shoal_common::run_dir::{LockedRun, RunDir, RunDirError};
use shoal_run::interrupted_start::remove_interrupted_start;
use shoal_run::numbers::mebibytes;
use shoal_run::suite::{self, Suite};
use shoal_run::usage::UsageError;

use crate::launcher;

#[derive(Args, Clone, Debug)]
pub(crate) struct RmArgs {
    /// Directories of runs or suites.
    #[arg(value_name = "RUN|SUITE", required = true)]
    pub(crate) runs: Vec<PathBuf>,
    /// Remove only the replays. The runs can still be evaluated and exported, but not resumed.
    #[arg(long)]
    pub(crate) replay: bool,
    /// Do not ask.
    #[arg(long)]
    pub(crate) yes: bool,
}

/// A run to be removed. The lock keeps others from starting it.
struct Removal {
    run: LockedRun,
    bytes: u64,
}

/// Removes the runs after asking. Nothing is removed if one of them cannot be.
pub(crate) fn run(args: &RmArgs) -> anyhow::Result<ExitCode> {
    let (mut runs, mut suites): (Vec<Removal>, Vec<(&PathBuf, File)>) = (Vec::new(), Vec::new());
    for path in &args.runs {
        let mut paths = vec![path.clone()];
        if let Some(suite) = Suite::read(path)? {
            suites.push((path, suite::lock(path)?));
            paths = suite.runs(path);
        }
        for path in paths {
            let run = RunDir::open(&path)?;
            if runs.iter().any(|other| *other.run == run) {
                bail!("{} is named twice: name each run once", path.display());
            }
            runs.push(prepare_removal(run, args.replay)?);
        }
    }
    if runs.is_empty() && args.replay {
        let named: Vec<_> = args.runs.iter().map(|path| path.display().to_string()).collect();
        bail!("{} has no runs, so there is no replay to remove", named.join(", "));
    }
    let suites_to_go = if args.replay { &[][..] } else { &suites[..] };
    if !args.yes && !confirmed(&runs, suites_to_go, args.replay)? {
        writeln!(std::io::stderr(), "nothing is removed")?;
        return Ok(ExitCode::FAILURE);
    }
    for Removal { run, bytes: size } in &runs {
        run.check()?;
        let here = run.path().display();
        if args.replay {
            remove_replay(run)?;
            writeln!(std::io::stdout(), "removed the replay of {here} ({})", mebibytes(*size))?;
        } else {
            run.remove().with_context(|| format!("cannot remove {here}"))?;
            writeln!(std::io::stdout(), "removed {here} ({})", mebibytes(*size))?;
        }
    }
    for (path, _lock) in suites_to_go {
        let here = path.display();
        // What is left of a start that was interrupted is not a run.
        for trial in Suite::open(path)?.trials {
            remove_interrupted_start(&path.join(trial.name))?;
        }
        suite::remove(path).with_context(|| format!("cannot remove the suite {here}"))?;
        writeln!(std::io::stdout(), "removed the suite {here}")?;
    }
    // What the runs may have left in shared memory when they were killed.
    Domain::remove_abandoned()?;
    Ok(ExitCode::SUCCESS)
}

/// Locks a run to be removed, and checks that it can be.
fn prepare_removal(run: RunDir, replay: bool) -> anyhow::Result<Removal> {
    let here = run.path().display();
    let run = run.lock().map_err(|error| match error {
        RunDirError::Busy(_) => anyhow::anyhow!("{here} is running: end it first, with `shoal stop {here}`"),
        other => other.into(),
    })?;
    // A file `config.toml` alone does not prove that this is a run.
    let config = run.config().map_err(|error| {
        anyhow::anyhow!(
            "{here} may not be a run, and is left as it is: {error}; to remove it nevertheless: rm -r {here}"
        )
    })?;
    // Before anything is removed: the roles of a launcher that was killed would save into the next run at this path.
    launcher::wait_for_roles_here(&config.run.id, &run).with_context(|| format!("cannot remove {here}"))?;
    let bytes = if replay {
        match std::fs::metadata(run.replay_file()) {
            Ok(file) => file.len(),
            Err(error) if error.kind() == ErrorKind::NotFound => bail!("{here} has no replay"),
            Err(error) => return Err(error).with_context(|| format!("cannot read the replay of {here}")),
        }
    } else {
        size(run.path()).with_context(|| format!("cannot read {here}"))?
    };
    Ok(Removal { run, bytes })
}

/// Asks on the terminal whether to go on.
fn confirmed(runs: &[Removal], suites: &[(&PathBuf, File)], replay: bool) -> anyhow::Result<bool> {
    if !std::io::stdin().is_terminal() {
        return Err(UsageError("there is no terminal to ask on: add --yes".into()).into());
    }
    let mut stderr = std::io::stderr().lock();
    let what = if replay { "the replay of " } else { "" };
    for Removal { run, bytes: size, .. } in runs {
        writeln!(stderr, "{what}{} ({})", run.path().display(), mebibytes(*size))?;
    }
    for (path, _) in suites {
        writeln!(stderr, "the suite {}", path.display())?;
    }
    let one = runs.len() + suites.len() == 1;
    write!(stderr, "Remove {}? [y/N] ", if one { "it" } else { "them" })?;
    stderr.flush()?;
    let mut answer = String::new();
    std::io::stdin().lock().read_line(&mut answer)?;
    Ok(["y", "yes"].contains(&answer.trim().to_lowercase().as_str()))
}

/// Removes a replay. The mark comes first: a replay that is missing without it is collected again.
fn remove_replay(run: &RunDir) -> anyhow::Result<()> {
    let path = run.replay_file();
    let mark = run.replay_removed();
    write_atomically(&mark, |file| {
        writeln!(file, "`shoal rm --replay` has removed replay.bin.")
    })
    .with_context(|| format!("cannot write {}", mark.display()))?;
    std::fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
    launcher::note(run, "`shoal rm --replay` has removed the replay");
    Ok(())
}

/// Bytes of all files below the directory.
fn size(directory: &Path) -> std::io::Result<u64> {
    let mut sum = 0;
    for entry in std::fs::read_dir(directory)? {
        let entry = entry?;
        let metadata = entry.metadata()?;
        sum += if metadata.is_dir() {
            size(&entry.path())?
        } else {
            metadata.len()
        };
    }
    Ok(sum)
}
