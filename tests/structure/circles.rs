//! Circles of files that import from each other, and which of them are allowed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::scan::Imports;

/// A circle of so many files in one folder can still be read as one.
const FEW: usize = 3;

/// Files each of which imports, over some others of them, from every other one.
pub(crate) type Circle = BTreeSet<PathBuf>;

/// All circles, each as large as it is.
pub(crate) fn circles(imports: &Imports) -> Vec<Circle> {
    let reached: BTreeMap<&PathBuf, BTreeSet<&PathBuf>> =
        imports.keys().map(|file| (file, reached_from(imports, file))).collect();
    let mut circles = BTreeSet::new();
    for (file, others) in &reached {
        let circle: Circle = others
            .iter()
            .filter(|other| reached.get(*other).is_some_and(|back| back.contains(file)))
            .map(|other| (*other).clone())
            .collect();
        if !circle.is_empty() {
            circles.insert(circle);
        }
    }
    circles.into_iter().collect()
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

/// Why a circle is not allowed; `None` for one of few files in one folder.
pub(crate) fn fault(circle: &Circle) -> Option<String> {
    let mut common: Option<BTreeSet<PathBuf>> = None;
    for file in circle {
        let folders = folders(file);
        common = Some(match common {
            None => folders,
            Some(common) => &common & &folders,
        });
    }
    if circle.len() > FEW {
        Some(format!("{} files, and {FEW} are the most", circle.len()))
    } else if common.is_none_or(|folders| folders.is_empty()) {
        Some("it is not inside one folder".into())
    } else {
        None
    }
}

/// The folder that a file lies in, and the one that is its own: `a.rs` belongs to `a/` too.
fn folders(file: &Path) -> BTreeSet<PathBuf> {
    [file.parent().unwrap().to_owned(), file.with_extension("")].into()
}

/// The circle for a person, with the imports that close it.
pub(crate) fn text(circle: &Circle, imports: &Imports) -> String {
    let mut text = String::new();
    for file in circle {
        let within: Vec<_> = imports[file]
            .intersection(circle)
            .map(|it| it.display().to_string())
            .collect();
        text += &format!("    {} imports from {}\n", file.display(), within.join(", "));
    }
    text
}
