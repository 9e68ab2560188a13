//! The results of an experiment: one file, `<experiment>.jsonl.gz`. Its first line is the [`FirstLine`]; every other
//! line is the result of one seed and milestone, ordered by seed and milestone.
//!
//! Earlier versions stored each result in its own file, `<experiment>/seed-N<suffix>.json`. Such files are still read,
//! and [`ResultsFile::move_old_results`] moves them into the new file.

use std::collections::BTreeMap;
use std::collections::btree_map;
use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use flate2::Compression;
use flate2::read::MultiGzDecoder;
use flate2::write::GzEncoder;
use serde::{Deserialize, Serialize};
use shoal_common::durable::write_atomically;

use super::experiment::{Experiment, Milestone};

/// The version of the file format. Increase it with every change. Format 1 had a file for each result.
const FORMAT: u32 = 2;

/// The first line of the file.
#[derive(Debug, Serialize, Deserialize)]
struct FirstLine {
    format: u32,
    experiment: String,
}

/// Identifies a result of an experiment.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
struct Key {
    seed: u64,
    /// The milestone's suffix.
    #[serde(rename = "stage")]
    milestone: String,
}

/// A result as it is stored.
#[derive(Debug)]
pub(super) struct ResultLine {
    /// JSON on one line. It is copied and never formatted again, so that every digit is kept.
    pub(super) text: String,
    /// Where it is stored, for messages.
    pub(super) place: String,
    /// Its own file in the old format, if it still has one.
    old: Option<PathBuf>,
}

#[cfg(test)]
impl ResultLine {
    pub(super) fn at(place: &str, text: &str) -> Self {
        Self {
            text: text.into(),
            place: place.into(),
            old: None,
        }
    }
}

/// All results of an experiment.
#[derive(Debug)]
pub(super) struct ResultsFile {
    path: PathBuf,
    /// The directory of the runs and of results in the old format.
    directory: PathBuf,
    first_line: FirstLine,
    lines: BTreeMap<Key, ResultLine>,
}

impl ResultsFile {
    /// Reads the experiment's results in a folder, in either format. There may be none.
    pub(super) fn read(folder: &Path, experiment: &Experiment) -> anyhow::Result<Self> {
        let mut results = Self {
            path: folder.join(format!("{}.jsonl.gz", experiment.name)),
            directory: folder.join(experiment.name),
            first_line: FirstLine {
                format: FORMAT,
                experiment: experiment.name.into(),
            },
            lines: BTreeMap::new(),
        };
        match File::open(&results.path) {
            Ok(file) => results.unpack(file)?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(error).with_context(|| format!("cannot read {}", results.path.display())),
        }
        for milestone in experiment.milestones {
            let ending = format!("{}.json", milestone.suffix);
            for seed in numbered(&results.directory, &ending)? {
                results.read_old(seed, &ending, milestone)?;
            }
        }
        Ok(results)
    }

    fn unpack(&mut self, file: File) -> anyhow::Result<()> {
        let here = self.path.display().to_string();
        let hint = "restore it, or move it away, and its results will be made again";
        let damaged = || format!("{here} is damaged or not a results file of this program: {hint}");
        let mut text = String::new();
        MultiGzDecoder::new(file)
            .read_to_string(&mut text)
            .with_context(damaged)?;
        let mut lines = text.lines();
        /// The key that the first line has in every format.
        #[derive(Deserialize)]
        struct Versioned {
            format: u32,
        }
        let first_line = lines.next().unwrap_or_default();
        let Versioned { format } = serde_json::from_str(first_line).with_context(damaged)?;
        if format != FORMAT {
            bail!(
                "{here} has format {format}; this program reads format {FORMAT}: choose another directory with --out"
            );
        }
        let first_line: FirstLine = serde_json::from_str(first_line).with_context(damaged)?;
        if first_line.experiment != self.first_line.experiment {
            bail!("{here} contains the results of {}: {hint}", first_line.experiment);
        }
        for text in lines {
            let key: Key = serde_json::from_str(text).with_context(damaged)?;
            let place = place(&self.path, &key);
            let line = ResultLine {
                text: text.into(),
                place: place.clone(),
                old: None,
            };
            if self.lines.insert(key, line).is_some() {
                bail!("{place} occurs twice: {hint}");
            }
        }
        Ok(())
    }

