//! A suite: several runs in one directory that differ in their seed and in the values of some keys. `suite.json` says
//! what they are, so that a suite can be continued from any directory.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use shoal_common::file_lock;
use shoal_common::versioned_file::VersionedFile;

use crate::start;

/// Most runs in a suite.
const MOST: usize = 10_000;

/// Most characters of a run's name.
const NAME: usize = 200;

/// What a suite consists of: `suite.json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Suite {
    /// The preset, environment or file.
    pub what: String,
    /// The arguments of `train` that all runs have.
    pub arguments: Vec<String>,
    /// The runs.
    pub trials: Vec<Trial>,
}

/// A run of a suite.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Trial {
    /// The name of its directory.
    pub name: String,
    /// Its seed; `None` for that of the preset or file.
    pub seed: Option<u64>,
    /// What it has of its own, each as `SECTION.KEY=VALUE`.
    pub set: Vec<String>,
}

/// A key with the values that the runs of a suite have: `--sweep KEY=A,B,C`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sweep {
    key: String,
    values: Vec<String>,
}

impl Sweep {
    /// Reads `SECTION.KEY=A,B,C`. Commas within brackets and quotes do not separate values.
    ///
    /// # Errors
    /// When it does not look like that, or a value is named twice.
    pub fn parse(text: &str) -> Result<Self, String> {
        let form = || format!("--sweep {text}: must look like SECTION.KEY=A,B,C");
        let (key, values) = text
            .split_once('=')
            .filter(|(key, _)| key.contains('.'))
            .ok_or_else(form)?;
        if key == "run.seed" {
            return Err(format!("--sweep {text}: use --seeds for the seeds"));
        }
        let values = split(values);
        if values.iter().any(String::is_empty) {
            return Err(form());
        }
        let distinct: BTreeSet<&String> = values.iter().collect();
        if distinct.len() < values.len() {
            return Err(format!("--sweep {text}: names a value twice"));
        }
        Ok(Self {
            key: key.into(),
            values,
        })
    }
}

/// The parts between commas, without those within brackets and quotes.
fn split(text: &str) -> Vec<String> {
    let (mut parts, mut depth, mut quoted) = (vec![String::new()], 0_i32, false);
    for letter in text.chars() {
        match letter {
            '"' => quoted = !quoted,
            '[' | '{' if !quoted => depth += 1,
            ']' | '}' if !quoted => depth -= 1,
            ',' if !quoted && depth == 0 => {
                parts.push(String::new());
                continue;
            }
            _ => {}
        }
        if let Some(part) = parts.last_mut() {
            part.push(letter);
        }
    }
    parts.iter().map(|part| part.trim().to_owned()).collect()
}

/// Reads seeds: `1..5` for 1 to 5, `3` or `1,4,7`, and mixtures of these.
///
/// # Errors
/// When it is none of these, or names a seed twice.
pub fn seeds(text: &str) -> Result<Vec<u64>, String> {
    let form = || format!("{text}: must look like 1..5, which are five seeds, or 1,4,7");
    let mut seeds = Vec::new();
    for part in text.split(',') {
        let number = |text: &str| text.trim().parse::<u64>().map_err(|_| form());
        match part.split_once("..") {
            None => seeds.push(number(part)?),
            Some((first, last)) => {
                let (first, last) = (number(first)?, number(last)?);
                if last < first || last - first >= MOST as u64 {
                    return Err(form());
                }
                seeds.extend(first..=last);
            }
        }
    }
    let distinct: BTreeSet<u64> = seeds.iter().copied().collect();
    if distinct.len() < seeds.len() {
        return Err(format!("{text} names a seed twice"));
    }
    Ok(seeds)
}

impl VersionedFile for Suite {
    const FORMAT: u32 = 1;
}

