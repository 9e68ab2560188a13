//! Parses the parts of Rust sources that matter for imports: modules, `use` trees, and paths that begin with a module.
//! Test code (`#[cfg(test)]`) is left out.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// A word, or one character of punctuation.
type Token = String;

/// The names that a module imports: from its local name to the path of the item.
type Names = BTreeMap<String, Vec<String>>;

/// One crate, read from its root file.
#[derive(Default)]
pub(crate) struct Sources {
    modules: BTreeMap<Vec<String>, Module>,
    /// First segments of paths that do not begin with a module of the crate (crates, types, functions), with the files
    /// that use them.
    pub(crate) foreign: BTreeMap<String, BTreeSet<PathBuf>>,
}

/// A module, inline or a file.
#[derive(Default)]
struct Module {
    file: PathBuf,
    imported: Names,
    /// Paths as written in this module.
    paths: BTreeSet<Vec<String>>,
}

/// From a file to the files that it imports from.
pub(crate) type Imports = BTreeMap<PathBuf, BTreeSet<PathBuf>>;

impl Sources {
    /// Reads a crate. Files are named relative to `base`.
    pub(crate) fn read(base: &Path, root: &Path) -> Self {
        let mut sources = Self::default();
        let directory = root.parent().unwrap().to_owned();
        sources.read_file(base, root, &directory, Vec::new());
        sources
    }

