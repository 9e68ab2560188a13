//! Files that `--out` names, of `export`, `film` and `report`.

use std::fs::File;
use std::io::{ErrorKind, Read};
use std::path::Path;

use anyhow::{Context, bail, ensure};

/// The bytes by which a file is recognised, at most.
const START_BYTES: u64 = 256;

/// Checks that `out` does not exist or is `what`, by its first bytes: no other file is replaced.
///
/// # Errors
/// When it is something else, or cannot be read.
pub(super) fn check_replaceable(out: &Path, what: &str, is_one: impl Fn(&[u8]) -> bool) -> anyhow::Result<()> {
    if out.is_dir() {
        bail!("{} is a directory: give --out the name of a file", out.display());
    }
    let mut start = Vec::new();
    match File::open(out).and_then(|file| file.take(START_BYTES).read_to_end(&mut start)) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        read => read.with_context(|| format!("cannot read {}; choose another file with --out", out.display()))?,
    };
    ensure!(
        is_one(&start),
        "{} exists and is not {what}: choose another file with --out, or remove it",
        out.display()
    );
    Ok(())
}
