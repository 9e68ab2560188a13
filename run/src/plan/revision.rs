//! The configuration of a run that is resumed: what `config.toml` and the command line ask for, compared key by key
//! with what the run was last used with.
//!
//! Three files take part, and are written in this order: `config.toml`, `changes.csv`, `config/used.toml`. After a kill
//! between two of them the next resume finds the same difference again and does what is left.

use std::collections::BTreeSet;
use std::io::Write;

use anyhow::{Context, bail};
use shoal_common::commit::CommitReader;
use shoal_common::config::{Change, Config, Difference, Mode};
use shoal_common::durable::write_atomically;
use shoal_common::run_dir::RunDir;
use shoal_common::section;
use shoal_learner::process::replay_layout;
use toml::Table;

use super::overrides::{RunOverrides, read_counts, set_key, set_options};
use super::resolve::set_from_length;
use super::source::{SettingSource, SettingSources};
use crate::files::is_there;
use crate::plan::algorithm;
use crate::records::recorder::{ChangeRecord, Moment, read_changes, record_changes};
use crate::status::{replay_rows, saved_status};
use crate::usage::UsageError;

/// What the command line asks a resumed run to change.
#[derive(Clone, Debug, Default)]
pub struct RequestedChanges {
    /// `run.steps`.
    pub steps: Option<u64>,
    /// `run.episodes`.
    pub episodes: Option<u64>,
    /// Any key, as `SECTION.KEY=VALUE`.
    pub set: Vec<String>,
}

/// A checked configuration for a run that is resumed.
#[derive(Clone, Debug)]
pub struct Revision {
    /// The configuration from now on.
    pub config: Config,
    /// The differences from what the run was last used with, each with the file or option that changed it.
    changes: Vec<(Difference, String)>,
    /// Whether `config.toml` says something else.
    rewrite: bool,
}

impl Revision {
    /// Compares `config.toml` and what is asked for with `used`, the configuration that the run was last used with.
    /// Changes nothing.
    ///
    /// # Errors
    /// When a key cannot change, or a value is invalid. The message names the key and where it was set.
    pub fn new(run: &RunDir, used: &Config, asked: &RequestedChanges) -> anyhow::Result<Self> {
        let path = run.config_file();
        let origin = path.display().to_string();
        let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {origin}"))?;
        let malformed = |error| anyhow::anyhow!("{}", section::malformed(&origin, &text, &error));
        let mut table: Table = text.parse().map_err(malformed)?;
        let edited = Config::from_table(table.clone(), &origin).ok();
        let mut sources = SettingSources::of_file(&origin, &text);
        if let Some(edited) = &edited {
            // A key that has not changed was not set by the user.
            let differing: Vec<String> = used.differences(edited).into_iter().map(|it| it.key).collect();
            let same = edited.values().into_keys().filter(|key| !differing.contains(key));
            same.for_each(|key| sources.set(key, SettingSource::Run));
        }
        let options = RunOverrides {
            steps: asked.steps,
            episodes: asked.episodes,
            ..RunOverrides::default()
        };
        set_options(&mut table, &mut sources, &options)?;
        for assignment in &asked.set {
            check_algorithm(assignment, used)?;
            set_key(&mut table, &mut sources, assignment)?;
        }
        read_counts(&mut table).map_err(|error| sources.explain(&error.into(), &origin, &table))?;
        let mut config = Config::from_settings(&table).map_err(|error| sources.explain(&error, &origin, &table))?;
        set_from_length(&mut config, &mut SettingSources::default());
        let (since, before) = (config.replay.ratio_since, config.replay.updates_before);
        // These two are in the other file alone, because `config.toml` is written before a change is final.
        (config.replay.ratio_since, config.replay.updates_before) = if (since, before) == (0, 0) {
            (used.replay.ratio_since, used.replay.updates_before)
        } else {
            (since, before)
        };
        let differences = used.differences(&config);
        refuse(&differences, used, &sources)?;
        check_files(run, used, &config, &differences)?;
        let has = |key: &str| differences.iter().any(|it| it.key == key);
        if has("replay.updates_per_step") || has("replay.warmup") {
            let rows = replay_rows(run)?;
            (config.replay.ratio_since, config.replay.updates_before) = (rows, used.replay.allowed_updates(rows));
        }
        let set_by = |difference: &Difference| match sources.of(&difference.key) {
            SettingSource::Option(option) => option.into(),
            SettingSource::Set => "--set".into(),
            _ => "config.toml".into(),
        };
        Ok(Self {
            rewrite: edited.as_ref() != Some(&as_written(&config)),
            changes: differences
                .into_iter()
                .map(|difference| {
                    let set_by = set_by(&difference);
                    (difference, set_by)
                })
                .collect(),
            config,
        })
    }

