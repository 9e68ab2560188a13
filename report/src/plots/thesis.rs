//! The thesis's figures of one run. They start from states given in the thesis, so each belongs to a particular
//! environment.

use std::path::{Path, PathBuf};

use shoal_common::config::Config;
use shoal_run::evaluation::analysis::pendulum::SwingUp;
use shoal_run::evaluation::analysis::point_mass::{FAR_STARTS, NEAR_STARTS, TestRun};
use shoal_run::evaluation::rollout::Rollout;

use crate::figure;

/// Draws the policy's behaviour from the thesis's start states and returns the files; `None` if the thesis has no such
/// figure.
pub(super) fn behaviour(
    config: &Config,
    rollout: &mut Rollout<'_>,
    out: &Path,
) -> anyhow::Result<Option<Vec<PathBuf>>> {
    Ok(match config.environment.name.as_str() {
        "pendulum" => Some(swing_up(rollout, out)?),
        "point-mass" => Some(test_runs(config, rollout, out)?),
        _ => None,
    })
}

fn swing_up(rollout: &mut Rollout<'_>, out: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let path = out.join("swing-up.svg");
    figure::swing_up(&SwingUp::run(rollout)?, &path)?;
    Ok(vec![path])
}

fn test_runs(config: &Config, rollout: &mut Rollout<'_>, out: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let files = ["test-runs.svg", "test-runs-far.svg", "trajectories.svg"].map(|file| out.join(file));
    figure::test_runs(&TestRun::from_starts(rollout, starts_shown(config))?, &files[0])?;
    let mut runs = TestRun::from_starts(rollout, &FAR_STARTS)?;
    figure::test_runs(&runs, &files[1])?;
    runs.extend(TestRun::from_starts(rollout, &NEAR_STARTS)?);
    figure::trajectories(&runs, &files[2])?;
    Ok(files.into())
}

/// The two start positions in the thesis's figure for the run's reward: 5.5 (r1), 5.7 (r2), 5.9 (r3).
fn starts_shown(config: &Config) -> &'static [[f64; 2]] {
    let reward = config
        .environment
        .parameters
        .get("reward")
        .and_then(toml::Value::as_str);
    if reward == Some("r2") {
        &NEAR_STARTS[2..]
    } else {
        &NEAR_STARTS[..2]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_run::testing::small;

    #[test]
    fn the_starts_are_those_of_the_figure_for_the_reward() {
        let starts = |reward: &str| starts_shown(&small(&format!("name = \"point-mass\"\nreward = \"{reward}\"")).0);
        assert_eq!(starts("r1"), [[2.0, -2.0], [-2.0, 2.0]]);
        assert_eq!(starts("r2"), [[2.0, 2.0], [-2.0, -2.0]]);
        assert_eq!(starts("r3"), starts("r1"));
    }
}