impl Suite {
    /// The suite of all combinations of these values, each with every seed. Without seeds, each has that of the preset or
    /// file.
    ///
    /// # Errors
    /// When a key is swept twice, or there are too many runs.
    pub fn new(what: String, arguments: Vec<String>, sweeps: &[Sweep], seeds: &[u64]) -> anyhow::Result<Self> {
        for (i, sweep) in sweeps.iter().enumerate() {
            if sweeps[..i].iter().any(|other| other.key == sweep.key) {
                bail!("--sweep {} was given twice: give all of its values in one", sweep.key);
            }
        }
        let all = sweeps
            .iter()
            .map(|sweep| sweep.values.len())
            .try_fold(seeds.len().max(1), usize::checked_mul);
        if all.is_none_or(|all| all > MOST) {
            bail!("a suite of more than {MOST} runs: sweep fewer values");
        }
        let mut combinations: Vec<Vec<(&str, &str)>> = vec![Vec::new()];
        for Sweep { key, values } in sweeps {
            let mut more = Vec::new();
            for chosen in &combinations {
                for value in values {
                    more.push([chosen.as_slice(), &[(key.as_str(), value.as_str())]].concat());
                }
            }
            combinations = more;
        }
        let seeds: Vec<Option<u64>> = match seeds {
            [] => vec![None],
            seeds => seeds.iter().copied().map(Some).collect(),
        };
        let mut trials = Vec::new();
        for chosen in &combinations {
            for seed in &seeds {
                trials.push(Trial {
                    name: name(chosen, sweeps, *seed),
                    seed: *seed,
                    set: chosen.iter().map(|(key, value)| format!("{key}={value}")).collect(),
                });
            }
        }
        // Values that differ only in what a name cannot have.
        let names: BTreeSet<&String> = trials.iter().map(|trial| &trial.name).collect();
        if names.len() < trials.len() {
            let width = trials.len().to_string().len();
            for (number, trial) in (1..).zip(&mut trials) {
                trial.name = format!("{number:0width$}");
            }
        }
        Ok(Self {
            what,
            arguments,
            trials,
        })
    }

    /// The suite in this directory; `None` if there is none.
    ///
    /// # Errors
    /// When its file cannot be read.
    pub fn read(directory: &Path) -> anyhow::Result<Option<Self>> {
        let path = file(directory);
        let here = path.display();
        if !path.is_file() {
            return Ok(None);
        }
        let suite = Self::load(&path)?;
        let is_plain = |name: &str| !name.is_empty() && !name.contains('/') && name != "." && name != "..";
        if let Some(trial) = suite.trials.iter().find(|trial| !is_plain(&trial.name)) {
            bail!("{here} is damaged: {:?} is no name of a run", trial.name);
        }
        Ok(Some(suite))
    }

    /// Writes it into its directory.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, directory: &Path) -> anyhow::Result<()> {
        Ok(self.store(&file(directory))?)
    }

    /// The directories of its runs that exist.
    pub fn runs(&self, directory: &Path) -> Vec<PathBuf> {
        let runs = self.trials.iter().map(|trial| directory.join(&trial.name));
        runs.filter(|run| run.join("config.toml").is_file()).collect()
    }
}

/// Claims the suite in this directory for this process until the file is dropped.
///
/// # Errors
/// When another process works on it.
pub fn lock(directory: &Path) -> anyhow::Result<File> {
    let here = directory.display();
    let file = File::open(directory).with_context(|| format!("cannot open {here}"))?;
    if !file_lock::lock(&file, Duration::from_millis(200)).with_context(|| format!("cannot lock {here}"))? {
        bail!("another process works on the suite in {here}: wait for it, or end it");
    }
    Ok(file)
}

/// Removes what is left of a suite whose runs have been removed: its files and its report, and the directory if that is all
/// that it has.
///
/// # Errors
/// When a file cannot be removed.
pub fn remove(directory: &Path) -> std::io::Result<()> {
    let missing = |error: &std::io::Error| error.kind() == ErrorKind::NotFound;
    for file in [
        directory.join("report.html"),
        directory.join(start::FILE),
        file(directory),
    ] {
        std::fs::remove_file(file).or_else(|error| if missing(&error) { Ok(()) } else { Err(error) })?;
    }
    match std::fs::remove_dir(directory) {
        Err(error) if error.kind() == ErrorKind::DirectoryNotEmpty => Ok(()),
        removed => removed,
    }
}

fn file(directory: &Path) -> PathBuf {
    directory.join("suite.json")
}

