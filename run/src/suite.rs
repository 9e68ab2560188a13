//! A suite: several runs in one directory that differ in their seed and in the values of some keys. `suite.json` says
//! what they are, so that a suite can be continued from any directory.

pub mod configuration;
pub mod measure;
pub mod schedule;

use std::collections::BTreeSet;
use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use shoal_common::file_lock;
use shoal_common::versioned_file::VersionedFile;

use crate::files::remove_if_any;
use crate::records::start;

/// The most runs that a suite has.
const MAX_RUNS: usize = 10_000;

/// The most characters that a run's name has.
const MAX_NAME_LENGTH: usize = 200;

/// What a suite consists of: `suite.json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Suite {
    /// The preset, environment or file.
    pub what: String,
    /// The arguments of `train` that all runs have.
    pub arguments: Vec<String>,
    /// The runs.
    pub trials: Vec<Trial>,
    /// Changes of all runs by `resume --set`, each as `SECTION.KEY=VALUE`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub changes: Vec<String>,
    /// Whether bad settings are ended early, and which were.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub halving: Option<Halving>,
}

/// Successive halving (Jamieson and Talwalkar 2016): after each round the worse half of the settings is ended. The last
/// one is trained to the end. With n rounds, the first ends when each run has done 1/2ⁿ of its steps, and each further
/// one when it has done twice as many.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Halving {
    /// The names of the runs that each completed round has ended.
    pub ended: Vec<Vec<String>>,
}

/// A round of a suite with halving.
#[derive(Clone, Debug, PartialEq)]
pub struct Round {
    /// The runs that are left.
    pub trials: Vec<Trial>,
    /// The share of its steps that each has done at the end of the round.
    pub share: f64,
}

/// A run of a suite.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Trial {
    /// The name of its directory.
    pub name: String,
    /// Its seed; `None` for the preset's or the file's.
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
                if last < first || last - first >= MAX_RUNS as u64 {
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
    /// The suite of all combinations of these values, each with every seed. Without seeds, each has the seed of the
    /// preset or file.
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
        if all.is_none_or(|all| all > MAX_RUNS) {
            bail!("a suite of more than {MAX_RUNS} runs: sweep fewer values");
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
        // If values differ only in characters that a file name cannot have, the runs are numbered.
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
            changes: Vec::new(),
            halving: None,
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
            bail!("{here} is damaged: {:?} is not a valid name for a run", trial.name);
        }
        Ok(Some(suite))
    }

    /// As [`read`](Self::read), for a directory that had a suite before it was [locked](lock): until then another process
    /// may have removed it.
    ///
    /// # Errors
    /// When its file is missing or cannot be read.
    pub fn open(directory: &Path) -> anyhow::Result<Self> {
        Self::read(directory)?.with_context(|| format!("{} is no longer a suite", directory.display()))
    }

    /// Adds changes of all runs, each as `SECTION.KEY=VALUE`. A later value of a key replaces an earlier one.
    ///
    /// # Errors
    /// When the runs differ in such a key, because then the change would make them alike.
    pub fn change(&mut self, changes: &[String]) -> Result<(), String> {
        let key = |assignment: &str| assignment.split('=').next().unwrap_or_default().trim().to_owned();
        for change in changes {
            let key_of_change = key(change);
            let sets_it = |assignment: &String| key(assignment) == key_of_change;
            if key_of_change == "run.seed" || self.trials.iter().any(|trial| trial.set.iter().any(sets_it)) {
                return Err(format!("{key_of_change}: the runs of this suite differ in it"));
            }
            self.changes.retain(|earlier| key(earlier) != key_of_change);
            self.changes.push(change.clone());
        }
        Ok(())
    }

    /// The settings. Each is the list of its runs' numbers, which differ only in their seed.
    fn settings(&self) -> Vec<Vec<usize>> {
        let mut settings: Vec<Vec<usize>> = Vec::new();
        for (number, trial) in self.trials.iter().enumerate() {
            match settings.iter_mut().find(|of| self.trials[of[0]].set == trial.set) {
                Some(same) => same.push(number),
                None => settings.push(vec![number]),
            }
        }
        settings
    }

    /// Ends bad settings early from now on.
    ///
    /// # Errors
    /// When there is only one setting.
    pub fn with_halving(mut self) -> Result<Self, String> {
        if self.settings().len() < 2 {
            return Err("--halving ends the worse half of the settings: give several with --sweep".into());
        }
        self.halving = Some(Halving::default());
        Ok(self)
    }

    /// Whether a run was ended early.
    pub fn was_ended_early(&self, trial: &Trial) -> bool {
        let ended = self.halving.iter().flat_map(|halving| halving.ended.iter().flatten());
        ended.into_iter().any(|name| *name == trial.name)
    }

    /// The first round that has not ended; `None` without halving, and after the last round.
    pub fn next_round(&self) -> Option<Round> {
        let completed = self.halving.as_ref()?.ended.len() as u32;
        let rounds = self.settings().len().next_power_of_two().ilog2();
        (completed < rounds).then(|| Round {
            trials: self
                .trials
                .iter()
                .filter(|trial| !self.was_ended_early(trial))
                .cloned()
                .collect(),
            share: 0.5_f64.powi((rounds - completed) as i32),
        })
    }

    /// Ends the worse half of the settings that are left: the settings with the lower mean of `result` over their runs.
    /// Runs whose result is not finite do not count. Returns the names of the ended runs.
    pub fn end_worse_half(&mut self, result: impl Fn(&Trial) -> f64) -> Vec<String> {
        let mut left = self.settings();
        left.retain(|setting| !self.was_ended_early(&self.trials[setting[0]]));
        let mean = |setting: &Vec<usize>| {
            let results = setting.iter().map(|number| result(&self.trials[*number]));
            let results: Vec<f64> = results.filter(|result| result.is_finite()).collect();
            match results.len() {
                0 => f64::NEG_INFINITY,
                n => results.iter().sum::<f64>() / n as f64,
            }
        };
        // The first of equal ones stays.
        left.sort_by(|a, b| mean(b).total_cmp(&mean(a)));
        let worse = left.split_off(left.len().div_ceil(2));
        let ended: Vec<String> = worse
            .concat()
            .iter()
            .map(|number| self.trials[*number].name.clone())
            .collect();
        if let Some(halving) = &mut self.halving {
            halving.ended.push(ended.clone());
        }
        ended
    }

    /// Whether the other suite was made in the same way, whatever has been changed since.
    pub fn has_same_runs(&self, other: &Self) -> bool {
        let made = |it: &Self| {
            (
                it.what.clone(),
                it.arguments.clone(),
                it.trials.clone(),
                it.halving.is_some(),
            )
        };
        made(self) == made(other)
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
    if !file_lock::lock(&file, file_lock::RELEASE_TIMEOUT).with_context(|| format!("cannot lock {here}"))? {
        bail!("another process works on the suite in {here}: wait for it, or end it");
    }
    Ok(file)
}

