//! Why a directory is refused that was taken for a run directory, in words for the user.

use std::path::Path;

/// At most this many runs of a suite are named.
const MAX_NAMED_RUNS: usize = 3;

/// What is at `path` instead of a run, and which run was perhaps meant.
pub(super) fn reason(path: &Path) -> String {
    what_it_is(path) + &did_you_mean(path)
}

fn what_it_is(path: &Path) -> String {
    if !path.exists() {
        "there is no such directory".into()
    } else if path.join("suite.json").is_file() {
        suite(path)
    } else {
        "it has no config.toml".into()
    }
}

/// A suite in words: its runs that have begun, and how to name one.
fn suite(path: &Path) -> String {
    let entries = std::fs::read_dir(path).into_iter().flatten().flatten();
    let begun = entries.filter(|entry| entry.path().join("config.toml").is_file());
    let mut runs: Vec<String> = begun
        .map(|run| run.file_name().to_string_lossy().into_owned())
        .collect();
    // seed=2 before seed=10.
    runs.sort_by(|a, b| (a.len(), a).cmp(&(b.len(), b)));
    let here = path.display();
    let Some(first) = runs.first() else {
        return format!("it is a suite, and none of its runs has begun: shoal resume {here}");
    };
    let shown = runs.iter().take(MAX_NAMED_RUNS).cloned().collect::<Vec<_>>().join(", ");
    let others = match runs.len().saturating_sub(MAX_NAMED_RUNS) {
        0 => String::new(),
        others => format!(", and {others} more, which `shoal list {here}` shows"),
    };
    let one = path.join(first);
    format!(
        "it is a suite of runs ({shown}{others}); name one of them, as in {}",
        one.display()
    )
}

/// A hint for a bare name that is a run in `runs`, where `shoal train` makes its runs; otherwise empty.
fn did_you_mean(path: &Path) -> String {
    let there = Path::new("runs").join(path);
    if path.components().count() == 1 && there.join("config.toml").is_file() {
        format!("; did you mean {}?", there.display())
    } else {
        String::new()
    }
}