    /// Reads a module's file. The files of its submodules are in `directory`.
    fn read_file(&mut self, base: &Path, file: &Path, directory: &Path, module: Vec<String>) {
        let text = std::fs::read_to_string(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        let tokens = tokens(&text);
        let name = file.strip_prefix(base).unwrap().to_owned();
        let mut children = Vec::new();
        self.read_items(&tokens, &name, module, &mut children);
        for child in children {
            let below = directory.join(child.last().unwrap());
            let flat = below.with_extension("rs");
            let file = if flat.exists() { flat } else { below.join("mod.rs") };
            self.read_file(base, &file, &below, child);
        }
    }

    /// Reads the items of one module. Submodules in files of their own are added to `children`.
    fn read_items(&mut self, tokens: &[Token], file: &Path, module: Vec<String>, children: &mut Vec<Vec<String>>) {
        let known = self.modules.entry(module.clone()).or_default();
        known.file = file.to_owned();
        let mut at = 0;
        while at < tokens.len() {
            let word = tokens[at].as_str();
            if starts_test_code(&tokens[at..]) {
                at = after_item(tokens, at);
            } else if word == "use" {
                let end = at + tokens[at..].iter().position(|token| token == ";").unwrap();
                let known = self.modules.get_mut(&module).unwrap();
                use_tree(&tokens[at + 1..end], &[], &mut |name, path| {
                    known.paths.insert(path.clone());
                    known.imported.insert(name, path);
                });
                at = end;
            } else if word == "mod" && is_name(tokens.get(at + 1)) {
                let child = [&module[..], &[tokens[at + 1].clone()]].concat();
                if tokens[at + 2] == "{" {
                    let end = closing(tokens, at + 2);
                    assert!(
                        !tokens[at + 3..end].windows(3).any(|it| it[0] == "mod" && it[2] == ";"),
                        "{}: this test does not support a module file below an inline module",
                        file.display()
                    );
                    self.read_items(&tokens[at + 3..end], file, child, children);
                    at = end;
                } else {
                    children.push(child);
                    at += 2;
                }
            } else if is_name(Some(&tokens[at])) && tokens.get(at + 1).is_some_and(|token| token == "::") {
                let mut path = vec![tokens[at].clone()];
                while tokens.get(at + 1).is_some_and(|token| token == "::") && is_name(tokens.get(at + 2)) {
                    path.push(tokens[at + 2].clone());
                    at += 2;
                }
                self.modules.get_mut(&module).unwrap().paths.insert(path);
            }
            at += 1;
        }
    }

    /// Which file imports from which. Also fills [`Self::foreign`].
    pub(crate) fn imports(&mut self) -> Imports {
        let mut imports = Imports::new();
        let mut foreign: BTreeMap<String, BTreeSet<PathBuf>> = BTreeMap::new();
        for (name, module) in &self.modules {
            let targets = imports.entry(module.file.clone()).or_default();
            for path in &module.paths {
                match self.file_of(name, path, 0) {
                    Some(file) if *file == module.file => {}
                    Some(file) => drop(targets.insert(file.clone())),
                    None => drop(foreign.entry(path[0].clone()).or_default().insert(module.file.clone())),
                }
            }
        }
        self.foreign = foreign;
        imports
    }

    /// The file that declares the item of a path in a module; imported names are followed to their origin. `None` for
    /// items of other crates.
    fn file_of(&self, module: &[String], path: &[String], depth: u32) -> Option<&PathBuf> {
        // Limits the recursion for cyclic `use` declarations, which the compiler refuses anyway.
        if depth > 16 {
            return None;
        }
        let mut here = module.to_vec();
        let mut rest = path;
        match path[0].as_str() {
            "crate" => (here, rest) = (Vec::new(), &path[1..]),
            "self" => rest = &path[1..],
            "super" => {}
            first => {
                let child = [module, &path[..1]].concat();
                let imported = self.modules[module].imported.get(first);
                if let Some(origin) = imported.filter(|origin| *origin != path && origin[..] != path[..1]) {
                    return self.file_of(module, &[&origin[..], &path[1..]].concat(), depth + 1);
                }
                if !self.modules.contains_key(&child) {
                    return None;
                }
            }
        }
        while let Some((first, others)) = rest.split_first() {
            if first == "super" {
                here.pop()?;
                rest = others;
                continue;
            }
            let child = [&here[..], &rest[..1]].concat();
            if self.modules.contains_key(&child) {
                (here, rest) = (child, others);
                continue;
            }
            // A re-export of this module.
            if let Some(origin) = self.modules[&here].imported.get(first) {
                let origin = [&origin[..], others].concat();
                let is_of_this_crate = self.file_of(&here, &origin, depth + 1);
                return is_of_this_crate.or(Some(&self.modules[&here].file));
            }
            break;
        }
        Some(&self.modules[&here].file)
    }
}

fn is_name(token: Option<&Token>) -> bool {
    token.is_some_and(|token| token.starts_with(|c: char| c.is_alphabetic() || c == '_'))
}

fn starts_test_code(tokens: &[Token]) -> bool {
    let starts = |words: &[&str]| tokens.iter().take(words.len()).eq(words.iter());
    starts(&["#", "[", "cfg", "(", "test", ")"]) || starts(&["#", "[", "test", "]"])
}

/// The last token of the item whose first attribute begins here.
fn after_item(tokens: &[Token], mut at: usize) -> usize {
    while tokens[at] == "#" {
        at = closing(tokens, at + 1) + 1;
    }
    // Skips the visibility, which may be `pub(crate)`.
    if tokens[at] == "pub" {
        at += 1;
        if tokens[at] == "(" {
            at = closing(tokens, at) + 1;
        }
    }
    let is_use = tokens[at] == "use";
    while at < tokens.len() && tokens[at] != ";" {
        if tokens[at] == "{" && !is_use {
            return closing(tokens, at);
        }
        at += 1;
    }
    at
}

/// The index of the bracket that closes the one at `opening`.
fn closing(tokens: &[Token], opening: usize) -> usize {
    let mut depth = 0;
    for (at, token) in tokens.iter().enumerate().skip(opening) {
        match token.as_str() {
            "{" | "[" | "(" => depth += 1,
            "}" | "]" | ")" => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return at;
        }
    }
    panic!("a bracket is not closed")
}

/// Reports every name that a `use` imports, with its path. The names of a glob are unknown here, so it counts as an
/// import of the module itself.
fn use_tree(tokens: &[Token], before: &[String], found: &mut impl FnMut(String, Vec<String>)) {
    let mut path = before.to_vec();
    let mut at = 0;
    while at < tokens.len() {
        match tokens[at].as_str() {
            "::" => {}
            "{" => {
                let end = closing(tokens, at);
                let mut start = at + 1;
                let mut depth = 0;
                for (place, token) in tokens.iter().enumerate().take(end + 1).skip(at + 1) {
                    match token.as_str() {
                        "{" => depth += 1,
                        "}" if place < end => depth -= 1,
                        _ => {}
                    }
                    if place == end || (depth == 0 && token == ",") {
                        if start < place {
                            use_tree(&tokens[start..place], &path, found);
                        }
                        start = place + 1;
                    }
                }
                return;
            }
            "as" => return found(tokens[at + 1].clone(), path),
            "*" => return found(format!("* of {}", path.join("::")), path),
            "self" if !path.is_empty() => {}
            name => path.push(name.to_owned()),
        }
        at += 1;
    }
    found(path.last().unwrap().clone(), path);
}

/// The words and punctuation of a source text, without comments, strings, characters and lifetimes.
fn tokens(text: &str) -> Vec<Token> {
    let text: Vec<char> = text.chars().collect();
    let is_word = |at: usize| text.get(at).is_some_and(|c| c.is_alphanumeric() || *c == '_');
    let starts = |at: usize, what: &str| what.chars().enumerate().all(|(i, c)| text.get(at + i) == Some(&c));
    let mut tokens = Vec::new();
    let mut at = 0;
    while at < text.len() {
        if starts(at, "//") {
            while at < text.len() && text[at] != '\n' {
                at += 1;
            }
        } else if starts(at, "/*") {
            let mut depth = 0;
            loop {
                if starts(at, "/*") {
                    (depth, at) = (depth + 1, at + 2);
                } else if starts(at, "*/") {
                    (depth, at) = (depth - 1, at + 2);
                } else {
                    at += 1;
                }
                if depth == 0 {
                    break;
                }
            }
        } else if let Some(end) = raw_string(&text, at) {
            at = end;
        } else if text[at] == '"' {
            at += 1;
            while text[at] != '"' {
                at += if text[at] == '\\' { 2 } else { 1 };
            }
            at += 1;
        } else if text[at] == '\'' {
            if text[at + 1] == '\\' {
                at += 3;
                while text[at] != '\'' {
                    at += 1;
                }
                at += 1;
            } else if text.get(at + 2) == Some(&'\'') {
                at += 3;
            } else {
                // A lifetime.
                at += 1;
                while is_word(at) {
                    at += 1;
                }
            }
        } else if is_word(at) {
            let start = at;
            while is_word(at) {
                at += 1;
            }
            tokens.push(text[start..at].iter().collect());
        } else if starts(at, "::") {
            tokens.push("::".into());
            at += 2;
        } else {
            if !text[at].is_whitespace() {
                tokens.push(text[at].to_string());
            }
            at += 1;
        }
    }
    tokens
}

/// The end of the raw string that begins at `start`; `None` if none begins there.
fn raw_string(text: &[char], start: usize) -> Option<usize> {
    let mut at = start;
    if text[at] == 'b' {
        at += 1;
    }
    if text.get(at) != Some(&'r') {
        return None;
    }
    at += 1;
    let hashes = text[at..].iter().take_while(|c| **c == '#').count();
    at += hashes;
    if text.get(at) != Some(&'"') {
        return None;
    }
    let is_end = |at: usize| text[at] == '"' && (1..=hashes).all(|i| text.get(at + i) == Some(&'#'));
    let end = (at + 1..text.len()).find(|at| is_end(*at))?;
    Some(end + hashes + 1)
}
