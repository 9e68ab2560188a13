//! Files that may be there or not.

use std::io::ErrorKind;
use std::path::Path;

use anyhow::Context;

/// Whether something is at the path. [`Path::exists`] also returns false if the path cannot be inspected; its caller
/// could then replace or remove a file that exists.
///
/// # Errors
/// When the path cannot be inspected.
pub fn is_there(path: &Path) -> anyhow::Result<bool> {
    path.try_exists()
        .with_context(|| format!("cannot look for {}", path.display()))
}

/// Removes the file at the path, if there is one.
///
/// # Errors
/// When it cannot be removed.
pub fn remove_if_any(path: &Path) -> anyhow::Result<()> {
    match std::fs::remove_file(path) {
        Err(cause) if cause.kind() != ErrorKind::NotFound => {
            Err(cause).with_context(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}
