//! The point mass with SAC and TD3.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};
use shoal_run::evaluation::analysis::point_mass::{FAR_STARTS, Measures, NEAR_STARTS, REACHED, TestRun};
use shoal_run::evaluation::rollout::Rollout;

use super::super::claim::{Claim, spread};
use super::super::experiment::{Experiment, Milestone};
use super::super::family::{Family, Results, TrainedRun};
use super::super::report_section::{FigureWriter, ReportSection};
use super::super::result::SeedResult;
use super::{experiment, learning_curves, milestone};

type Seed = SeedResult<Measurements>;

const QUICK_SAC: &[&str] = &[
    "sac.hidden=[16, 16]",
    "evaluation.every=400",
    "evaluation.episodes=4",
    "evaluation.final_episodes=10",
];
const QUICK_TD3: &[&str] = &[
    "td3.hidden=[16, 16]",
    "evaluation.every=400",
    "evaluation.episodes=4",
    "evaluation.final_episodes=10",
];

const EXPERIMENTS: [Experiment; 4] = [
    experiment("point-mass-r3-sac", 10, (&[], QUICK_SAC), &[milestone(100_000)]),
    experiment("point-mass-r1-sac", 5, (&[], QUICK_SAC), &[milestone(100_000)]),
    experiment("point-mass-r2-sac", 5, (&[], QUICK_SAC), &[milestone(100_000)]),
    experiment("point-mass-r3-td3", 3, (&[], QUICK_TD3), &[milestone(100_000)]),
];

/// The number of steps "at rest": the last steps of a test run.
const AT_REST: f64 = 50.0;
/// A vehicle that turns less than this, in rad a step, is calm.
const CALM: f64 = 0.02;
/// The static friction, in N.
const FRICTION: f64 = 0.118;

const REMARK: &str = "\
Each run has a quarter of the steps of section 5.3 for r2 and r3, and an eighth for r1. Test runs are those of the best
policy from the twelve starts of section 5.3 and appendix A.2. \"At rest\" means the last 50 of their 200 steps. A
vehicle is calm if it turns less than 0.02 rad a step at rest; below 0.118 N the static friction holds it.";

/// Test runs of the best policy from all twelve starts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Measurements {
    best: Vec<Measures>,
}

impl Measurements {
    fn reached(&self) -> usize {
        self.best.iter().filter(|it| it.final_distance <= REACHED).count()
    }

    fn mean(&self, of: impl Fn(&Measures) -> f64) -> f64 {
        self.best.iter().map(of).sum::<f64>() / self.best.len() as f64
    }

    fn force(&self) -> f64 {
        self.mean(|it| it.force_at_rest)
    }

    /// In rad a step.
    fn turning(&self) -> f64 {
        self.mean(|it| it.turning_at_rest) / AT_REST
    }
}

/// SAC and TD3 on the point mass.
pub(crate) struct PointMassAlgorithms;

impl Family for PointMassAlgorithms {
    type Measurements = Measurements;
    const EXPERIMENTS: &'static [Experiment] = &EXPERIMENTS;

    fn measure(trained: &TrainedRun, _: &Milestone) -> anyhow::Result<Measurements> {
        let starts = [&NEAR_STARTS[..], &FAR_STARTS[..]].concat();
        let test_runs = TestRun::from_starts(&mut Rollout::new(&trained.config, &trained.best.parameters)?, &starts)?;
        Ok(Measurements {
            best: test_runs.iter().map(TestRun::measures).collect(),
        })
    }