/// Removes what is left of a suite whose runs have been removed: its files and its report, and the directory if that is
/// all that it has.
///
/// # Errors
/// When a file cannot be removed.
pub fn remove(directory: &Path) -> anyhow::Result<()> {
    for file in [
        directory.join("report.html"),
        directory.join(start::FILE),
        file(directory),
    ] {
        remove_if_any(&file)?;
    }
    match std::fs::remove_dir(directory) {
        Err(error) if error.kind() == ErrorKind::DirectoryNotEmpty => Ok(()),
        removed => removed.with_context(|| format!("cannot remove {}", directory.display())),
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
    let name: String = name.chars().take(MAX_NAME_LENGTH).collect();
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
                .contains("not a valid name for a run")
        );

        let mut changed = suite.clone();
        changed
            .change(&["run.steps=9".into(), "ddpg.gamma=0.5".into()])
            .unwrap();
        changed.change(&["run.steps=10".into()]).unwrap();
        assert_eq!(changed.changes, ["ddpg.gamma=0.5", "run.steps=10"]);
        assert!(changed.has_same_runs(&suite) && changed != suite);
        for key in ["ddpg.tau", "run.seed"] {
            assert!(
                changed
                    .change(&[format!("{key}=1")])
                    .unwrap_err()
                    .contains("differ in it")
            );
        }

        let alone = Suite::new("pendulum".into(), vec![], &[], &[4]).unwrap();
        assert_eq!(alone.trials[0].name, "seed=4");
    }

    #[test]
    fn each_round_ends_the_worse_half_of_the_settings() {
        let sweep = Sweep::parse("ddpg.tau=1,2,3,4,5").unwrap();
        let suite = Suite::new("x".into(), vec![], &[sweep], &[1, 2]).unwrap();
        assert_eq!(suite.next_round(), None);
        let mut suite = suite.with_halving().unwrap();
        // The result is τ, and the third setting has none.
        let result = |trial: &Trial| match trial.name.as_bytes()[4] {
            b'3' => f64::NEG_INFINITY,
            tau => f64::from(tau),
        };
        let mut rounds = Vec::new();
        while let Some(round) = suite.next_round() {
            suite = serde_json::from_str(&serde_json::to_string(&suite).unwrap()).unwrap();
            rounds.push((round.share, round.trials.len(), suite.end_worse_half(result)));
        }
        let names = |settings: &[u32]| -> Vec<String> {
            let of = |tau: &u32| [1, 2].map(|seed| format!("tau={tau},seed={seed}"));
            settings.iter().flat_map(of).collect()
        };
        assert_eq!(
            rounds,
            [
                (0.125, 10, names(&[1, 3])),
                (0.25, 6, names(&[2])),
                (0.5, 4, names(&[4]))
            ]
        );
        let left: Vec<&Trial> = suite
            .trials
            .iter()
            .filter(|trial| !suite.was_ended_early(trial))
            .collect();
        assert_eq!(
            left.iter().map(|trial| &trial.name).collect::<Vec<_>>(),
            ["tau=5,seed=1", "tau=5,seed=2"]
        );
        assert!(
            Suite::new("x".into(), vec![], &[], &[1, 2])
                .unwrap()
                .with_halving()
                .is_err()
        );
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
