//! The dataset whose rows a new run's replay begins with: `train --demonstrations DATASET`.
//!
//! `python3 -m shoal.demonstrations` reads the dataset with Minari's own package and writes its rows in a format of
//! ours, so that this program needs no HDF5. `python/shoal/demonstrations.py` describes the format.

use std::process::{Output, Stdio};

use anyhow::{Context, bail};
use serde::Deserialize;
use shoal_common::algorithms::TransitionUse;
use shoal_common::config::Config;
use shoal_common::durable::{FileKind, unseal};
use shoal_common::run_dir::RunDir;
use shoal_common::space::Space;
use shoal_common::transition::{RowLayout, Transition};
use shoal_learner::algorithms::registry;
use shoal_learner::process::checkpoint::{Checkpoints, Counters};
use shoal_learner::process::replay_layout;
use shoal_learner::replay::Replay;

use crate::numbers::thousands;
use crate::origin::DatasetOrigin;
use crate::python;
use crate::usage::UsageError;

pub(crate) const KIND: FileKind = FileKind {
    magic: *b"SHOALDEM",
    version: 1,
    name: "a dataset's rows",
};

/// Bytes of the header's length.
const LENGTH: usize = size_of::<u64>();

/// What comes before the rows.
#[derive(Clone, Debug, PartialEq, Deserialize)]
struct Header {
    /// The dataset's name.
    dataset: String,
    episodes: u64,
    rows: u64,
    /// The id of its environment in Gymnasium, if it has one.
    environment: Option<String>,
    observation: Space,
    action: Space,
}

/// A dataset to begin with.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Demonstrations {
    header: Header,
    layout: RowLayout,
    /// Its rows. In place of the discount they have 1 if the step terminated the episode, otherwise 0.
    numbers: Vec<f32>,
}

impl Demonstrations {
    /// Reads this dataset for a run with this configuration.
    ///
    /// # Errors
    /// When such a run has no use for rows of one step, when Python's packages are missing, or when the dataset cannot
    /// be read.
    pub(crate) fn read(dataset: &str, config: &Config) -> anyhow::Result<Self> {
        check_use(config)?;
        let mut command = python::module("shoal.demonstrations")?;
        command.args(["--", dataset, "-"]).stdin(Stdio::null());
        let Output { status, stdout, stderr } = command.output().context("cannot start python3")?;
        if !status.success() {
            let said = String::from_utf8_lossy(&stderr);
            let lines = said.lines().rev().filter(|line| !line.trim().is_empty());
            let last = lines.clone().find_map(|line| line.strip_prefix("error: "));
            let why = last.or_else(|| lines.clone().next()).unwrap_or("no message");
            bail!("--demonstrations {dataset}: {why}");
        }
        Self::parse(stdout).with_context(|| {
            format!(
                "--demonstrations {dataset}: python3 has an incompatible version of the package shoal; reinstall it: pip \
                 install ./python"
            )
        })
    }

    /// The contents of such a file.
    fn parse(file: Vec<u8>) -> anyhow::Result<Self> {
        let body = unseal(KIND, file).map_err(|error| anyhow::anyhow!("its output {error}"))?;
        let (length, rest) = body.split_first_chunk::<LENGTH>().context("its output has no header")?;
        let length = usize::try_from(u64::from_le_bytes(*length))?;
        let (header, rows) = rest
            .split_at_checked(length)
            .context("its output ends within the header")?;
        let header: Header = toml::from_str(str::from_utf8(header)?).context("its header is damaged")?;
        let layout = RowLayout::new(header.observation.width(), header.action.width());
        let (numbers, remainder) = rows.as_chunks();
        let expected = usize::try_from(header.rows)?.checked_mul(layout.width());
        if !remainder.is_empty() || expected != Some(numbers.len()) {
            bail!("its output has {} bytes for {} rows", rows.len(), header.rows);
        }
        Ok(Self {
            numbers: numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect(),
            header,
            layout,
        })
    }

    /// Checks that it fits a run with this configuration, and returns the number of its rows.
    pub(crate) fn check(&self, config: &Config) -> Result<u64, UsageError> {
        let Header { dataset, rows, .. } = &self.header;
        let refused = |what: String| Err(UsageError(format!("--demonstrations {dataset}: {what}")));
        for (what, there, here) in [
            ("observations", &self.header.observation, &config.spec.observation),
            ("actions", &self.header.action, &config.spec.action),
        ] {
            if there != here {
                return refused(format!(
                    "the space of its {what} is {there:?}, and the environment's is {here:?}"
                ));
            }
        }
        let capacity = config.replay.capacity;
        if *rows > capacity {
            return refused(format!(
                "it has {} rows, and replay.capacity = {capacity}: raise it with --set",
                thousands(*rows)
            ));
        }
        for (number, row) in self.numbers.chunks_exact(self.layout.width()).enumerate() {
            if let Some(what) = self.fault(&self.layout.read(row)) {
                return refused(format!("in its row {number}, {what}"));
            }
        }
        Ok(*rows)
    }

