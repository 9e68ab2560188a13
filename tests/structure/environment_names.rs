//! Checks that no other crate refers to an environment by its name: the trait provides what they need. Exceptions are
//! the thesis's figures and analysis, lists of presets, and tests.

use std::path::{Path, PathBuf};

use shoal_env_server::environment::names;

use crate::root;

/// The directories that are searched. `reproduce` and `bench` are not: they run presets.
const SEARCHED: [&str; 10] = [
    "common/base/src",
    "common/channel/src",
    "common/policy/src",
    "common/src",
    "actor/src",
    "learner/src",
    "remote/src",
    "run/src",
    "report/src",
    "src",
];

const ALLOWED: [&str; 6] = [
    "run/src/evaluation/analysis",
    "run/src/plan/presets.rs",
    "run/src/testing.rs",
    "report/src/figure",
    "report/src/figure.rs",
    "report/src/plots/thesis.rs",
];

/// A source without its comments and tests.
fn code(source: &str) -> String {
    let mut code = String::new();
    let mut lines = source.lines().peekable();
    while let Some(line) = lines.next() {
        let tests = line == "#[cfg(test)]"
            && lines
                .peek()
                .is_some_and(|next| next.starts_with("mod ") && next.ends_with('{'));
        if tests {
            lines.by_ref().find(|line| *line == "}");
        } else if !["//", "/*", "* "]
            .iter()
            .any(|mark| line.trim_start().starts_with(mark))
        {
            code += line;
            code += "\n";
        }
    }
    code
}

/// The environments that `code` refers to: by their names as text, by their modules, or as a name in JavaScript.
fn named_in(code: &str) -> Vec<&'static str> {
    let is_named = |name: &&str| {
        let module = name.replace('-', "_");
        let text = ['"', '\'', '`'].map(|quote| format!("{quote}{name}{quote}"));
        let uses = [':', '('].map(|after| format!("{module}{after}"));
        text.iter().chain(&uses).any(|part| code.contains(part.as_str()))
    };
    names().filter(is_named).collect()
}

fn files_below(directory: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files_below(&path, into);
        } else {
            into.push(path);
        }
    }
}

#[test]
fn no_other_crate_refers_to_an_environment_by_name() {
    let workspace = root();
    for place in ALLOWED {
        assert!(
            workspace.join(place).exists(),
            "{place} does not exist: correct the list"
        );
    }
    let mut files = Vec::new();
    for place in SEARCHED {
        files_below(&workspace.join(place), &mut files);
    }
    let mut searched = 0;
    for file in files {
        let path = file.strip_prefix(workspace).unwrap();
        let is_test = path.components().any(|part| part.as_os_str() == "tests") || path.ends_with("tests.rs");
        let is_source = path
            .extension()
            .is_some_and(|kind| kind == "rs" || kind == "js" || kind == "html");
        if is_test || !is_source || ALLOWED.iter().any(|place| path.starts_with(place)) {
            continue;
        }
        searched += 1;
        let named = named_in(&code(&std::fs::read_to_string(&file).unwrap()));
        assert!(
            named.is_empty(),
            "{}: refers to {named:?}: use the trait Environment instead",
            path.display()
        );
    }
    assert!(searched > 100, "{searched} files");
}

#[test]
fn names_are_found_in_code_but_not_in_comments_or_tests() {
    for source in [
        "if name == \"point-mass\" {}\n",
        "use shoal_env_server::environment::point_mass::DT;\n",
        "const SCENES = {\n  \"point-mass\"(scene) {}\n};\n",
        "#[cfg(test)]\nmod tests {\n}\n\nfn of() -> &'static str {\n    \"point-mass\"\n}\n",
    ] {
        assert_eq!(named_in(&code(source)), ["point-mass"], "{source}");
    }
    for source in [
        "// if name == \"point-mass\" {}\n/* point_mass: */\n",
        "#[cfg(test)]\nmod tests {\n    const NAME: &str = \"point-mass\";\n}\n",
        "let label = \"a point-mass of 1 kg\";\n",
    ] {
        assert!(named_in(&code(source)).is_empty(), "{source}");
    }
}
