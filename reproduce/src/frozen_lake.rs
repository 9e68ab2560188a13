//! FrozenLake (section 4.1): Q-learning with several exploration rates and learning rates, and SARSA for comparison.

mod claims;

use anyhow::Context;
use serde::{Deserialize, Serialize};
use shoal_common::policy_file::PolicyFile;
use shoal_env_server::environment::frozen_lake::{ACTIONS, STATES};
use shoal_report::figure::{self, CurvesOfSetting, DiagramAxes};
use shoal_run::evaluation::analysis::lake::{ExpectedResult, LIMIT, greedy, optimal};
use shoal_run::evaluation::rollout::policy_layout;
use shoal_run::records::recorder::read_evaluations;

use super::experiment::{Experiment, Length, Milestone};
use super::family::{Family, Results, TrainedRun};
use super::report_section::{Figure, FigureWriter, ReportSection};
use super::result::{SeedResult, representative};

/// γ of every experiment of this family.
const GAMMA: f64 = 0.999;

/// Number of episodes of a training.
const EPISODES: u64 = 10_000;

/// Number of episodes between points of a curve.
const GRID: u64 = 100;

const CHOSEN: &str = "frozen-lake";
const EPSILON: [(&str, &str); 3] = [
    ("frozen-lake-epsilon-0.1", "ε = 0.1"),
    (CHOSEN, "ε = 0.4"),
    ("frozen-lake-epsilon-0.7", "ε = 0.7"),
];
const ALPHA: [(&str, &str); 4] = [
    ("frozen-lake-alpha-0.01", "α = 0.01"),
    (CHOSEN, "α = 0.03"),
    ("frozen-lake-alpha-0.1", "α = 0.1"),
    ("frozen-lake-alpha-0.3", "α = 0.3"),
];
const SARSA: &str = "frozen-lake-sarsa";

pub(super) const EXPERIMENTS: [Experiment; 7] = [
    with_30_seeds(experiment(CHOSEN, "frozen-lake", &["evaluation.keep_policies=true"])),
    with_30_seeds(experiment(
        EPSILON[0].0,
        "frozen-lake",
        &["evaluation.keep_policies=true", "q-learning.epsilon=0.1"],
    )),
    with_30_seeds(experiment(
        EPSILON[2].0,
        "frozen-lake",
        &["evaluation.keep_policies=true", "q-learning.epsilon=0.7"],
    )),
    experiment(
        ALPHA[0].0,
        "frozen-lake",
        &["evaluation.keep_policies=true", "q-learning.alpha=0.01"],
    ),
    experiment(
        ALPHA[2].0,
        "frozen-lake",
        &["evaluation.keep_policies=true", "q-learning.alpha=0.1"],
    ),
    experiment(
        ALPHA[3].0,
        "frozen-lake",
        &["evaluation.keep_policies=true", "q-learning.alpha=0.3"],
    ),
    experiment(SARSA, "frozen-lake-sarsa", &["evaluation.keep_policies=true"]),
];

const fn experiment(name: &'static str, preset: &'static str, settings: &'static [&'static str]) -> Experiment {
    Experiment {
        name,
        cli_name: "frozen-lake",
        preset,
        settings,
        quick: &["evaluation.every=200", "evaluation.final_episodes=10"],
        seeds: 10,
        milestones: &[Milestone {
            suffix: "",
            length: Length::Episodes(EPISODES),
            quick_length: Length::Episodes(40),
        }],
    }
}

/// Runs 30 seeds instead of the thesis's ten, which do not show which of two exploration rates is better.
const fn with_30_seeds(experiment: Experiment) -> Experiment {
    Experiment {
        seeds: 30,
        ..experiment
    }
}

/// The table that was learned, and the policies during training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Measurements {
    /// The action-values at the end, state by state.
    q: Vec<f32>,
    /// Every evaluated policy, in order.
    #[serde(rename = "judged")]
    evaluated: Vec<PolicySnapshot>,
}

