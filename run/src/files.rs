//! Files that are looked for before something is decided.

use std::path::Path;

use anyhow::Context;

/// Whether something is at the path. [`Path::exists`] also says no if the path cannot be inspected for the moment; then
/// files that are there would be replaced or removed.
///
/// # Errors
/// When the path cannot be inspected.
pub fn is_there(path: &Path) -> anyhow::Result<bool> {
    path.try_exists()
        .with_context(|| format!("cannot look for {}", path.display()))
}