    /// Whether it changes this key.
    pub fn changes_key(&self, key: &str) -> bool {
        self.changes.iter().any(|(change, _)| change.key == key)
    }

    /// Writes the run's files, so that the run is used with this configuration from now on. Returns the rows that are
    /// new in `changes.csv`.
    ///
    /// # Errors
    /// When a file cannot be read or written.
    pub fn apply(&self, run: &RunDir, now: Moment) -> anyhow::Result<Vec<ChangeRecord>> {
        if self.rewrite {
            run.write_config(&as_written(&self.config))?;
        }
        let rows = self.unrecorded(&read_changes(&run.changes())?, now);
        if !rows.is_empty() {
            record_changes(run, &rows)?;
        }
        if !self.changes.is_empty() || !is_there(&run.used_config_file())? {
            run.write_used_config(&self.config)?;
        }
        Ok(rows)
    }

    /// The rows that `changes.csv` lacks. A launcher may have been killed after it recorded a change and before the
    /// change was final; the change may now be made, or be withdrawn.
    fn unrecorded(&self, recorded: &[ChangeRecord], now: Moment) -> Vec<ChangeRecord> {
        let values = self.config.values();
        let changed = self.changes.iter().map(|(change, _)| &change.key);
        let keys: BTreeSet<&String> = changed.chain(recorded.iter().map(|row| &row.key)).collect();
        let row = |key: &String| {
            let change = self.changes.iter().find(|(change, _)| change.key == *key);
            let last = recorded.iter().rev().find(|row| row.key == *key);
            let before = last.map_or_else(
                || change.map(|(it, _)| it.before.clone()),
                |row| Some(row.after.clone()),
            );
            let (before, after) = (before.unwrap_or_default(), values.get(key).cloned().unwrap_or_default());
            (before != after).then(|| ChangeRecord {
                wall_seconds: now.wall_seconds,
                env_steps: now.env_steps,
                key: key.clone(),
                before,
                after,
                source: change.map_or_else(|| "config.toml".into(), |(_, who)| who.clone()),
            })
        };
        keys.into_iter().filter_map(row).collect()
    }
}

/// Changes the number of actors of a running run in its files. What else was edited in `config.toml` stays there until
/// the run is resumed.
///
/// # Errors
/// When a file cannot be written.
pub fn store_actors(run: &RunDir, used: &Config, actors: u32, now: Moment) -> anyhow::Result<Config> {
    let mut config = used.clone();
    config.actors.count = actors;
    let path = run.config_file();
    let edited = Config::load(&path).ok();
    if edited.as_ref() == Some(&as_written(used)) {
        run.write_config(&as_written(&config))?;
    } else if let Some(mut edited) = edited {
        edited.actors.count = actors;
        run.write_config(&edited)?;
    } else if let Some(text) = std::fs::read_to_string(&path)
        .ok()
        .and_then(|text| with_actors(&text, actors))
    {
        // Half edited: it cannot be read as a whole, but the next resume must not take the old number for a change.
        let written = write_atomically(&path, |file| file.write_all(text.as_bytes()));
        written.with_context(|| format!("cannot write {}", path.display()))?;
    }
    let changed = used.actors.count != actors;
    if changed {
        let row = ChangeRecord {
            wall_seconds: now.wall_seconds,
            env_steps: now.env_steps,
            key: "actors.count".into(),
            before: used.actors.count.to_string(),
            after: actors.to_string(),
            source: "scale".into(),
        };
        record_changes(run, &[row])?;
    }
    run.write_used_config(&config)?;
    Ok(config)
}

