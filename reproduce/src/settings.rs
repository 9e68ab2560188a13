//! The settings of a run that determine its result: its configuration without name, seed and length, and without keys
//! on which no result depends.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::bail;
use serde::{Deserialize, Serialize};
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use shoal_run::plan;
use shoal_run::plan::RunOverrides;
use toml::Value;

use super::experiment::{Effort, Experiment, Length};

/// Values as TOML, by SECTION.KEY.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct RunSettings(BTreeMap<String, String>);

impl RunSettings {
    /// The settings of a run with this configuration.
    pub(super) fn of(config: &Config) -> anyhow::Result<Self> {
        let mut settings = BTreeMap::new();
        flatten("", toml::Value::try_from(config)?, &mut settings);
        settings.retain(|key, _| {
            !["run.id", "run.seed", "run.steps", "run.episodes"].contains(&key.as_str())
                && !["spec.", "learner."].iter().any(|section| key.starts_with(section))
        });
        Ok(Self(settings))
    }

    /// The settings of the run in a directory, which must have this seed.
    pub(super) fn of_run(run: &Path, seed: u64) -> anyhow::Result<Self> {
        let config = RunDir::open(run)?.config()?;
        if config.run.seed != seed {
            bail!(
                "{} has seed {}, not {seed}: remove it, or choose another directory with --out",
                run.display(),
                config.run.seed
            );
        }
        Self::of(&config)
    }

    /// The settings that a run of `experiment` has in this version.
    pub(super) fn expected(experiment: &Experiment, effort: Effort) -> anyhow::Result<Self> {
        let length = experiment.milestones.first().map(|milestone| milestone.length(effort));
        let overrides = RunOverrides {
            seed: Some(1),
            steps: length.and_then(|length| match length {
                Length::Steps(steps) => Some(steps),
                Length::Episodes(_) => None,
            }),
            lockstep: true,
            set: experiment.settings(effort).map(Into::into).collect(),
            ..RunOverrides::default()
        };
        let (_, config) = plan::resolve(experiment.preset, &overrides)?;
        Self::of(&config)
    }

    /// Returns an error if these settings differ from `expected`. `made` names the run or result in the message. Keys
    /// that only one side has belong to another version of this program and are ignored.
    pub(super) fn check(&self, made: &str, expected: &Self) -> anyhow::Result<()> {
        for (key, found) in &self.0 {
            if let Some(wanted) = expected.0.get(key).filter(|wanted| *wanted != found) {
                bail!(
                    "{made} was made with {key} = {found}, which is now {wanted}: move the file or directory away, or \
                     choose another directory with --out"
                );
            }
        }
        Ok(())
    }

    #[cfg(test)]
    pub(super) fn from_pairs(pairs: &[(&str, &str)]) -> Self {
        Self(
            pairs
                .iter()
                .map(|(key, value)| ((*key).into(), (*value).into()))
                .collect(),
        )
    }
}

fn flatten(prefix: &str, value: Value, into: &mut BTreeMap<String, String>) {
    match value {
        Value::Table(table) => {
            for (key, value) in table {
                let key = if prefix.is_empty() {
                    key
                } else {
                    format!("{prefix}.{key}")
                };
                flatten(&key, value, into);
            }
        }
        value => {
            into.insert(prefix.into(), value.to_string());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_exclude_name_seed_and_length() {
        let experiment = &super::super::pendulum::EXPERIMENTS[0];
        let [full, quick] = [Effort::Full, Effort::Quick].map(|e| RunSettings::expected(experiment, e).unwrap());
        assert_eq!(full.0["ddpg.hidden"], "[400, 300]");
        assert_eq!(full.0["run.mode"], "\"lockstep\"");
        assert!(
            !full.0.keys().any(|key| key == "run.seed" || key.starts_with("spec")),
            "{full:?}"
        );
        assert_eq!(RunSettings::expected(experiment, Effort::Full).unwrap(), full);
        let refused = quick.check("seed-1.json", &full).unwrap_err().to_string();
        assert!(
            refused.contains("seed-1.json") && refused.contains("which is now") && !refused.contains('\n'),
            "{refused}"
        );
        full.check("x", &full).unwrap();
    }
}
