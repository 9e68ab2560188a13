//! The vehicle of chapter 5 with its three rewards, and the additional training with r2 (appendix A).

mod claims;
mod figures;

use serde::{Deserialize, Serialize};
use shoal_run::evaluation::analysis::point_mass::{FAR_STARTS, Measures, NEAR_STARTS, TestRun};
use shoal_run::evaluation::rollout::Rollout;

use super::experiment::{Experiment, Length, Milestone};
use super::family::{Family, Results, TrainedRun};
use super::report_section::{FigureWriter, ReportSection};

/// The suffix of the milestone after the additional training with r2.
const LONGER: &str = "-longer";

const QUICK: &[&str] = &[
    "ddpg.hidden=[32, 24]",
    "replay.capacity=20000",
    "evaluation.every=800",
    "evaluation.episodes=4",
    "evaluation.final_episodes=10",
];

/// 4000 episodes of 200 steps for r1, 2000 for r2 and r3, and 4000 for r2 in appendix A.1.
pub(super) const EXPERIMENTS: [Experiment; 3] = [
    experiment("point-mass-r1", &[milestone("", 800_000, 8_000)]),
    experiment(
        "point-mass-r2",
        &[milestone("", 400_000, 8_000), milestone(LONGER, 800_000, 16_000)],
    ),
    experiment("point-mass-r3", &[milestone("", 400_000, 8_000)]),
];

const fn experiment(name: &'static str, milestones: &'static [Milestone]) -> Experiment {
    Experiment {
        name,
        cli_name: name,
        preset: name,
        settings: &[],
        quick: QUICK,
        seeds: 5,
        milestones,
    }
}

const fn milestone(suffix: &'static str, steps: u64, quick_steps: u64) -> Milestone {
    Milestone {
        suffix,
        length: Length::Steps(steps),
        quick_length: Length::Steps(quick_steps),
    }
}

/// Markdown before the claims about r1; it applies to the other rewards too.
const REMARK: &str = "\
Unless stated otherwise, numbers of test runs are means over the four starts of section 5.3. \"At rest\" means the last
50 of a run's 200 steps. Turning is the sum of all changes of θ, each taken the short way round.";

/// Markdown before the claims about the additional training.
const REMARK_ON_ADDITIONAL_TRAINING: &str = "\
These are the same runs, resumed. The agent of appendix A.1 is the one at the end of the additional training. Here it is
the last policy, not the best one by evaluation.";

/// Test runs from the start positions of section 5.3, followed by the test runs of appendix A.2.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Measurements {
    best: Vec<Measures>,
    last: Vec<Measures>,
    /// Test runs of the best policy.
    #[serde(rename = "drives")]
    test_runs: Vec<TestRun>,
    /// Test runs of the last policy from the starts of section 5.3, if the thesis shows that policy (appendix A.1).
    #[serde(rename = "last_drives")]
    last_test_runs: Vec<TestRun>,
}

/// See [`EXPERIMENTS`].
pub(super) struct PointMass;

impl Family for PointMass {
    type Measurements = Measurements;
    const EXPERIMENTS: &'static [Experiment] = &EXPERIMENTS;

    fn measure(trained: &TrainedRun, milestone: &Milestone) -> anyhow::Result<Measurements> {
        let starts = [&NEAR_STARTS[..], &FAR_STARTS[..]].concat();
        let run = |parameters| TestRun::from_starts(&mut Rollout::new(&trained.config, parameters)?, &starts);
        let best = run(&trained.best.parameters)?;
        let last = run(&trained.last.parameters)?;
        let shown = if milestone.suffix == LONGER {
            NEAR_STARTS.len()
        } else {
            0
        };
        Ok(Measurements {
            best: best.iter().map(TestRun::measures).collect(),
            last: last.iter().map(TestRun::measures).collect(),
            test_runs: best.into_iter().map(TestRun::rounded).collect(),
            last_test_runs: last.into_iter().take(shown).map(TestRun::rounded).collect(),
        })
    }

