//! The slippery lake of section 4.1: Q-learning over two sweeps, and SARSA beside it.

mod claims;

use anyhow::Context;
use serde::{Deserialize, Serialize};
use shoal_common::policy_file::PolicyFile;
use shoal_env_server::environment::frozen_lake::{ACTIONS, STATES};
use shoal_report::figure::{self, Frame, Setting};
use shoal_run::analysis::lake::{LIMIT, Walk, greedy, optimal};
use shoal_run::recorder::read_evaluations;
use shoal_run::rollout::policy_layout;

use super::album::{Album, Figure, Section};
use super::experiment::{Experiment, Length, Stage};
use super::family::{Family, Policies, Results};
use super::result::{SeedResult, representative};

/// γ of every experiment here.
const GAMMA: f64 = 0.999;

/// Episodes of a training.
const EPISODES: u64 = 10_000;

/// Curves are drawn at every so many episodes.
const GRID: u64 = 100;

const GOOD: &str = "frozen-lake";
const EPSILON: [(&str, &str); 3] = [
    ("frozen-lake-epsilon-0.1", "ε = 0.1"),
    (GOOD, "ε = 0.4"),
    ("frozen-lake-epsilon-0.7", "ε = 0.7"),
];
const ALPHA: [(&str, &str); 4] = [
    ("frozen-lake-alpha-0.01", "α = 0.01"),
    (GOOD, "α = 0.03"),
    ("frozen-lake-alpha-0.1", "α = 0.1"),
    ("frozen-lake-alpha-0.3", "α = 0.3"),
];
const SARSA: &str = "frozen-lake-sarsa";

pub(super) const EXPERIMENTS: [Experiment; 7] = [
    often(experiment(GOOD, "frozen-lake", &["evaluation.keep_policies=true"])),
    often(experiment(
        EPSILON[0].0,
        "frozen-lake",
        &["evaluation.keep_policies=true", "q-learning.epsilon=0.1"],
    )),
    often(experiment(
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
        asked_as: "frozen-lake",
        preset,
        settings,
        quick: &["evaluation.every=200", "evaluation.final_episodes=10"],
        seeds: 10,
        stages: &[Stage {
            suffix: "",
            length: Length::Episodes(EPISODES),
            quick_length: Length::Episodes(40),
        }],
    }
}

/// Three times the thesis's ten repeats: which of two rates is ahead is not to be told from ten.
const fn often(experiment: Experiment) -> Experiment {
    Experiment {
        seeds: 30,
        ..experiment
    }
}

/// What was learned, and what it was worth on the way.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Tests {
    /// The table at the end, state after state.
    q: Vec<f32>,
    /// Each policy that was evaluated, in order.
    #[serde(rename = "judged")]
    evaluated: Vec<EvaluatedPolicy>,
}

/// A policy on the way.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct EvaluatedPolicy {
    /// Training episodes before it.
    episodes: u64,
    /// What the lake's table says of it.
    exact: Walk,
}