    /// Reads a result in the old format.
    fn read_old(&mut self, seed: u64, ending: &str, milestone: &Milestone) -> anyhow::Result<()> {
        let path = self.directory.join(format!("seed-{seed}{ending}"));
        let here = path.display();
        let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {here}"))?;
        let (key, text) = line(&text, milestone).with_context(|| {
            format!("{here} is not a result of this program: move it away, and the result will be made again")
        })?;
        if key.seed != seed {
            bail!(
                "{here} is the result of seed {}: rename it back, or move it away",
                key.seed
            );
        }
        match self.lines.entry(key) {
            btree_map::Entry::Vacant(vacant) => {
                vacant.insert(ResultLine {
                    text,
                    place: here.to_string(),
                    old: Some(path),
                });
            }
            // A command was killed after it had written the new file and before it removed this one.
            btree_map::Entry::Occupied(mut stored) if stored.get().text == text => stored.get_mut().old = Some(path),
            btree_map::Entry::Occupied(stored) => {
                bail!("{here} and {} differ: move one of them away", stored.get().place)
            }
        }
        Ok(())
    }

    /// Moves results in the old format into the new file. Old files are removed only when the new one is on the disk.
    pub(super) fn move_old_results(&mut self) -> anyhow::Result<()> {
        let old: Vec<PathBuf> = self.lines.values_mut().filter_map(|line| line.old.take()).collect();
        if old.is_empty() {
            return Ok(());
        }
        self.write()?;
        for path in &old {
            std::fs::remove_file(path).with_context(|| format!("cannot remove {}", path.display()))?;
        }
        // The directory remains if it contains runs.
        let _ = std::fs::remove_dir(&self.directory);
        for (key, line) in &mut self.lines {
            line.place = place(&self.path, key);
        }
        Ok(())
    }

    /// Adds a result, which is a JSON object, and writes the file.
    pub(super) fn add(&mut self, result: &str, milestone: &Milestone) -> anyhow::Result<()> {
        let (key, text) = line(result, milestone)?;
        let place = place(&self.path, &key);
        self.lines.insert(key.clone(), ResultLine { text, place, old: None });
        let written = self.write();
        if written.is_err() {
            self.lines.remove(&key);
        }
        written
    }

    /// Whether there is a result for this seed and milestone.
    pub(super) fn has(&self, milestone: &Milestone, seed: u64) -> bool {
        self.of(milestone).any(|(found, _)| found == seed)
    }

    /// Seeds and results of a milestone, ordered by seed.
    pub(super) fn of(&self, milestone: &Milestone) -> impl Iterator<Item = (u64, &ResultLine)> {
        self.lines
            .iter()
            .filter(|(key, _)| key.milestone == milestone.suffix)
            .map(|(key, line)| (key.seed, line))
    }

    /// Writes the file, completely or not at all. Its bytes depend only on the results.
    fn write(&self) -> anyhow::Result<()> {
        let first_line = serde_json::to_string(&self.first_line)?;
        write_atomically(&self.path, |file| -> io::Result<()> {
            // The gzip header has no file name and no time.
            let mut gzip = GzEncoder::new(file, Compression::best());
            writeln!(gzip, "{first_line}")?;
            for line in self.lines.values() {
                writeln!(gzip, "{}", line.text)?;
            }
            gzip.finish()?;
            Ok(())
        })
        .with_context(|| format!("cannot write {}", self.path.display()))
    }
}

/// Describes a result in the file at `path`, for messages.
fn place(path: &Path, key: &Key) -> String {
    format!("{} (seed {}{})", path.display(), key.seed, key.milestone)
}