    /// What is wrong with a row; `None` if an actor could have sent it.
    fn fault(&self, row: &Transition<'_>) -> Option<String> {
        for (what, space, numbers) in [
            ("the observation", &self.header.observation, row.s),
            ("the next observation", &self.header.observation, row.s_next),
            ("the action", &self.header.action, row.a),
        ] {
            let index = |number: f32, n: u32| number >= 0.0 && number.fract() == 0.0 && number < n as f32;
            let wrong = match space {
                Space::Discrete { n, .. } => numbers.iter().position(|number| !index(*number, *n)),
                // Environments observe what is beyond their bounds, but no actor acts there.
                Space::Box { low, high } if what == "the action" => {
                    let bounds = low.iter().zip(high);
                    let within = |(number, (low, high)): (&f32, (&f32, &f32))| {
                        number.is_finite() && low <= number && number <= high
                    };
                    numbers.iter().zip(bounds).position(|pair| !within(pair))
                }
                Space::Box { .. } => numbers.iter().position(|number| !number.is_finite()),
            };
            if let Some(wrong) = wrong {
                return Some(format!(
                    "number {wrong} of {what} is {}, which is not in {space:?}",
                    numbers[wrong]
                ));
            }
        }
        if !row.r.is_finite() {
            return Some(format!(
                "the reward is {}, which is not finite as a 32-bit float",
                row.r
            ));
        }
        let terminated = row.discount;
        (terminated != 0.0 && (terminated != 1.0 || !row.last)).then(|| "the end of the episode is damaged".into())
    }

    /// The rows as an actor of a run with this γ would have sent them.
    fn rows(&self, gamma: f32) -> Vec<f32> {
        let mut rows = self.numbers.clone();
        for (written, read) in rows
            .chunks_exact_mut(self.layout.width())
            .zip(self.numbers.chunks_exact(self.layout.width()))
        {
            let read = self.layout.read(read);
            let discount = if read.discount == 0.0 { gamma } else { 0.0 };
            self.layout.write(&Transition { discount, ..read }, written);
        }
        rows
    }

    /// Writes the replay and the learner's state before its first update.
    pub(crate) fn write(&self, run: &RunDir, config: &Config) -> anyhow::Result<DatasetOrigin> {
        let mut replay = Replay::create(&run.replay_file(), &replay_layout(config))?;
        let rows = replay.begin_with_rows(&self.rows(config.algorithm.gamma() as f32))?;
        let begun = Counters {
            rows,
            ..Counters::default()
        };
        let fresh = registry::new(config)?;
        Checkpoints::new(&run.checkpoints(), config.fingerprint()).save(&begun, &fresh.state())?;
        let Header { dataset, episodes, .. } = self.header.clone();
        Ok(DatasetOrigin {
            dataset,
            episodes,
            rows,
        })
    }

    /// The warning before a run of this configuration begins with the rows, if one is needed.
    pub(crate) fn warning(&self, config: &Config) -> Option<String> {
        let there = self.header.environment.as_deref()?;
        let here = config.environment.name.strip_prefix("gym:")?;
        // The name of a module is not part of an id.
        let id = here.rsplit_once(':').map_or(here, |(_, id)| id);
        (there != id).then(|| {
            let dataset = &self.header.dataset;
            format!("the rows of {dataset} come from another environment: {there} instead of {here}")
        })
    }
}

