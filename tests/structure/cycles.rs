//! Import cycles between files, and which of them are allowed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::scan::Imports;

/// Most files in an allowed cycle. They can be read as one unit if they are in one folder.
const MAX_FILES: usize = 3;

/// Files each of which imports, directly or indirectly, from all others.
pub(crate) type Cycle = BTreeSet<PathBuf>;

/// All maximal cycles.
pub(crate) fn cycles(imports: &Imports) -> Vec<Cycle> {
    let reached: BTreeMap<&PathBuf, BTreeSet<&PathBuf>> =
        imports.keys().map(|file| (file, reached_from(imports, file))).collect();
    let mut cycles = BTreeSet::new();
    for (file, others) in &reached {
        let cycle: Cycle = others
            .iter()
            .filter(|other| reached.get(*other).is_some_and(|back| back.contains(file)))
            .map(|other| (*other).clone())
            .collect();
        if !cycle.is_empty() {
            cycles.insert(cycle);
        }
    }
    cycles.into_iter().collect()
}

fn reached_from<'a>(imports: &'a Imports, file: &PathBuf) -> BTreeSet<&'a PathBuf> {
    let mut reached = BTreeSet::new();
    let mut ahead: Vec<&PathBuf> = imports[file].iter().collect();
    while let Some(next) = ahead.pop() {
        if reached.insert(next) {
            ahead.extend(&imports[next]);
        }
    }
    reached
}

/// The reason why a cycle is not allowed; `None` for a small one in one folder.
pub(crate) fn fault(cycle: &Cycle) -> Option<String> {
    let mut common: Option<BTreeSet<PathBuf>> = None;
    for file in cycle {
        let folders = folders(file);
        common = Some(match common {
            None => folders,
            Some(common) => &common & &folders,
        });
    }
    if cycle.len() > MAX_FILES {
        Some(format!("{} files, at most {MAX_FILES} are allowed", cycle.len()))
    } else if common.is_none_or(|folders| folders.is_empty()) {
        Some("it is not inside one folder".into())
    } else {
        None
    }
}

/// The folder that contains a file, and the folder of its submodules: `a.rs` also belongs to `a/`.
fn folders(file: &Path) -> BTreeSet<PathBuf> {
    [file.parent().unwrap().to_owned(), file.with_extension("")].into()
}

/// Text for the user: the cycle's files, and the imports between them.
pub(crate) fn text(cycle: &Cycle, imports: &Imports) -> String {
    let mut text = String::new();
    for file in cycle {
        let within: Vec<_> = imports[file]
            .intersection(cycle)
            .map(|it| it.display().to_string())
            .collect();
        text += &format!("    {} imports from {}\n", file.display(), within.join(", "));
    }
    text
}