impl Tests {
    /// The value at each multiple of [`GRID`] episodes: of the last policy evaluated before.
    fn on_grid(&self, of: impl Fn(&EvaluatedPolicy) -> f64) -> Vec<(f64, f64)> {
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

    /// The mean, over the grid's points from one episode to another, of how likely the goal is reached.
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
    type Tests = Tests;
    const EXPERIMENTS: &'static [Experiment] = &EXPERIMENTS;

    fn test(policies: &Policies, _: &Stage) -> anyhow::Result<Tests> {
        let Policies { config, run, last, .. } = policies;
        let layout = policy_layout(config)?;
        let mut steps = 0;
        // There is one actor with one environment: an episode ends where its steps and those before add up to.
        let ends: Vec<u64> = policies
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
            let policy = PolicyFile::read(&path, &layout).context("a policy that was evaluated")?;
            Ok(EvaluatedPolicy {
                episodes: ends.partition_point(|end| *end <= evaluation.env_steps) as u64,
                exact: Walk::of(&greedy(&policy.parameters)).rounded(),
            })
        });
        Ok(Tests {
            evaluated: evaluated.collect::<anyhow::Result<_>>()?,
            q: last.parameters.clone(),
        })
    }

    fn sections(results: &Results<Tests>, album: &Album) -> anyhow::Result<Vec<Section>> {
        let good = results.of(GOOD, "");
        let q_star = optimal(GAMMA);
        let best: Vec<f32> = q_star.iter().flatten().map(|q| *q as f32).collect();
        let walk = Walk::of(&greedy(&best));
        let epsilon = EPSILON.map(|(name, label)| (label, results.of(name, "")));
        let alpha = ALPHA.map(|(name, label)| (label, results.of(name, "")));
        let mut figures = Vec::new();
        for (file, sweep, what, number) in [
            ("epsilon", &epsilon[..], "exploration rates, α = 0.03", "a"),
            ("alpha", &alpha[..], "learning rates, ε = 0.4", "b"),
        ] {
            figures.extend(of_sweep(album, file, sweep, what, number, walk)?);
        }
        if let Some(middle) = representative(good) {
            figures.push(album.add(
                "frozen-lake-policy",
                format!(
                    "The greedy policy and its action-values after 10,000 episodes, seed {} (figure 4.4)",
                    middle.header.seed
                ),
                |path| draw_table(&middle.tests.q, path),
            )?);
        }
        figures.push(album.add(
            "frozen-lake-value-iteration",
            "The best policy and its action-values, by value iteration on the lake's table",
            |path| draw_table(&best, path),
        )?);
        Ok(vec![Section {
            title: "FrozenLake with Q-learning (section 4.1)",
            from: EXPERIMENTS.iter().map(|experiment| (experiment.name, "")).collect(),
            remark: format!(
                "Every step is a round of the whole system: one actor, chunks of one row, one update, then the next action; \
                 that is Algorithm 2 to the letter (and Algorithm 1 for `{SARSA}`: a' is chosen before the update). Ties are \
                 broken by the first index, and with probability ε any of the four actions is taken, the greedy one \
                 included. (Other readings were tried in a prototype, which no command here repeats: with random ties ε = 0.1 comes further, to 0.64 of \
                 the goal instead of 0.28; where exploration excludes the greedy action, ε = 0.7 loses its early lead.) The \
                 policies on the way are evaluated exactly, by the lake's table: how likely the goal is reached within {LIMIT} \
                 steps, and how many steps it takes, {LIMIT} where it is not reached. The five evaluation episodes of the \
                 thesis are run and kept as well, but five throws say little. The best policy reaches the goal with probability \
                 {:.3}.",
                walk.reached
            ),
            claims: claims::all(&epsilon, &alpha, results.of(SARSA, ""), &q_star, walk),
            figures,
        }])
    }
}

/// A setting's name, and its results.
type Sweep<'a> = (&'static str, &'a [SeedResult<Tests>]);

fn of_sweep(
    album: &Album,
    file: &str,
    sweep: &[Sweep<'_>],
    what: &str,
    number: &str,
    best: Walk,
) -> anyhow::Result<Vec<Figure>> {
    let settings = |of: fn(&EvaluatedPolicy) -> f64| -> Vec<Setting> {
        let curves = sweep.iter().map(|(label, seeds)| {
            let runs: Vec<_> = seeds.iter().map(|seed| seed.tests.on_grid(of)).collect();
            Setting {
                label: (*label).into(),
                curve: figure::pointwise(&runs, mean),
                runs,
            }
        });
        curves.collect()
    };
    let frame = |title, y, level| Frame {
        title,
        x: ("training episode", EPISODES as f64),
        y,
        level: Some(("best policy", level)),
    };
    let rewards = frame(
        "Reward of the greedy policy",
        ("probability of the goal", 0.0, 1.0),
        best.reached,
    );
    let steps = frame(
        "Steps of the greedy policy",
        ("steps to the goal (at most 100)", 0.0, 105.0),
        best.steps,
    );
    Ok(vec![
        album.add(
            &format!("frozen-lake-{file}-reward"),
            format!("Reward history for several {what}: mean over the seeds (figure 4.2{number})"),
            |path| figure::lines(&rewards, &settings(|evaluated| evaluated.exact.reached), path),
        )?,
        album.add(
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
