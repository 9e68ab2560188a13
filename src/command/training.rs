//! Trains a run and reports its result: shared by `train` and `resume`.

use std::io::Write;
use std::process::ExitCode;

use clap::Args;
use comfy_table::Table;
use comfy_table::presets::UTF8_BORDERS_ONLY;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use shoal_common::channel::control::RunStatus;
use shoal_common::config::Config;
use shoal_common::message::{one_line, say};
use shoal_common::run_dir::{LockedRun, RunDir};
use shoal_env_server::environment::Goal;
use shoal_learner::process::checkpoint::Checkpoints;
use shoal_report::plots;
use shoal_run::description;
use shoal_run::evaluation::best_policy::{self, FinalResult};
use shoal_run::evaluation::{EvaluationSummary, SavedPolicy};
use shoal_run::numbers::thousands;
use shoal_run::records::outcome::{OutcomeReason, RunOutcome, RunState};
use shoal_run::records::recorder::record_final;
use shoal_run::signals::{Interrupt, Signals, exit_code};

use super::listen::ListenArgs;
use crate::launcher::{self, RunEnd, RunOptions, TrainingOutcome};

/// The output options of a training.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct OutputOptions {
    /// No live line and no table.
    #[arg(long)]
    pub(crate) quiet: bool,
    /// Print one JSON object on standard output at the end. Everything else goes to standard error.
    #[arg(long)]
    pub(crate) json: bool,
    /// Return as soon as all actors work. The run survives this terminal; `top`, `status` and `stop` find it by its
    /// directory.
    #[arg(long)]
    pub(crate) detach: bool,
}

/// The output of `--json`.
#[derive(Serialize)]
struct TrainingJson {
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
    run: &LockedRun,
    output: &OutputOptions,
    listen: &ListenArgs,
) -> anyhow::Result<ExitCode> {
    let gate = listen.prepare(&config, run)?;
    let options = RunOptions {
        quiet: output.quiet,
        gate,
        hosts_wait: listen.hosts_wait,
    };
    let trained = train_and_report(config, run, output, options);
    // If the directory is gone, that explains every other error.
    run.check()?;
    trained
}

fn train_and_report(
    config: Config,
    run: &LockedRun,
    output: &OutputOptions,
    options: RunOptions,
) -> anyhow::Result<ExitCode> {
    let signals = Signals::register()?;
    let outcome = launcher::run(config.clone(), run, &signals, options)?;
    let mut evaluated = Vec::new();
    let RunStatus {
        env_steps, episodes, ..
    } = outcome.after;
    let mut finished = RunOutcome::new(RunState::Finished, env_steps, episodes);
    if outcome.ending == RunEnd::Finished {
        let interrupt = signals.interrupt();
        run.check()?;
        let under_way = RunOutcome::new(RunState::Running, env_steps, episodes);
        under_way.with_reason(OutcomeReason::FinalEvaluation).write(run)?;
        match final_evaluation(&config, run, env_steps, &interrupt, output.quiet) {
            Ok(policies) => {
                evaluated = policies;
                if let Err(error) = record_final(run, env_steps) {
                    say(format!("the final evaluation is not in TensorBoard's records: {error}"));
                }
            }
            Err(error) => {
                run.check()?;
                let why = OutcomeReason::of_missing_evaluation(interrupt.signal(), &error);
                let here = run.path().display();
                launcher::note(run, &why.to_string());
                say(format!(
                    "{why}; the training is finished; to evaluate it: shoal eval {here}"
                ));
                finished = finished.with_reason(why);
                best_policy::ensure_best_policy(&config, run)?;
            }
        }
    }
    let interrupt = signals.interrupt();
    // A run that was stopped should end soon, so no environment is started for a figure.
    let may_start = !evaluated.is_empty() && interrupt.signal().is_none();
    let is_here = || Ok(run.check()?);
    match plots::draw(run, &config, run.path(), may_start.then_some(&interrupt), is_here) {
        Ok(drawn) => {
            if let Some(why) = drawn.no_episode.filter(|_| interrupt.signal().is_none()) {
                say(format!("no episode was drawn: {why}"));
            }
        }
        Err(error) => {
            run.check()?;
            say(format!("the figures could not be drawn: {}", one_line(error)));
        }
    }
    if outcome.ending == RunEnd::Finished {
        run.check()?;
        finished.write(run)?;
    }
    let summary = TrainingJson::new(&config, run, &outcome, evaluated.first().map(|first| &first.summary))?;
    if !output.quiet {
        let results = results(&config, run, &evaluated)?;
        // As in `say`.
        let _ = write_summary(&mut std::io::stderr().lock(), run, &outcome, &summary, &results);
    }
    if output.json {
        writeln!(std::io::stdout().lock(), "{}", serde_json::to_string(&summary)?)?;
    }
    Ok(match outcome.ending {
        // The final evaluation may have been interrupted.
        RunEnd::Finished => signals.interrupt().signal().map_or(ExitCode::SUCCESS, exit_code),
        RunEnd::Stopped => ExitCode::SUCCESS,
        // As a shell reports a process that was ended by the signal.
        RunEnd::Interrupted(signal) => exit_code(signal),
    })
}