/// Checks that a run with this configuration learns from stored rows of one step.
fn check_use(config: &Config) -> Result<(), UsageError> {
    let refused = |what: String| Err(UsageError(format!("--demonstrations: {what}")));
    if config.algorithm.properties().transition_use != TransitionUse::Minibatches {
        return refused(format!(
            "{} learns from each step once, as it happens",
            config.algorithm.name()
        ));
    }
    match config.replay.n_step {
        1 => Ok(()),
        n_step => refused(format!(
            "replay.n_step = {n_step}: the rows of a dataset have one step; leave it at 1"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::resolve_preset;
    use crate::testing::dataset;

    /// The file for these rows of a pendulum, with a header that ends so.
    fn file(rows: &[[f32; 10]], count: usize, header: &str) -> Vec<u8> {
        let header = format!(
            "dataset = \"pendulum/x-v0\"\nepisodes = 1\nrows = {count}\n{header}\n\
             observation = {{ box = {{ low = [-1.0, -1.0, -8.0], high = [1.0, 1.0, 8.0] }} }}\n"
        );
        dataset(&header, rows)
    }

    const ACTIONS: &str = "action = { box = { low = [-2.0], high = [2.0] } }";
    /// s, a, r, terminated, s', last.
    const ROW: [f32; 10] = [1.0, 0.0, 0.5, 2.0, -3.0, 0.0, 0.9, 0.1, 0.25, 0.0];

    fn with(number: usize, value: f32) -> [f32; 10] {
        let mut row = ROW;
        row[number] = value;
        row
    }

    #[test]
    fn rows_get_the_discount_that_an_actor_gives_them() {
        let mut terminal = with(5, 1.0);
        terminal[9] = 1.0;
        let rows = [ROW, with(9, 1.0), terminal];
        let read = Demonstrations::parse(file(&rows, 3, ACTIONS)).unwrap();
        assert_eq!(read.check(&resolve_preset("pendulum").unwrap()).unwrap(), 3);
        let mut expected = rows;
        (expected[0][5], expected[1][5], expected[2][5]) = (0.99, 0.99, 0.0);
        assert_eq!(read.rows(0.99), expected.concat());
    }

    #[test]
    fn what_an_actor_would_not_send_is_refused() {
        let mut config = resolve_preset("pendulum").unwrap();
        for (row, part) in [
            (with(1, f32::NAN), "row 1, number 1 of the observation is NaN"),
            (with(8, f32::INFINITY), "number 2 of the next observation is inf"),
            (with(3, 2.1), "number 0 of the action is 2.1"),
            (with(4, f32::NEG_INFINITY), "the reward is -inf"),
            (with(5, 1.0), "the end of the episode is damaged"),
            (with(5, f32::NAN), "the end of the episode is damaged"),
        ] {
            let read = Demonstrations::parse(file(&[ROW, row], 2, ACTIONS)).unwrap();
            let error = read.check(&config).unwrap_err().to_string();
            assert!(error.contains(part) && !error.contains('\n'), "{error}");
        }
        let other = "action = { discrete = { n = 2 } }";
        for (row, fits) in [
            (with(3, 1.0), true),
            (ROW, false),
            (with(3, -1.0), false),
            (with(3, 0.5), false),
        ] {
            let read = Demonstrations::parse(file(&[row], 1, other)).unwrap();
            assert_eq!(read.fault(&read.layout.read(&row)).is_none(), fits, "{row:?}");
            let error = read.check(&config).unwrap_err().to_string();
            assert!(error.contains("the space of its actions is Discrete { n: 2"), "{error}");
        }
        config.replay.capacity = 1;
        let read = Demonstrations::parse(file(&[ROW; 2], 2, ACTIONS)).unwrap();
        let error = read.check(&config).unwrap_err().to_string();
        assert!(error.contains("it has 2 rows, and replay.capacity = 1"), "{error}");
    }

    #[test]
    fn a_damaged_file_is_refused() {
        let whole = file(&[ROW; 2], 2, ACTIONS);
        Demonstrations::parse(whole.clone()).unwrap();
        for length in 0..whole.len() {
            Demonstrations::parse(whole[..length].to_vec()).unwrap_err();
        }
        let mut other = whole;
        other[8] = 2;
        for file in [
            other,
            file(&[ROW; 2], 3, ACTIONS),
            file(&[ROW; 2], 2, ""),
            file(&[ROW; 2], usize::MAX, ACTIONS),
        ] {
            Demonstrations::parse(file).unwrap_err();
        }
    }

    #[test]
    fn another_environment_of_gymnasium_is_worth_a_warning() {
        let read =
            Demonstrations::parse(file(&[ROW], 1, &format!("environment = \"Pendulum-v1\"\n{ACTIONS}"))).unwrap();
        let mut config = resolve_preset("pendulum").unwrap();
        for (name, warned) in [
            ("pendulum", false),
            ("gym:Pendulum-v1", false),
            ("gym:mine:Pendulum-v1", false),
            ("gym:Other-v1", true),
        ] {
            config.environment.name = name.into();
            assert_eq!(read.warning(&config).is_some(), warned, "{name}");
        }
    }
}
