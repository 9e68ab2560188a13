//! The pendulum with SAC and TD3.

use serde::{Deserialize, Serialize};
use shoal_run::evaluation::analysis::pendulum::{Measures, SwingUp};
use shoal_run::evaluation::rollout::Rollout;

use super::super::claim::{Claim, spread};
use super::super::experiment::{Experiment, Milestone};
use super::super::family::{Family, Results, TrainedRun};
use super::super::report_section::{FigureWriter, ReportSection};
use super::super::result::SeedResult;
use super::{experiment, learning_curves, milestone};

/// The final evaluation is over a thousand starts.
const STARTS: &[&str] = &["evaluation.final_episodes=1000"];

const EXPERIMENTS: [Experiment; 2] = [
    experiment(
        "pendulum-sac",
        5,
        (
            STARTS,
            &[
                "sac.hidden=[16, 16]",
                "evaluation.every=400",
                "evaluation.final_episodes=10",
            ],
        ),
        &[milestone(20_000)],
    ),
    experiment(
        "pendulum-td3",
        5,
        (
            STARTS,
            &[
                "td3.hidden=[16, 16]",
                "evaluation.every=400",
                "evaluation.final_episodes=10",
            ],
        ),
        &[milestone(20_000)],
    ),
];

/// The least mean return that is asked of every seed.
const LEAST_RETURN: f64 = -165.0;

/// The swing-up from rest at the bottom with the best policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Measurements {
    best: Measures,
}

/// SAC and TD3 on the pendulum.
pub(crate) struct PendulumAlgorithms;

impl Family for PendulumAlgorithms {
    type Measurements = Measurements;
    const EXPERIMENTS: &'static [Experiment] = &EXPERIMENTS;

    fn measure(trained: &TrainedRun, _: &Milestone) -> anyhow::Result<Measurements> {
        let best = SwingUp::run(&mut Rollout::new(&trained.config, &trained.best.parameters)?)?;
        Ok(Measurements { best: best.measures() })
    }

    fn sections(results: &Results<Measurements>, writer: &FigureWriter) -> anyhow::Result<Vec<ReportSection>> {
        let [sac, td3] = ["pendulum-sac", "pendulum-td3"].map(|name| results.of(name, ""));
        let mut figures = Vec::new();
        for (name, seeds) in [("pendulum-sac", sac), ("pendulum-td3", td3)] {
            figures.extend(learning_curves(writer, name, seeds)?);
        }
        Ok(vec![ReportSection {
            title: "The pendulum with SAC and TD3 (not in the thesis)",
            from: vec![("pendulum-sac", ""), ("pendulum-td3", "")],
            remark: "Each run has a sixth of the steps of section 4.3. The final evaluation is over 1,000 starts."
                .into(),
            claims: [("SAC swings it up", sac), ("TD3 swings it up", td3)]
                .map(|(what, seeds)| claim(what, seeds))
                .into(),
            figures,
        }])
    }
}

fn claim(what: &'static str, seeds: &[SeedResult<Measurements>]) -> Claim {
    let mean = |seed: &SeedResult<Measurements>| seed.best.evaluation.return_mean;
    Claim::each_seed(
        what,
        "mean return of the best policy at least −165",
        spread(seeds.iter().map(mean), 1),
        seeds.iter().map(|seed| mean(seed) >= LEAST_RETURN),
    )
}
