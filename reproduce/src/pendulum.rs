//! The pendulum (section 4.3.2).

use serde::{Deserialize, Serialize};
use shoal_report::figure;
use shoal_run::evaluation::analysis::pendulum::{Measures, SwingUp};
use shoal_run::evaluation::rollout::Rollout;

use super::claim::{Claim, spread};
use super::experiment::{Experiment, Length, Milestone};
use super::family::{Family, Results, TrainedRun};
use super::report_section::{FigureWriter, ReportSection};
use super::result::{SeedResult, representative};

/// 600 episodes of 200 steps.
pub(super) const EXPERIMENTS: [Experiment; 1] = [Experiment {
    name: "pendulum",
    cli_name: "pendulum",
    preset: "pendulum",
    settings: &[],
    quick: &[
        "ddpg.hidden=[32, 24]",
        "replay.capacity=4000",
        "evaluation.every=400",
        "evaluation.episodes=4",
        "evaluation.final_episodes=10",
    ],
    seeds: 5,
    milestones: &[Milestone {
        suffix: "",
        length: Length::Steps(120_000),
        quick_length: Length::Steps(4_000),
    }],
}];

/// Markdown before the table of claims.
const REMARK: &str = "\
\"At rest\" means the last 50 of the 200 steps of the test run. Angles are distances from upright. Figures of a single
run show the seed with the median final evaluation.";

/// The swing-up from rest at the bottom, with the best and the last policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Measurements {
    swing_up: SwingUp,
    best: Measures,
    last: Measures,
}

/// See [`EXPERIMENTS`].
pub(super) struct Pendulum;

impl Family for Pendulum {
    type Measurements = Measurements;
    const EXPERIMENTS: &'static [Experiment] = &EXPERIMENTS;

    fn measure(trained: &TrainedRun, _: &Milestone) -> anyhow::Result<Measurements> {
        let run = |parameters| SwingUp::run(&mut Rollout::new(&trained.config, parameters)?);
        let best = run(&trained.best.parameters)?;
        Ok(Measurements {
            best: best.measures(),
            last: run(&trained.last.parameters)?.measures(),
            swing_up: best.rounded(),
        })
    }

    fn sections(results: &Results<Measurements>, writer: &FigureWriter) -> anyhow::Result<Vec<ReportSection>> {
        let seeds = results.of("pendulum", "");
        let curves: Vec<_> = seeds.iter().map(SeedResult::curve).collect();
        let mut figures = vec![writer.add(
            "pendulum-learning-curve",
            "Mean return of the evaluations during training, every seed (figure 4.8)",
            |path| figure::learning_curves("Pendulum", &curves, None, path),
        )?];
        if let Some(middle) = representative(seeds) {
            figures.push(writer.add(
                "pendulum-swing-up",
                format!(
                    "The swing-up from rest at θ = π, seed {} (figure 4.9)",
                    middle.header.seed
                ),
                |path| figure::swing_up(&middle.measurements.swing_up, path),
            )?);
        }
        Ok(vec![ReportSection {
            title: "Pendulum (section 4.3.2)",
            from: vec![("pendulum", "")],
            remark: REMARK.into(),
            claims: claims(seeds),
            figures,
        }])
    }
}

fn claims(seeds: &[SeedResult<Measurements>]) -> Vec<Claim> {
    let around_150 = |value: f64| (-190.0..=-110.0).contains(&value);
    let measured = |of: fn(&Measures) -> f64, decimals, unit| {
        let [best, last] = [0, 1].map(|i| {
            let measures = |seed: &SeedResult<Measurements>| of([&seed.measurements.best, &seed.measurements.last][i]);
            spread(seeds.iter().map(measures), decimals)
        });
        format!("{best}{unit} (last policy {last}{unit})")
    };
    let of_best = |holds: fn(&Measures) -> bool| seeds.iter().map(move |seed| holds(&seed.measurements.best));
    vec![
        Claim::each_seed(
            "The agent improves until converging to a mean reward of approximately −150",
            "both the final evaluation (100 fixed episodes) and the mean of the last fifth of the evaluations during \
             training lie between −190 and −110",
            format!(
                "final evaluation {} (last policy {}); last fifth of the evaluations {}",
                spread(seeds.iter().map(|seed| seed.best.evaluation.return_mean), 1),
                spread(seeds.iter().map(|seed| seed.last.evaluation.return_mean), 1),
                spread(seeds.iter().map(SeedResult::late_mean), 1)
            ),
            seeds
                .iter()
                .map(|seed| around_150(seed.best.evaluation.return_mean) && around_150(seed.late_mean())),
        ),
        Claim::each_seed(
            "The pendulum swings back and forth a few times to gain momentum",
            "it turns back at least once before it is upright",
            format!("turns: {}", measured(|it| it.reversals.into(), 0, "")),
            of_best(|it| it.reversals >= 1),
        ),
        Claim::each_seed(
            "The angle and angular velocity converge to zero",
            "at rest the angle stays below 0.1 rad, the angular velocity below 0.1 rad/s",
            format!(
                "largest angle at rest {}; largest velocity at rest {}",
                measured(|it| it.angle_at_rest, 3, " rad"),
                measured(|it| it.velocity_at_rest, 3, " rad/s")
            ),
            of_best(|it| it.angle_at_rest < 0.1 && it.velocity_at_rest < 0.1),
        ),
        Claim::each_seed(
            "The applied torque converges to a small value",
            "at rest the mean absolute torque is below 0.2 N m (its range is ±2)",
            format!(
                "mean absolute torque at rest {}; mean change per step {}",
                measured(|it| it.torque_at_rest, 3, " N m"),
                measured(|it| it.chatter_at_rest, 3, " N m")
            ),
            of_best(|it| it.torque_at_rest < 0.2),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::super::result::tests::result;
    use super::*;
    use shoal_run::testing::swing;

    fn seed(number: u64, return_mean: f64, swing_up: SwingUp) -> SeedResult<Measurements> {
        let measures = swing_up.measures();
        let measurements = Measurements {
            best: measures.clone(),
            last: measures,
            swing_up: swing_up.rounded(),
        };
        result(&EXPERIMENTS[0], number, return_mean, measurements)
    }

    #[test]
    fn claims_hold_for_results_like_the_thesis_and_fail_for_the_opposite() {
        let good = seed(1, -150.0, swing(0.01, 0.05));
        let bad = seed(2, -900.0, swing(0.5, 1.0));
        let held: Vec<_> = claims(&[good, bad]).into_iter().map(|claim| claim.held()).collect();
        assert_eq!(held, [[true, false], [true, true], [true, false], [true, false]]);
        assert!(claims(&[]).iter().all(|claim| claim.held().is_empty()));
    }

    #[test]
    fn a_section_has_the_figures_of_the_existing_results() {
        let directory = tempfile::tempdir().unwrap();
        let writer = FigureWriter::in_directory(directory.path().into(), true).unwrap();
        let mut results = Results::new();
        assert_eq!(Pendulum::sections(&results, &writer).unwrap()[0].figures.len(), 1);
        results.put(
            "pendulum",
            "",
            vec![seed(1, -150.0, swing(0.0, 0.1)), seed(2, -160.0, swing(0.0, 0.1))],
        );
        assert_eq!(Pendulum::sections(&results, &writer).unwrap()[0].figures.len(), 2);
        for file in ["pendulum-learning-curve", "pendulum-swing-up"] {
            for ending in ["svg", "png"] {
                assert!(directory.path().join(format!("{file}.{ending}")).exists());
            }
        }
    }
}