/// A policy that was evaluated during training.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct PolicySnapshot {
    /// Number of training episodes before it.
    episodes: u64,
    /// Its exact performance, by the lake's transition table.
    exact: ExpectedResult,
}

impl Measurements {
    /// (episodes, value) at each multiple of [`GRID`] episodes, for the last policy evaluated up to then.
    fn on_grid(&self, of: impl Fn(&PolicySnapshot) -> f64) -> Vec<(f64, f64)> {
        (1..=EPISODES / GRID)
            .filter_map(|i| {
                let episodes = i * GRID;
                let evaluated = self
                    .evaluated
                    .iter()
                    .rfind(|evaluated| evaluated.episodes <= episodes)?;
                Some((episodes as f64, of(evaluated)))
            })
            .collect()
    }

    /// The probability of reaching the goal, as mean over the points of the curve between these two episodes.
    fn reached(&self, from: u64, to: u64) -> f64 {
        let points = self.on_grid(|evaluated| evaluated.exact.reached).into_iter();
        let within = points.filter(|(episodes, _)| (from as f64..=to as f64).contains(episodes));
        let values: Vec<f64> = within.map(|(_, value)| value).collect();
        values.iter().sum::<f64>() / values.len().max(1) as f64
    }
}

/// See [`EXPERIMENTS`].
pub(super) struct FrozenLake;

impl Family for FrozenLake {
    type Measurements = Measurements;
    const EXPERIMENTS: &'static [Experiment] = &EXPERIMENTS;

    fn measure(trained: &TrainedRun, _: &Milestone) -> anyhow::Result<Measurements> {
        let TrainedRun { config, run, last, .. } = trained;
        let layout = policy_layout(config)?;
        let mut steps = 0;
        // With one actor and one environment, an episode ends at the sum of all steps up to its own.
        let ends: Vec<u64> = trained
            .episodes()?
            .iter()
            .map(|episode| {
                steps += u64::from(episode.steps);
                steps
            })
            .collect();
        let mut evaluations = read_evaluations(&run.evaluations())?;
        evaluations.sort_by_key(|evaluation| evaluation.env_steps);
        let evaluated = evaluations.iter().map(|evaluation| {
            let path = run.evaluated_policy(evaluation.env_steps);
            let policy = PolicyFile::read(&path, &layout).context("cannot read a policy that was evaluated")?;
            Ok(PolicySnapshot {
                episodes: ends.partition_point(|end| *end <= evaluation.env_steps) as u64,
                exact: ExpectedResult::of(&greedy(&policy.parameters)).rounded(),
            })
        });
        Ok(Measurements {
            evaluated: evaluated.collect::<anyhow::Result<_>>()?,
            q: last.parameters.clone(),
        })
    }

    fn sections(results: &Results<Measurements>, writer: &FigureWriter) -> anyhow::Result<Vec<ReportSection>> {
        let chosen = results.of(CHOSEN, "");
        let q_star = optimal(GAMMA);
        let best: Vec<f32> = q_star.iter().flatten().map(|q| *q as f32).collect();
        let best_result = ExpectedResult::of(&greedy(&best));
        let epsilon = EPSILON.map(|(name, label)| (label, results.of(name, "")));
        let alpha = ALPHA.map(|(name, label)| (label, results.of(name, "")));
        let mut figures = Vec::new();
        for (file, sweep, what, number) in [
            ("epsilon", &epsilon[..], "exploration rates, α = 0.03", "a"),
            ("alpha", &alpha[..], "learning rates, ε = 0.4", "b"),
        ] {
            figures.extend(of_sweep(writer, file, sweep, what, number, best_result)?);
        }
        if let Some(middle) = representative(chosen) {
            figures.push(writer.add(
                "frozen-lake-policy",
                format!(
                    "The greedy policy and its action-values after 10,000 episodes, seed {} (figure 4.4)",
                    middle.header.seed
                ),
                |path| draw_table(&middle.measurements.q, path),
            )?);
        }
        figures.push(writer.add(
            "frozen-lake-value-iteration",
            "The optimal policy and its action-values, by value iteration",
            |path| draw_table(&best, path),
        )?);
        Ok(vec![ReportSection {
            title: "FrozenLake with Q-learning (section 4.1)",
            from: EXPERIMENTS.iter().map(|experiment| (experiment.name, "")).collect(),
            remark: remark(best_result.reached),
            claims: claims::all(&epsilon, &alpha, results.of(SARSA, ""), &q_star, best_result),
            figures,
        }])
    }
}

