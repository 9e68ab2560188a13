//! Rules for the sources: no large import cycles, and which crate may import which.
//!
//! An import is a `use` or a path in the code. A re-export (`pub use`) is followed to the file that declares the item.
//! A parent's `mod` declaration alone is not an import. Unit tests are left out.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod crates;
mod cycles;
mod environment_names;
mod lists;
mod scan;

use std::path::Path;

use crates::{Package, workspace};
use cycles::{cycles, fault, text};
use scan::Sources;

/// The crates of the workspace that each crate may import. No crate imports `shoal`.
const MAY_IMPORT: [(&str, &[&str]); 13] = [
    ("shoal-base", &[]),
    ("shoal-channel", &["shoal-base"]),
    ("shoal-policy", &["shoal-base"]),
    ("shoal-common", &["shoal-base", "shoal-channel", "shoal-policy"]),
    // The layers of `common` below policies and configuration.
    ("shoal-env-server", &["shoal-base", "shoal-channel"]),
    ("shoal-actor", &["shoal-common"]),
    ("shoal-learner", &["shoal-common"]),
    ("shoal-remote", &["shoal-common"]),
    ("shoal-run", &CORE),
    ("shoal-report", &RUN_AND_CORE),
    ("shoal-bench", &ACTOR_REMOTE_RUN_AND_CORE),
    ("shoal-reproduce", &REPORT_RUN_AND_CORE),
    ("shoal", &EVERYTHING),
];