    fn sections(results: &Results<Measurements>, writer: &FigureWriter) -> anyhow::Result<Vec<ReportSection>> {
        let [r1, r2, r3] = ["point-mass-r1", "point-mass-r2", "point-mass-r3"].map(|name| results.of(name, ""));
        let longer = results.of("point-mass-r2", LONGER);
        let section = |title, from: &[(&'static str, &'static str)], remark: &str, claims, figures| ReportSection {
            title,
            from: from.into(),
            remark: remark.into(),
            claims,
            figures,
        };
        Ok(vec![
            section(
                "Point mass with reward r1 (section 5.3.1)",
                &[("point-mass-r1", "")],
                REMARK,
                claims::of_r1(r1),
                figures::of_reward(writer, &figures::R1, r1)?,
            ),
            section(
                "Point mass with reward r2 (section 5.3.2)",
                &[("point-mass-r2", "")],
                "",
                claims::of_r2(r1, r2),
                figures::of_reward(writer, &figures::R2, r2)?,
            ),
            section(
                "Point mass with reward r3 (section 5.3.3, appendix A.2)",
                &[("point-mass-r3", "")],
                "",
                claims::of_r3(r1, r2, r3),
                figures::of_r3(writer, r3)?,
            ),
            section(
                "Comparison of the three agents (section 5.4)",
                &[("point-mass-r1", ""), ("point-mass-r2", ""), ("point-mass-r3", "")],
                "Runs with the same seed are compared. A seed that has no result for one of the rewards is left out.",
                claims::of_comparison(r1, r2, r3),
                figures::of_comparison(writer, [r1, r2, r3])?,
            ),
            section(
                "Reward r2 with additional training (section 5.3.2, appendix A.1)",
                &[("point-mass-r2", ""), ("point-mass-r2", LONGER)],
                REMARK_ON_ADDITIONAL_TRAINING,
                claims::of_longer(r2, longer),
                figures::of_longer(writer, longer)?,
            ),
        ])
    }
}

#[cfg(test)]
mod tests {
    use super::super::result::SeedResult;
    use super::super::result::tests::result;
    use super::*;
    use shoal_run::testing::test_run;

    /// A seed whose test runs are made by [`test_run`] with these arguments.
    pub(super) fn seed(number: u64, rest: f64, shake: f64, force: f64, held: f64) -> SeedResult<Measurements> {
        let starts = [&NEAR_STARTS[..], &FAR_STARTS[..]].concat();
        let test_runs: Vec<_> = starts
            .iter()
            .map(|start| test_run(*start, rest, shake, force, held))
            .collect();
        let measures: Vec<_> = test_runs.iter().map(TestRun::measures).collect();
        let measurements = Measurements {
            best: measures.clone(),
            last: measures,
            last_test_runs: test_runs[..4].iter().cloned().map(TestRun::rounded).collect(),
            test_runs: test_runs.into_iter().map(TestRun::rounded).collect(),
        };
        result(&EXPERIMENTS[1], number, 100.0, measurements)
    }

    #[test]
    fn sections_have_the_figures_of_the_existing_results() {
        let directory = tempfile::tempdir().unwrap();
        let writer = FigureWriter::in_directory(directory.path().into(), false).unwrap();
        let mut results = Results::new();
        let figures = |results: &Results<Measurements>| -> Vec<usize> {
            let sections = PointMass::sections(results, &writer).unwrap();
            sections.iter().map(|section| section.figures.len()).collect()
        };
        assert_eq!(figures(&results), [0, 0, 0, 0, 0]);
        results.put(
            "point-mass-r2",
            "",
            vec![seed(1, 0.03, 0.1, 1.0, 0.0), seed(2, 0.02, 0.1, 1.0, 0.0)],
        );
        assert_eq!(figures(&results), [0, 2, 0, 2, 0]);
        for experiment in ["point-mass-r1", "point-mass-r3"] {
            results.put(experiment, "", vec![seed(1, 0.01, 0.3, 1.0, 0.5)]);
        }
        results.put("point-mass-r2", LONGER, vec![seed(1, 0.01, 2.0, 1.0, 0.5)]);
        assert_eq!(figures(&results), [2, 2, 4, 2, 2]);
    }

    #[test]
    fn a_result_is_small_and_keeps_the_names_of_its_fields() {
        let text = serde_json::to_string(&seed(1, 0.0123, 0.1234, 1.234, 0.1234).measurements).unwrap();
        let fields = ["\"best\":", "\"last\":", "\"drives\":", "\"last_drives\":"];
        assert!(fields.iter().all(|field| text.contains(field)));
        assert!(text.len() < 130_000, "{}", text.len());
    }
}
