//! No other crate knows an environment by its name: what there is to know, the trait says. Names stand in the thesis's own
//! figures and analysis, in lists of presets, and in tests.

use std::path::{Path, PathBuf};

use super::names;

/// Whose sources are searched. `reproduce` and `bench` run presets.
const SEARCHED: [&str; 9] = [
    "common/base/src",
    "common/channel/src",
    "common/policy/src",
    "common/src",
    "actor/src",
    "learner/src",
    "run/src",
    "report/src",
    "src",
];

const MAY_NAME_THEM: [&str; 6] = [
    "run/src/analysis",
    "run/src/plan.rs",
    "run/src/testing.rs",
    "report/src/figure",
    "report/src/figure.rs",
    "report/src/plots/thesis.rs",
];

/// The program of a source: without comments, and without tests.
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

/// The environments that a program treats apart: by their names as text, by their modules, or as a name in JavaScript.
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
fn no_environment_is_known_by_its_name() {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    for place in MAY_NAME_THEM {
        assert!(workspace.join(place).exists(), "{place} is elsewhere now");
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
        if is_test || !is_source || MAY_NAME_THEM.iter().any(|place| path.starts_with(place)) {
            continue;
        }
        searched += 1;
        let named = named_in(&code(&std::fs::read_to_string(&file).unwrap()));
        assert!(
            named.is_empty(),
            "{}: {named:?}: let the trait Environment say what is to be known of them",
            path.display()
        );
    }
    assert!(searched > 100, "{searched} files");
}

#[test]
fn a_name_in_a_program_is_found_and_one_in_a_comment_or_test_is_not() {
    for program in [
        "if name == \"point-mass\" {}\n",
        "use shoal_env_server::environment::point_mass::DT;\n",
        "const SCENES = {\n  \"point-mass\"(scene) {}\n};\n",
        "#[cfg(test)]\nmod tests {\n}\n\nfn of() -> &'static str {\n    \"point-mass\"\n}\n",
    ] {
        assert_eq!(named_in(&code(program)), ["point-mass"], "{program}");
    }
    for program in [
        "// if name == \"point-mass\" {}\n/* point_mass: */\n",
        "#[cfg(test)]\nmod tests {\n    const NAME: &str = \"point-mass\";\n}\n",
        "let label = \"a point-mass of 1 kg\";\n",
    ] {
        assert!(named_in(&code(program)).is_empty(), "{program}");
    }
}