/// The text of a `config.toml` with another number of actors; `None` if it has no line for that. The rest need not be
/// TOML.
fn with_actors(text: &str, actors: u32) -> Option<String> {
    let mut section = "";
    let mut found = false;
    let mut with = String::new();
    for line in text.split_inclusive('\n') {
        if line.starts_with('[') {
            section = line.split(']').next().unwrap_or_default();
        }
        match line.split_once('=') {
            Some((key, rest)) if section == "[actors" && key.trim() == "count" => {
                let value = rest.split(['#', '\n']).next().unwrap_or_default().trim_end();
                with += &format!("{key}= {actors}{}", &rest[value.len()..]);
                found = true;
            }
            _ => with += line,
        }
    }
    found.then_some(with)
}

/// What `config.toml` will change at the next resume of a run that is not running, in words; `None` if nothing.
pub fn edited(run: &RunDir, used: &Config) -> Option<String> {
    match Revision::new(run, used, &RequestedChanges::default()) {
        Err(error) => Some(format!("it cannot be resumed: {error:#}")),
        Ok(revision) => {
            let change = |(it, _): &(Difference, String)| format!("{} = {} instead of {}", it.key, it.after, it.before);
            let all: Vec<String> = revision.changes.iter().map(change).collect();
            (!all.is_empty()).then(|| format!("config.toml was edited, for the next resume: {}", all.join(", ")))
        }
    }
}

/// The configuration without the keys that only `config/used.toml` has, as in `config.toml`.
pub(super) fn as_written(config: &Config) -> Config {
    let mut config = config.clone();
    (config.replay.ratio_since, config.replay.updates_before) = (0, 0);
    config
}

/// Checks that a `--set` is not for another algorithm.
fn check_algorithm(assignment: &str, used: &Config) -> Result<(), UsageError> {
    let section = assignment.split('.').next().unwrap_or_default();
    let own = used.algorithm.name();
    if section != own && algorithm::of_name(section).is_some() {
        return Err(UsageError(format!(
            "--set {assignment}: this run learns with {own}, and the algorithm of a run cannot change"
        )));
    }
    Ok(())
}

/// Refuses the first key that cannot change.
fn refuse(differences: &[Difference], used: &Config, sources: &SettingSources) -> anyhow::Result<()> {
    let lockstep = used.run.mode == Mode::Lockstep;
    for Difference {
        key,
        before,
        after,
        change,
    } in differences
    {
        let Some(why) = change.refusal(lockstep) else { continue };
        let place = if matches!(change, Change::InFreeRuns(_)) {
            "in a lockstep run"
        } else {
            "in this run"
        };
        let [before, after] = [before, after].map(|value| if value.is_empty() { "nothing" } else { value });
        let text = format!("{key} = {after}: cannot change {place}, which has {before}: {why}");
        return Err(sources.error_naming_source(key, &text));
    }
    Ok(())
}

/// Checks that the run's files still belong to the configuration, and that a lockstep run can begin with it at a
/// definite round.
fn check_files(run: &RunDir, used: &Config, config: &Config, differences: &[Difference]) -> anyhow::Result<()> {
    if differences.is_empty() {
        return Ok(());
    }
    let names: Vec<&str> = differences.iter().map(|it| it.key.as_str()).collect();
    let names = names.join(", ");
    if config.fingerprint() != used.fingerprint() {
        let of_algorithm = [used.algorithm.name(), "exploration"];
        let names = differences.iter().map(|it| it.key.as_str());
        let names: Vec<&str> = names
            .filter(|key| {
                of_algorithm
                    .iter()
                    .any(|section| key.starts_with(&format!("{section}.")))
            })
            .collect();
        bail!(
            "{}: cannot change in this run: it was made by an early version of the program, which identified its files \
             by these keys",
            names.join(", ")
        );
    }
    let may_have_replay = !matches!(run.replay_file().try_exists(), Ok(false));
    if may_have_replay && replay_layout(config) != replay_layout(used) {
        bail!("{names}: cannot change in this run: its replay.bin was made for other sizes");
    }
    match used.run.mode {
        Mode::Free => Ok(()),
        Mode::Lockstep => check_round(run, used, config, differences),
    }
}

