//! Trains a run and reports its result: shared by `train` and `resume`.

use std::io::Write;
use std::process::ExitCode;

use clap::Args;
use comfy_table::Table;
use comfy_table::presets::UTF8_BORDERS_ONLY;
use serde::Serialize;
use shoal_common::channel::control::RunStatus;
use shoal_common::config::Config;
use shoal_common::run_dir::{RunDir, RunLock};
use shoal_learner::algorithms::registry;
use shoal_learner::networks::digest;
use shoal_learner::process::checkpoint::Checkpoints;
use shoal_report::plots;
use shoal_run::evaluation::{EvaluationSummary, WhichPolicy, evaluate_run};
use shoal_run::numbers::thousands;
use shoal_run::outcome::{RunOutcome, RunState};
use shoal_run::signals::exit_code;

use crate::launcher::{self, Ending, TrainingOutcome};

/// The output options of a training.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct OutputMode {
    /// No live line and no table.
    #[arg(long)]
    pub(crate) quiet: bool,
    /// Print one JSON object on standard output at the end. Everything else goes to standard error.
    #[arg(long)]
    pub(crate) json: bool,
}

/// The output of `--json`.
#[derive(Serialize)]
struct Summary {
    run: String,
    env_steps: u64,
    updates: u64,
    episodes: u64,
    wall_seconds: f64,
    /// Mean rates since this launcher started.
    updates_per_second: f64,
    env_steps_per_second: f64,
    /// The final evaluation of the best policy; `None` if the run was stopped or interrupted.
    eval_return_mean: Option<f64>,
    eval_return_std: Option<f64>,
    eval_episodes: Option<u32>,
    weights_sha256: Option<String>,
}

/// Trains until the run is finished, stopped or interrupted. Then evaluates its policies, draws its figures, and prints
/// the result. This process owns the run until all of that is done.
pub(crate) fn run_training(
    config: Config,
    run: &RunDir,
    _lock: RunLock,
    output: &OutputMode,
) -> anyhow::Result<ExitCode> {
    let outcome = launcher::run(config.clone(), run, output.quiet)?;
    let evaluated = match outcome.ending {
        Ending::Finished => final_evaluation(&config, run)?,
        Ending::Stopped | Ending::Interrupted(_) | Ending::Renewed => Vec::new(),
    };
    plots::draw(run, &config, run.path())?;
    if outcome.ending == Ending::Finished {
        let RunStatus {
            env_steps, episodes, ..
        } = outcome.after;
        RunOutcome::new(RunState::Finished, env_steps, episodes).write(run)?;
    }
    let summary = Summary::new(&config, run, &outcome, evaluated.first().map(|(_, summary)| summary))?;
    if !output.quiet {
        write_summary(&mut std::io::stderr().lock(), run, &outcome, &summary, &evaluated)?;
    }
    if output.json {
        writeln!(std::io::stdout().lock(), "{}", serde_json::to_string(&summary)?)?;
    }
    Ok(match outcome.ending {
        Ending::Finished | Ending::Stopped | Ending::Renewed => ExitCode::SUCCESS,
        // As a shell reports a process that was ended by the signal.
        Ending::Interrupted(signal) => exit_code(signal),
    })
}

/// The final evaluation: the policy with the best evaluation first, then the last one.
fn final_evaluation(config: &Config, run: &RunDir) -> anyhow::Result<Vec<(&'static str, EvaluationSummary)>> {
    let mut evaluated = Vec::new();
    for (name, path, which) in [
        ("best policy", run.best_policy(), WhichPolicy::Best),
        ("last policy", run.last_policy(), WhichPolicy::Last),
    ] {
        if path.exists() {
            let parameters = which.read(run, config)?.parameters;
            evaluated.push((
                name,
                evaluate_run(
                    run,
                    config,
                    &parameters,
                    config.evaluation.final_episodes,
                    config.run.seed,
                )?,
            ));
        }
    }
    Ok(evaluated)
}

impl Summary {
    fn new(
        config: &Config,
        run: &RunDir,
        outcome: &TrainingOutcome,
        evaluated: Option<&EvaluationSummary>,
    ) -> anyhow::Result<Self> {
        let wall_seconds = outcome.wall.as_secs_f64();
        let RunStatus {
            env_steps,
            updates,
            episodes,
            ..
        } = outcome.after;
        // Saturating: a learner whose newest checkpoint was damaged has fallen back to an older one.
        let done = updates.saturating_sub(outcome.before.updates);
        let taken = env_steps.saturating_sub(outcome.before.env_steps);
        Ok(Self {
            run: run.path().display().to_string(),
            env_steps,
            updates,
            episodes,
            wall_seconds,
            updates_per_second: done as f64 / wall_seconds,
            env_steps_per_second: taken as f64 / wall_seconds,
            eval_return_mean: evaluated.map(|evaluated| evaluated.return_mean),
            eval_return_std: evaluated.map(|evaluated| evaluated.return_std),
            eval_episodes: evaluated.map(|evaluated| evaluated.episodes),
            weights_sha256: weights_sha256(config, run)?,
        })
    }
}

/// SHA-256 of the learned weights in the newest checkpoint; for DDPG: actor, critic and both targets.
fn weights_sha256(config: &Config, run: &RunDir) -> anyhow::Result<Option<String>> {
    let loaded = Checkpoints::new(&run.checkpoints(), config.fingerprint()).load_newest()?;
    Ok(loaded.map(|loaded| {
        let section = |name| loaded.checkpoint.sections.iter().find(|(found, _)| found == name);
        let weights = registry::weights(&config.algorithm).iter().filter_map(section);
        digest::sha256(&weights.map(|(_, numbers)| numbers.as_slice()).collect::<Vec<_>>())
    }))
}

fn write_summary(
    to: &mut impl Write,
    run: &RunDir,
    outcome: &TrainingOutcome,
    summary: &Summary,
    evaluated: &[(&str, EvaluationSummary)],
) -> std::io::Result<()> {
    let mut table = Table::new();
    table.load_style(UTF8_BORDERS_ONLY);
    table.add_row(["environment steps", &thousands(summary.env_steps)]);
    table.add_row(["updates", &thousands(summary.updates)]);
    table.add_row(["episodes", &thousands(summary.episodes)]);
    table.add_row(["time", &format!("{:.1} s", summary.wall_seconds)]);
    table.add_row([
        "rates",
        &format!(
            "{:.0} updates/s, {:.0} steps/s",
            summary.updates_per_second, summary.env_steps_per_second
        ),
    ]);
    for (name, evaluated) in evaluated {
        let mut text = format!(
            "return {:.2} ± {:.2} over {} episodes",
            evaluated.return_mean, evaluated.return_std, evaluated.episodes
        );
        if let (Some(distance), Some(reached)) = (evaluated.final_distance_mean, evaluated.reached_fraction) {
            text += &format!(
                "; ends {distance:.3} m from the goal, at the goal in {:.0} %",
                100.0 * reached
            );
        }
        table.add_row([*name, &text]);
    }
    writeln!(to, "{table}")?;
    let here = run.path().display();
    if outcome.ending != Ending::Finished {
        writeln!(to, "The learner's state is saved; to continue: shoal resume {here}")?;
    }
    writeln!(to, "{here}")?;
    writeln!(
        to,
        "  learning-curve.svg, evaluations.csv, episodes.csv, learner.csv, tensorboard/, checkpoints/, shoal.log"
    )?;
    writeln!(to, "  figures: shoal plot {here}    evaluate again: shoal eval {here}")
}