    fn sections(results: &Results<Measurements>, writer: &FigureWriter) -> anyhow::Result<Vec<ReportSection>> {
        let [r3, r1, r2, td3] = EXPERIMENTS.map(|experiment| (experiment.name, results.of(experiment.name, "")));
        let mut figures = Vec::new();
        for (name, seeds) in [r3, r1, r2, td3] {
            figures.extend(learning_curves(writer, name, seeds)?);
        }
        let rest = |what, seeds: &[Seed]| {
            Claim::each_seed(
                what,
                "turning at rest below 0.02 rad a step, force at rest below 0.118 N",
                format!(
                    "{} rad a step, {} N",
                    spread(seeds.iter().map(|seed| seed.measurements.turning()), 3),
                    spread(seeds.iter().map(|seed| seed.measurements.force()), 3)
                ),
                seeds.iter().map(|seed| is_calm(&seed.measurements)),
            )
        };
        Ok(vec![ReportSection {
            title: "The point mass with SAC and TD3 (not in the thesis)",
            from: EXPERIMENTS.iter().map(|experiment| (experiment.name, "")).collect(),
            remark: format!("{REMARK}\n{}", table(&[r3, r1, r2, td3])),
            claims: vec![
                reaches("SAC with r3 reaches the goal from every start", r3.1),
                reaches("SAC with r1 reaches the goal from every start", r1.1),
                reaches("SAC with r2 reaches the goal from every start", r2.1),
                reaches("TD3 with r3 reaches the goal from every start", td3.1),
                rest("SAC with r3 comes to rest", r3.1),
                rest("TD3 with r3 comes to rest", td3.1),
            ],
            figures,
        }])
    }
}

fn is_calm(measurements: &Measurements) -> bool {
    measurements.turning() < CALM && measurements.force() < FRICTION
}

fn reaches(what: &'static str, seeds: &[Seed]) -> Claim {
    let starts = NEAR_STARTS.len() + FAR_STARTS.len();
    Claim::each_seed(
        what,
        "within 0.05 m at the end, from all twelve",
        format!(
            "{} starts",
            spread(seeds.iter().map(|seed| seed.measurements.reached() as f64), 0)
        ),
        seeds.iter().map(|seed| seed.measurements.reached() == starts),
    )
}

/// What each seed does, in Markdown.
fn table(experiments: &[(&str, &[Seed])]) -> String {
    let mut text = String::new();
    for (name, seeds) in experiments.iter().filter(|(_, seeds)| !seeds.is_empty()) {
        let _ = writeln!(
            text,
            "\n| {name}, seed | return | starts reached | force at rest (N) | turning at rest (rad a step) |\n\
             | --- | --- | --- | --- | --- |"
        );
        for seed in *seeds {
            let _ = writeln!(
                text,
                "| {} | {:.1} | {} | {:.3} | {:.3} |",
                seed.header.seed,
                seed.best.evaluation.return_mean,
                seed.measurements.reached(),
                seed.measurements.force(),
                seed.measurements.turning()
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::super::result::tests::result;
    use super::*;
    use shoal_run::testing::test_run;

    fn seed(number: u64, rest: f64, shake: f64, force: f64) -> Seed {
        let starts = [&NEAR_STARTS[..], &FAR_STARTS[..]].concat();
        let test_runs = starts.iter().map(|start| test_run(*start, rest, shake, force, 0.0));
        let best = test_runs.map(|run| run.measures()).collect();
        result(&EXPERIMENTS[0], number, 100.0, Measurements { best })
    }

    #[test]
    fn a_seed_is_calm_and_at_the_goal_or_not() {
        let directory = tempfile::tempdir().unwrap();
        let writer = FigureWriter::in_directory(directory.path().into(), false).unwrap();
        let mut results = Results::new();
        results.put(
            "point-mass-r3-sac",
            "",
            vec![seed(1, 0.01, 0.0, 0.0), seed(2, 0.3, 0.0, 0.0), seed(3, 0.01, 1.0, 1.0)],
        );
        let sections = PointMassAlgorithms::sections(&results, &writer).unwrap();
        let [section] = sections.as_slice() else {
            panic!("one section")
        };
        assert_eq!(section.claims[0].held(), [true, false, true]);
        assert!(!section.claims[4].held()[2], "{}", section.claims[4].measured);
        assert!(section.claims[1].held().is_empty());
        assert!(section.remark.contains("| 3 | 100.0 | 12 |"), "{}", section.remark);
        assert_eq!(section.figures.len(), 1);
    }
}
