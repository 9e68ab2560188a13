//! The workspace's packages, from their manifests.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A package and the dependencies of its library and program.
pub(crate) struct Package {
    pub(crate) name: String,
    /// Names of the packages, without dev-dependencies.
    pub(crate) dependencies: BTreeSet<String>,
    /// `src/lib.rs` and `src/main.rs`, as far as they exist.
    pub(crate) roots: Vec<PathBuf>,
}

/// Every package of the workspace whose `Cargo.toml` is in `root`.
pub(crate) fn workspace(root: &Path) -> Vec<Package> {
    let manifest = read(root);
    let members = manifest["workspace"]["members"].as_array().unwrap();
    let members = members.iter().map(|member| root.join(member.as_str().unwrap()));
    let is_package = manifest.contains_key("package");
    let directories = is_package.then(|| root.to_owned()).into_iter().chain(members);
    directories.map(|directory| package(&directory)).collect()
}

fn read(directory: &Path) -> toml::Table {
    let file = directory.join("Cargo.toml");
    let text = std::fs::read_to_string(&file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    text.parse().unwrap()
}

fn package(directory: &Path) -> Package {
    let manifest = read(directory);
    let sections = ["dependencies", "build-dependencies"].map(|section| manifest.get(section));
    let tables = sections
        .into_iter()
        .flatten()
        .map(|section| section.as_table().unwrap());
    let mut roots = ["src/lib.rs", "src/main.rs"].map(|file| directory.join(file)).to_vec();
    roots.retain(|file| file.exists());
    let name = manifest["package"]["name"].as_str().unwrap().to_owned();
    assert!(!roots.is_empty(), "{name} has neither src/lib.rs nor src/main.rs");
    Package {
        name,
        dependencies: tables.flat_map(|table| table.keys().cloned()).collect(),
        roots,
    }
}