/// As [`best_policy::evaluate_and_keep_best`], with a bar for the progress.
fn final_evaluation(
    config: &Config,
    run: &LockedRun,
    env_steps: u64,
    interrupt: &Interrupt,
    quiet: bool,
) -> anyhow::Result<Vec<FinalResult>> {
    let target = if quiet {
        ProgressDrawTarget::hidden()
    } else {
        ProgressDrawTarget::stderr()
    };
    let episodes = config.evaluation.final_episodes;
    let bar = ProgressBar::with_draw_target(Some(episodes.into()), target);
    bar.set_style(ProgressStyle::with_template(
        "final evaluation, {msg} {bar:16.cyan/dim} {pos}/{len} episodes",
    )?);
    let evaluated = best_policy::evaluate_and_keep_best(config, run, env_steps, interrupt, |policy, finished| {
        bar.set_message(name(policy));
        bar.set_position(finished.into());
    });
    bar.finish_and_clear();
    evaluated
}

fn name(policy: SavedPolicy) -> &'static str {
    match policy {
        SavedPolicy::Best => "best policy",
        SavedPolicy::Last => "last policy",
    }
}

impl TrainingJson {
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
        let newest = Checkpoints::new(&run.checkpoints(), config.fingerprint()).load_newest()?;
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
            weights_sha256: newest.map(|loaded| loaded.checkpoint.weights_sha256(config)),
        })
    }
}

/// The name of each evaluated policy and its result in words.
fn results(config: &Config, run: &RunDir, evaluated: &[FinalResult]) -> anyhow::Result<Vec<(&'static str, String)>> {
    if evaluated.is_empty() {
        return Ok(Vec::new());
    }
    let goal = description::of_run(run, config)?.goal;
    let result = |it: &FinalResult| (name(it.policy), in_words(&it.summary, goal.as_ref()));
    Ok(evaluated.iter().map(result).collect())
}

/// The result of an evaluation in an environment with this goal.
fn in_words(evaluated: &EvaluationSummary, goal: Option<&Goal>) -> String {
    let mut text = format!(
        "return {:.2} ± {:.2} over {} episodes",
        evaluated.return_mean, evaluated.return_std, evaluated.episodes
    );
    if let (Some(goal), Some(distance), Some(reached)) =
        (goal, evaluated.final_distance_mean, evaluated.reached_fraction)
    {
        let distance = format!("{distance:.3} {}", goal.distance.unit);
        text += &format!(
            "; ends {} from the goal, at the goal in {:.0} %",
            distance.trim_end(),
            100.0 * reached
        );
    }
    text
}

fn write_summary(
    to: &mut impl Write,
    run: &RunDir,
    outcome: &TrainingOutcome,
    summary: &TrainingJson,
    results: &[(&str, String)],
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
    for (policy, result) in results {
        table.add_row([policy, result.as_str()]);
    }
    writeln!(to, "{table}")?;
    let here = run.path().display();
    if outcome.ending != RunEnd::Finished {
        writeln!(to, "The learner's state is saved; to continue: shoal resume {here}")?;
    }
    writeln!(to, "{here}")?;
    writeln!(
        to,
        "  learning-curve.svg, evaluations.csv, episodes.csv, learner.csv, tensorboard/, checkpoints/, shoal.log"
    )?;
    writeln!(to, "  figures: shoal plot {here}    evaluate again: shoal eval {here}")
}

#[cfg(test)]
mod tests {
    use shoal_env_server::environment::Signal;

    use super::*;

    #[test]
    fn the_distance_to_the_goal_has_the_unit_of_the_environment() {
        let evaluated = EvaluationSummary {
            return_mean: -1.0,
            return_std: 0.5,
            episodes: 10,
            final_distance_mean: Some(0.25),
            reached_fraction: Some(0.9),
        };
        let result = |unit| {
            let distance = Signal::observation(0, "distance", unit);
            in_words(&evaluated, Some(&Goal { distance, within: 0.5 }))
        };
        let expected = "return -1.00 ± 0.50 over 10 episodes; ends 0.250 rad from the goal, at the goal in 90 %";
        assert_eq!(result("rad"), expected);
        assert_eq!(result(""), expected.replace(" rad", ""));
    }
}