const CORE: [&str; 3] = ["shoal-common", "shoal-env-server", "shoal-learner"];
const RUN_AND_CORE: [&str; 4] = ["shoal-run", "shoal-common", "shoal-env-server", "shoal-learner"];
const ACTOR_REMOTE_RUN_AND_CORE: [&str; 6] = [
    "shoal-remote",
    "shoal-run",
    "shoal-common",
    "shoal-env-server",
    "shoal-actor",
    "shoal-learner",
];
const REPORT_RUN_AND_CORE: [&str; 5] = [
    "shoal-report",
    "shoal-run",
    "shoal-common",
    "shoal-env-server",
    "shoal-learner",
];
const EVERYTHING: [&str; 9] = [
    "shoal-bench",
    "shoal-reproduce",
    "shoal-report",
    "shoal-run",
    "shoal-remote",
    "shoal-common",
    "shoal-env-server",
    "shoal-actor",
    "shoal-learner",
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The forbidden import cycles of a workspace.
fn wrong_cycles(root: &Path, packages: &[Package]) -> Vec<String> {
    let mut wrong = Vec::new();
    for file in packages.iter().flat_map(|package| &package.roots) {
        let imports = Sources::read(root, file).imports();
        for cycle in cycles(&imports) {
            if let Some(fault) = fault(&cycle) {
                wrong.push(format!("a cycle ({fault}):\n{}", text(&cycle, &imports)));
            }
        }
    }
    wrong
}

/// The imports between crates, in manifests and sources, that the table does not allow.
fn wrong_crates(root: &Path, packages: &[Package], may_import: &[(&str, &[&str])]) -> Vec<String> {
    let mut wrong = Vec::new();
    for package in packages {
        let name = &package.name;
        let Some((_, allowed)) = may_import.iter().find(|(listed, _)| listed == name) else {
            wrong.push(format!("{name} is not in the table MAY_IMPORT"));
            continue;
        };
        let forbidden = packages.iter().map(|other| &other.name);
        let forbidden: Vec<_> = forbidden
            .filter(|other| *other != name && !allowed.contains(&other.as_str()))
            .collect();
        for other in &forbidden {
            if package.dependencies.contains(*other) {
                wrong.push(format!("the manifest of {name} depends on {other}"));
            }
        }
        for file in &package.roots {
            let mut sources = Sources::read(root, file);
            sources.imports();
            for other in &forbidden {
                // A package's own library is not among the forbidden ones, although its program imports it by name.
                for file in sources.foreign.get(&other.replace('-', "_")).into_iter().flatten() {
                    wrong.push(format!("{} imports {other}", file.display()));
                }
            }
        }
    }
    wrong
}

#[test]
fn import_cycles_are_small_and_within_one_folder() {
    let wrong = wrong_cycles(root(), &workspace(root()));
    assert!(
        wrong.is_empty(),
        "{} import cycles are not allowed:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
}

#[test]
fn each_crate_imports_only_what_the_table_allows() {
    let wrong = wrong_crates(root(), &workspace(root()), &MAY_IMPORT);
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn an_environment_server_is_built_without_the_matrix_products() {
    let output = std::process::Command::new(env!("CARGO"))
        .args([
            "tree",
            "--offline",
            "-p",
            "shoal-env-server",
            "-e",
            "normal",
            "--prefix",
            "none",
        ])
        .current_dir(root())
        .output()
        .unwrap();
    let tree = String::from_utf8(output.stdout).unwrap();
    assert!(
        output.status.success() && tree.starts_with("shoal-env-server "),
        "{tree}"
    );
    for name in ["faer", "pulp"] {
        let found = tree.lines().find(|line| line.split(' ').next() == Some(name));
        assert_eq!(found, None, "{tree}");
    }
}

/// A test with a harness of its own is never run by the standard one, so `#[test]` would silently do nothing there.
#[test]
fn suites_with_a_harness_of_their_own_have_no_standard_tests() {
    let manifest: toml::Table = std::fs::read_to_string(root().join("Cargo.toml"))
        .unwrap()
        .parse()
        .unwrap();
    let suites = manifest["test"].as_array().unwrap().iter();
    let suites: Vec<_> = suites
        .filter(|suite| {
            suite
                .get("harness")
                .is_some_and(|harness| harness.as_bool() == Some(false))
        })
        .collect();
    assert!(!suites.is_empty());
    for suite in suites {
        let main = root().join(suite["path"].as_str().unwrap());
        let files = if main.ends_with("main.rs") {
            let folder = std::fs::read_dir(main.parent().unwrap()).unwrap();
            folder.map(|entry| entry.unwrap().path()).collect()
        } else {
            vec![main]
        };
        for file in files
            .iter()
            .filter(|file| file.extension().is_some_and(|it| it == "rs"))
        {
            let text = std::fs::read_to_string(file).unwrap();
            assert!(
                !text.contains("#[test]"),
                "{}: give it to `run` in `main`",
                file.display()
            );
        }
    }
}

/// A temporary workspace with these files.
fn workspace_of(files: &[(&str, &str)]) -> (tempfile::TempDir, Vec<Package>) {
    let place = tempfile::tempdir().unwrap();
    for (name, text) in files {
        let path = place.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }
    let packages = workspace(place.path());
    (place, packages)
}

const MANIFEST: (&str, &str) = ("Cargo.toml", "[package]\nname = \"one\"\n[workspace]\nmembers = []\n");

#[test]
fn a_cycle_is_found_through_nested_uses_inline_paths_and_re_exports() {
    let files = [
        MANIFEST,
        ("src/lib.rs", "mod a; mod b; mod c; mod d; pub use d::deep::Deep;"),
        (
            "src/a.rs",
            "use std::{fmt, crate_of::{x}}; use crate::{b::{self, Bee}};",
        ),
        (
            "src/b.rs",
            "pub struct Bee; fn f<'a>(x: &'a str) { super::c::go('\\'', \"{\"); }",
        ),
        // lib.rs re-exports `Deep`, which deep.rs declares.
        (
            "src/c.rs",
            "/* { /* */ */ pub(crate) fn go() -> crate::Deep { todo!() }",
        ),
        ("src/d.rs", "pub(crate) mod deep;"),
        (
            "src/d/deep.rs",
            "pub struct Deep; use super::super::a as first; const X: &str = r#\"\"}\"#;",
        ),
    ];
    let (place, packages) = workspace_of(&files);
    let wrong = wrong_cycles(place.path(), &packages);
    assert_eq!(
        wrong,
        ["a cycle (4 files, at most 3 are allowed):\n    \
          src/a.rs imports from src/b.rs\n    \
          src/b.rs imports from src/c.rs\n    \
          src/c.rs imports from src/d/deep.rs\n    \
          src/d/deep.rs imports from src/a.rs\n"]
    );
}

#[test]
fn a_small_cycle_is_allowed_only_in_one_folder_and_unit_tests_do_not_count() {
    let inside = [
        MANIFEST,
        ("src/main.rs", "mod a; mod other; fn main() { a::start() }"),
        (
            "src/a.rs",
            "mod b; pub(crate) use b::Bee; use crate::other; pub(crate) struct Ay;",
        ),
        ("src/a/b.rs", "pub(crate) struct Bee(super::Ay);"),
        (
            "src/other.rs",
            "#[cfg(test)] mod tests { use crate::a::Ay; } #[cfg(test)] use crate::{a, a::Ay};",
        ),
    ];
    let (place, packages) = workspace_of(&inside);
    assert_eq!(wrong_cycles(place.path(), &packages), [""; 0]);

    let mut outside = inside;
    outside[4].1 = "use crate::a::Bee;";
    let (place, packages) = workspace_of(&outside);
    let wrong = wrong_cycles(place.path(), &packages);
    assert!(
        wrong.len() == 1 && wrong[0].contains("it is not inside one folder"),
        "{wrong:?}"
    );
}

#[test]
fn forbidden_imports_are_found_in_manifests_and_sources() {
    let files = [
        (
            "Cargo.toml",
            "[workspace]\nmembers = [\"low\", \"high\"]\n[package]\nname = \"top\"\n[dependencies]\nhigh.workspace = true\n",
        ),
        ("src/main.rs", "use high_er::X; fn main() { high::run() }"),
        (
            "low/Cargo.toml",
            "[package]\nname = \"low\"\n[dependencies]\nhigh = { path = \"../high\" }\n",
        ),
        ("low/src/lib.rs", "fn f() -> ::high::Thing { top::f() }"),
        (
            "high/Cargo.toml",
            "[package]\nname = \"high\"\n[dev-dependencies]\nlow.workspace = true\n",
        ),
        ("high/src/lib.rs", "#[cfg(test)] mod tests { use low::f; }"),
    ];
    let (place, packages) = workspace_of(&files);
    let table: [(&str, &[&str]); 2] = [("top", &["high", "low"]), ("low", &[])];
    let mut wrong = wrong_crates(place.path(), &packages, &table);
    wrong.sort_unstable();
    assert_eq!(
        wrong,
        [
            "high is not in the table MAY_IMPORT",
            "low/src/lib.rs imports high",
            "low/src/lib.rs imports top",
            "the manifest of low depends on high",
        ]
    );
}