/// The name of a run: its own values and its seed, as far as a file name can have them.
fn name(chosen: &[(&str, &str)], sweeps: &[Sweep], seed: Option<u64>) -> String {
    let last = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
    let short = |key: &str| {
        let alike = sweeps.iter().filter(|other| last(&other.key) == last(key)).count();
        if alike > 1 { key.to_owned() } else { last(key) }
    };
    let values = chosen
        .iter()
        .map(|(key, value)| format!("{}={}", short(key), value.replace(' ', "")));
    let parts: Vec<String> = values.chain(seed.map(|seed| format!("seed={seed}"))).collect();
    let is_plain = |c: char| c.is_alphanumeric() || "=,._-+[]".contains(c);
    let name: String = parts
        .join(",")
        .chars()
        .map(|c| if is_plain(c) { c } else { '-' })
        .collect();
    let name: String = name.chars().take(NAME).collect();
    match name.trim_start_matches('.') {
        "" => "run".into(),
        name => name.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_suite_has_every_combination_with_every_seed() {
        let sweeps = ["ddpg.tau=0.001,0.005", "ddpg.hidden=[64, 48],[8]"].map(|text| Sweep::parse(text).unwrap());
        let suite = Suite::new("pendulum".into(), vec![], &sweeps, &seeds("1..3").unwrap()).unwrap();
        assert_eq!(suite.trials.len(), 12);
        assert_eq!(suite.trials[0].name, "tau=0.001,hidden=[64,48],seed=1");
        assert_eq!(suite.trials[0].set, ["ddpg.tau=0.001", "ddpg.hidden=[64, 48]"]);
        assert_eq!(
            (suite.trials[11].seed, suite.trials[11].name.as_str()),
            (Some(3), "tau=0.005,hidden=[8],seed=3")
        );

        let parent = tempfile::tempdir().unwrap();
        assert_eq!(Suite::read(parent.path()).unwrap(), None);
        suite.write(parent.path()).unwrap();
        assert_eq!(Suite::read(parent.path()).unwrap().unwrap(), suite);
        assert!(suite.runs(parent.path()).is_empty());
        let text = std::fs::read_to_string(file(parent.path())).unwrap();
        std::fs::write(
            file(parent.path()),
            text.replace("tau=0.001,hidden=[64,48],seed=1", "../elsewhere"),
        )
        .unwrap();
        assert!(
            Suite::read(parent.path())
                .unwrap_err()
                .to_string()
                .contains("no name of a run")
        );

        let alone = Suite::new("pendulum".into(), vec![], &[], &[4]).unwrap();
        assert_eq!(alone.trials[0].name, "seed=4");
    }

    #[test]
    fn keys_with_the_same_last_word_are_told_apart_and_names_are_file_names() {
        let sweeps = ["sac.tau=1", "other.tau=a/b"].map(|text| Sweep::parse(text).unwrap());
        let suite = Suite::new("x".into(), vec![], &sweeps, &[]).unwrap();
        assert_eq!(
            (suite.trials[0].name.as_str(), suite.trials[0].seed),
            ("sac.tau=1,other.tau=a-b", None)
        );
        let alike = Sweep::parse("x.a=a/b,a:b").unwrap();
        let suite = Suite::new("x".into(), vec![], &[alike], &[]).unwrap();
        assert_eq!([&suite.trials[0].name, &suite.trials[1].name], ["1", "2"]);
    }

    #[test]
    fn seeds_and_sweeps_are_read_as_people_write_them() {
        assert_eq!(seeds("1..5"), Ok(vec![1, 2, 3, 4, 5]));
        assert_eq!(seeds("3"), Ok(vec![3]));
        assert_eq!(seeds("7,1..2"), Ok(vec![7, 1, 2]));
        for text in ["", "5..1", "1..", "x", "1,1", "1..3,2", "-1", "1..99999999"] {
            assert!(seeds(text).is_err(), "{text}");
        }
        for text in [
            "tau=1",
            "ddpg.tau",
            "ddpg.tau=",
            "ddpg.tau=1,,2",
            "ddpg.tau=1,1",
            "run.seed=1,2",
        ] {
            assert!(Sweep::parse(text).is_err(), "{text}");
        }
        let twice = ["a.b=1", "a.b=2"].map(|text| Sweep::parse(text).unwrap());
        assert!(Suite::new("x".into(), vec![], &twice, &[]).is_err());
    }
}