/// Checks that a lockstep run can begin with the configuration at a definite round.
fn check_round(run: &RunDir, used: &Config, config: &Config, differences: &[Difference]) -> anyhow::Result<()> {
    let saved = saved_status(used, run)?;
    let here = run.path().display();
    let learning = differences.iter().find(|it| it.change == Change::Learning);
    if let Some(first) = learning
        && newest_round(used, run)? > saved.policy_version + 1
    {
        bail!(
            "{}: cannot change now: this lockstep run was killed, and the learner repeats updates on rounds that were \
             collected already; `shoal resume {here}` and then `shoal stop {here}` let the learner catch up",
            first.key
        );
    }
    if saved.replay_rows > saved.env_steps && config.run.steps < saved.replay_rows {
        bail!(
            "run.steps = {}: must be at least {}, because the replay of this lockstep run already has that many steps",
            config.run.steps,
            saved.replay_rows
        );
    }
    if config.run.steps != used.run.steps && saved.replay_rows > saved.env_steps && saved.replay_rows >= used.run.steps
    {
        bail!(
            "run.steps: cannot change now: this lockstep run was interrupted in its last round; `shoal resume {here}` \
             finishes it first"
        );
    }
    Ok(())
}

/// The number of the newest round that the replay has rows of; 0 without a replay.
fn newest_round(config: &Config, run: &RunDir) -> anyhow::Result<u64> {
    let Some(commits) = CommitReader::open_if_ready(&run.replay_file())? else {
        return Ok(0);
    };
    let rounds = (0..config.actors.max as usize).map(|actor| commits.committed(actor).sequence);
    Ok(rounds.max().unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::resolve_preset;

    #[test]
    fn a_run_is_scaled_while_its_configuration_is_half_edited() {
        let used = resolve_preset("pendulum").unwrap();
        let written = used.to_toml().unwrap();
        let count = format!("count = {}", used.actors.count);
        assert_eq!(written.matches(&count).count(), 1, "{written}");
        let commented = written.replace(&count, &format!("{count}  # not enough?"));
        // Not TOML yet, and a value that is refused.
        for (half, whole) in [
            (format!("{commented}\n[learn"), commented.clone()),
            (commented.replace("[actors]", "[actors]\nwindow = "), commented.clone()),
            (commented.replace("steps = ", "steps = -"), commented.clone()),
        ] {
            let parent = tempfile::tempdir().unwrap();
            let run = RunDir::create(&parent.path().join("run")).unwrap();
            run.write_used_config(&used).unwrap();
            std::fs::write(run.config_file(), &half).unwrap();
            let now = Moment::of_records(&run).unwrap();
            let scaled = store_actors(&run, &used, used.actors.count + 1, now).unwrap();
            let more = format!("count = {}  # not enough?", used.actors.count + 1);
            let text = std::fs::read_to_string(run.config_file()).unwrap();
            assert_eq!(text, half.replace(&format!("{count}  # not enough?"), &more));
            // The user goes on, and resumes the run.
            std::fs::write(
                run.config_file(),
                whole.replace(&format!("{count}  # not enough?"), &more),
            )
            .unwrap();
            let revision = Revision::new(&run, &scaled, &RequestedChanges::default()).unwrap();
            assert_eq!(revision.changes.len(), 0, "{:?}", revision.changes);
        }
        assert_eq!(with_actors("[learner]\ncount = 1\n", 2), None);
        assert_eq!(with_actors("[actors]\ncount\n", 2), None);
        assert_eq!(
            with_actors("[actors]\ncount = ", 2).as_deref(),
            Some("[actors]\ncount = 2 ")
        );
    }
}