/// The line of a result of this milestone: the JSON object `result`, unchanged digit by digit, with the milestone's
/// suffix inserted as its first key.
fn line(result: &str, milestone: &Milestone) -> anyhow::Result<(Key, String)> {
    // JSON has no line breaks inside strings or numbers.
    let result: String = result.lines().map(str::trim).collect();
    let rest = result.strip_prefix('{').context("it is not a JSON object")?;
    let suffix = serde_json::to_string(milestone.suffix)?;
    let line = format!("{{\"stage\":{suffix},{rest}");
    Ok((serde_json::from_str(&line)?, line))
}

/// The numbers N of all entries `seed-N<ending>` in a directory, in ascending order; none if the directory does not
/// exist.
pub(super) fn numbered(directory: &Path, ending: &str) -> anyhow::Result<Vec<u64>> {
    let reading = || format!("cannot read {}", directory.display());
    let entries = match std::fs::read_dir(directory) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.with_context(reading)?,
    };
    let mut numbers = Vec::new();
    for entry in entries {
        let name = entry.with_context(reading)?.file_name();
        let number = name
            .to_str()
            .and_then(|name| name.strip_prefix("seed-")?.strip_suffix(ending));
        // Other spellings of a number, such as 02, are ignored.
        let number = number.and_then(|text| text.parse().ok().filter(|number: &u64| number.to_string() == text));
        numbers.extend(number);
    }
    numbers.sort_unstable();
    Ok(numbers)
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::super::family::Family;
    use super::super::pendulum::Pendulum;
    use super::super::point_mass::EXPERIMENTS;
    use super::super::result::tests::result;
    use super::super::result::{self, ResultHeader, SeedResult};
    use super::*;

    /// An experiment with two milestones.
    const TWO_MILESTONES: &Experiment = &EXPERIMENTS[1];

    /// A result of [`TWO_MILESTONES`] in the old format.
    fn text(seed: u64, of: f64) -> String {
        serde_json::to_string(&result(TWO_MILESTONES, seed, of, ())).unwrap()
    }

    fn unpacked(path: &Path) -> String {
        let mut text = String::new();
        MultiGzDecoder::new(File::open(path).unwrap())
            .read_to_string(&mut text)
            .unwrap();
        text
    }

    fn pack(path: &Path, text: &str) {
        let mut gzip = GzEncoder::new(File::create(path).unwrap(), Compression::fast());
        gzip.write_all(text.as_bytes()).unwrap();
        gzip.finish().unwrap();
    }

    fn refused(folder: &Path) -> String {
        let error = format!("{:#}", ResultsFile::read(folder, TWO_MILESTONES).unwrap_err());
        assert!(error.contains("point-mass-r2") && !error.contains('\n'), "{error}");
        error
    }

    #[test]
    fn results_are_lines_ordered_by_seed_and_milestone() {
        let folder = tempfile::tempdir().unwrap();
        let [first, second] = TWO_MILESTONES.milestones else {
            panic!("two milestones")
        };
        let mut results = ResultsFile::read(folder.path(), TWO_MILESTONES).unwrap();
        for (milestone, seed) in [(first, 10), (second, 2), (first, 2)] {
            results.add(&text(seed, 0.1 + 0.2), milestone).unwrap();
        }
        let path = folder.path().join("point-mass-r2.jsonl.gz");
        let written = unpacked(&path);
        let lines: Vec<Value> = written
            .lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect();
        assert_eq!(
            (&lines[0]["format"], &lines[0]["experiment"]),
            (&2.into(), &"point-mass-r2".into())
        );
        let keys: Vec<_> = lines[1..]
            .iter()
            .map(|line| (line["seed"].as_u64().unwrap(), line["stage"].as_str().unwrap()))
            .collect();
        assert_eq!(keys, [(2, ""), (2, "-longer"), (10, "")]);
        assert!(written.contains("0.30000000000000004"), "every digit is kept");
        // The flags (no file name) and the time of the gzip header.
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(bytes[3..8], [0; 5]);

        // The order in which results are added does not matter.
        let other = tempfile::tempdir().unwrap();
        let mut again = ResultsFile::read(other.path(), TWO_MILESTONES).unwrap();
        for (milestone, seed) in [(first, 2), (first, 10), (second, 2)] {
            again.add(&text(seed, 0.1 + 0.2), milestone).unwrap();
        }
        assert_eq!(
            std::fs::read(other.path().join("point-mass-r2.jsonl.gz")).unwrap(),
            bytes
        );
        let read = ResultsFile::read(folder.path(), TWO_MILESTONES).unwrap();
        let seeds = |milestone| read.of(milestone).map(|(seed, _)| seed).collect::<Vec<_>>();
        assert_eq!((seeds(first), seeds(second)), (vec![2, 10], vec![2]));
        assert!(read.has(second, 2) && !read.has(second, 10));
    }

    #[test]
    fn a_result_that_cannot_be_written_is_not_added() {
        let folder = tempfile::tempdir().unwrap();
        let milestone = &TWO_MILESTONES.milestones[0];
        let mut results = ResultsFile::read(folder.path(), TWO_MILESTONES).unwrap();
        results.add(&text(1, 1.0), milestone).unwrap();
        let kept = std::fs::read(folder.path().join("point-mass-r2.jsonl.gz")).unwrap();
        // This directory has the name of the temporary file.
        std::fs::create_dir(folder.path().join("point-mass-r2.jsonl.gz.new")).unwrap();
        let error = results.add(&text(2, 1.0), milestone).unwrap_err().to_string();
        assert!(
            error.contains("cannot write") && error.contains("point-mass-r2.jsonl.gz"),
            "{error}"
        );
        assert!(results.has(milestone, 1) && !results.has(milestone, 2));
        assert_eq!(
            std::fs::read(folder.path().join("point-mass-r2.jsonl.gz")).unwrap(),
            kept
        );
    }

    #[test]
    fn results_in_the_old_format_are_moved() {
        let folder = tempfile::tempdir().unwrap();
        let [first, second] = TWO_MILESTONES.milestones else {
            panic!("two milestones")
        };
        ResultsFile::read(folder.path(), TWO_MILESTONES)
            .unwrap()
            .add(&text(3, 3.0), first)
            .unwrap();
        let directory = folder.path().join("point-mass-r2");
        std::fs::create_dir_all(directory.join("seed-1")).unwrap();
        let old = |name: &str, text: &str| std::fs::write(directory.join(name), text).unwrap();
        old("seed-12.json", &format!("{}\n", text(12, 0.1 + 0.2)));
        old("seed-1.json", &text(1, 1.0).replace(",\"", ",\n  \""));
        old("seed-1-longer.json", &text(1, 2.0));
        // A command that was killed between writing and removing leaves this.
        old("seed-3.json", &text(3, 3.0));
        old("seed-4.json.new", "half");
        old("notes.txt", "mine");

        let mut results = ResultsFile::read(folder.path(), TWO_MILESTONES).unwrap();
        let keys: Vec<_> = results.of(first).map(|(seed, _)| seed).collect();
        assert_eq!(keys, [1, 3, 12]);
        assert!(
            results.has(second, 1) && directory.join("seed-1.json").exists(),
            "nothing is moved yet"
        );
        results.move_old_results().unwrap();
        let mut left: Vec<_> = std::fs::read_dir(&directory)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        left.sort();
        assert_eq!(left, ["notes.txt", "seed-1", "seed-4.json.new"]);
        let all = unpacked(&folder.path().join("point-mass-r2.jsonl.gz"));
        let wanted = [(1, 1.0, ""), (1, 2.0, "-longer"), (3, 3.0, ""), (12, 0.1 + 0.2, "")]
            .map(|(seed, of, milestone)| text(seed, of).replacen('{', &format!("{{\"stage\":\"{milestone}\","), 1));
        assert_eq!(all.lines().skip(1).collect::<Vec<_>>(), wanted);
        assert!(
            results
                .of(first)
                .all(|(_, line)| line.place.contains("point-mass-r2.jsonl.gz (seed "))
        );

        // Two results of the same seed that differ are an error.
        old("seed-12.json", &text(12, 5.0));
        assert!(refused(folder.path()).contains("differ"));
        old("seed-12.json", &text(13, 5.0));
        assert!(refused(folder.path()).contains("the result of seed 13"));
        old("seed-12.json", "{\"schema\"");
        assert!(refused(folder.path()).contains("not a result of this program"));
        assert_eq!(unpacked(&folder.path().join("point-mass-r2.jsonl.gz")), all);
    }

    #[test]
    fn a_result_of_an_earlier_version_can_be_read() {
        let folder = tempfile::tempdir().unwrap();
        let old = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/123d5ad/pendulum/seed-1.json");
        let directory = folder.path().join("pendulum");
        std::fs::create_dir(&directory).unwrap();
        std::fs::copy(&old, directory.join("seed-1.json")).unwrap();
        let pendulum = &Pendulum::EXPERIMENTS[0];
        ResultsFile::read(folder.path(), pendulum)
            .unwrap()
            .move_old_results()
            .unwrap();
        assert!(!directory.exists(), "the empty directory was removed");

        let results = ResultsFile::read(folder.path(), pendulum).unwrap();
        let lines: Vec<_> = results.of(&pendulum.milestones[0]).collect();
        let [(1, line)] = lines[..] else { panic!("{lines:?}") };
        let old_text = std::fs::read_to_string(&old).unwrap();
        assert_eq!(line.text.replacen("\"stage\":\"\",", "", 1), old_text.trim_end());
        ResultHeader::read(line).unwrap();
        let read: SeedResult<<Pendulum as Family>::Measurements> = result::read(line).unwrap();
        assert_eq!(read.evaluations.last().unwrap().steps, 4_000);
    }

    #[test]
    fn old_results_and_runs_are_found_by_their_names() {
        let directory = tempfile::tempdir().unwrap();
        for name in [
            "seed-12.json",
            "seed-2.json",
            "seed-2-longer.json",
            "seed-02.json",
            "seed-2.json.new",
            "seed-7",
        ] {
            std::fs::write(directory.path().join(name), "").unwrap();
        }
        let of = |ending| numbered(directory.path(), ending).unwrap();
        assert_eq!(
            (of(".json"), of("-longer.json"), of("")),
            (vec![2, 12], vec![2], vec![7])
        );
        assert!(numbered(&directory.path().join("absent"), "").unwrap().is_empty());
    }

    #[test]
    fn damaged_and_foreign_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("point-mass-r2.jsonl.gz");
        ResultsFile::read(folder.path(), TWO_MILESTONES)
            .unwrap()
            .add(&text(1, 1.0), &TWO_MILESTONES.milestones[0])
            .unwrap();
        let (whole, lines) = (std::fs::read(&path).unwrap(), unpacked(&path));
        let damaged = "damaged or not a results file";
        for bytes in [
            &b"no gzip"[..],
            &whole[..whole.len() - 3],
            &[&whole[..], b"more"].concat(),
        ] {
            std::fs::write(&path, bytes).unwrap();
            assert!(refused(folder.path()).contains(damaged));
        }
        let result = lines.lines().nth(1).unwrap();
        for (text, part) in [
            ("", damaged),
            ("{}\n", damaged),
            ("{\"format\":99}\n", "has format 99; this program reads format 2"),
            (
                &lines.replacen("point-mass-r2", "point-mass-r1", 1),
                "the results of point-mass-r1",
            ),
            (&format!("{lines}{result}\n"), "(seed 1) occurs twice"),
            (&format!("{lines}{{\"seed\":2}}\n"), damaged),
        ] {
            pack(&path, text);
            assert!(refused(folder.path()).contains(part), "{part}");
        }
        pack(&path, &lines);
        ResultsFile::read(folder.path(), TWO_MILESTONES).unwrap();
    }
}