/// Markdown before the table of claims; `optimal` is the optimal policy's probability of reaching the goal.
fn remark(optimal: f64) -> String {
    format!(
        "\
The run is in lockstep with one actor, and a chunk has one transition: after each environment step there is one update,
then the next action. That is exactly Algorithm 2. For `{SARSA}` it is Algorithm 1, where a' is chosen before
the update.

- Of equal action-values the first is taken. With probability ε one of the four actions is taken at random, which may be
  the greedy one.
- A prototype tried other readings; no command here repeats it. With random choices among equal values, ε = 0.1 reaches
  the goal with probability 0.64 instead of 0.28. If exploration excludes the greedy action, ε = 0.7 loses its early
  lead.
- Policies during training are evaluated exactly, with the lake's transition table: the probability of reaching the goal
  within {LIMIT} steps, and the mean number of steps, which is {LIMIT} if the goal is not reached.
- The thesis's five evaluation episodes are run and stored as well, but five random episodes say little.

The optimal policy reaches the goal with probability {optimal:.3}."
    )
}

/// A setting's label, with its results.
type SettingResults<'a> = (&'static str, &'a [SeedResult<Measurements>]);

fn of_sweep(
    writer: &FigureWriter,
    file: &str,
    sweep: &[SettingResults<'_>],
    what: &str,
    number: &str,
    best: ExpectedResult,
) -> anyhow::Result<Vec<Figure>> {
    let settings = |of: fn(&PolicySnapshot) -> f64| -> Vec<CurvesOfSetting> {
        let curves = sweep.iter().map(|(label, seeds)| {
            let runs: Vec<_> = seeds.iter().map(|seed| seed.measurements.on_grid(of)).collect();
            CurvesOfSetting {
                label: (*label).into(),
                curve: figure::pointwise(&runs, mean),
                runs,
            }
        });
        curves.collect()
    };
    let axes = |title, y, level| DiagramAxes {
        title,
        x: ("training episode", EPISODES as f64),
        y,
        level: Some(("best policy", level)),
    };
    let rewards = axes(
        "Reward of the greedy policy",
        ("probability of the goal", 0.0, 1.0),
        best.reached,
    );
    let steps = axes(
        "Steps of the greedy policy",
        ("steps to the goal (at most 100)", 0.0, 105.0),
        best.steps,
    );
    Ok(vec![
        writer.add(
            &format!("frozen-lake-{file}-reward"),
            format!("Reward history for several {what}: mean over the seeds (figure 4.2{number})"),
            |path| figure::lines(&rewards, &settings(|evaluated| evaluated.exact.reached), path),
        )?,
        writer.add(
            &format!("frozen-lake-{file}-steps"),
            format!("Steps needed to reach the goal for several {what}: mean over the seeds (figure 4.3{number})"),
            |path| figure::lines(&steps, &settings(|evaluated| evaluated.exact.steps), path),
        )?,
    ])
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn draw_table(table: &[f32], path: &std::path::Path) -> anyhow::Result<()> {
    let policy = greedy(table).map(|action| vec![action]);
    let values: [[f64; ACTIONS]; STATES] =
        std::array::from_fn(|state| std::array::from_fn(|action| table[state * ACTIONS + action].into()));
    figure::lake(&policy, &values, path)
}
