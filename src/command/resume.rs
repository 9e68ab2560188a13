//! `shoal resume`: continues a run that was stopped or killed.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use clap::Args;
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use shoal_run::earlier_best::{EvaluatedAnew, evaluate_anew};
use shoal_run::numbers::count;
use shoal_run::plan::warning;
use shoal_run::server_location::ServerLocation;
use shoal_run::signals::{Signals, exit_code};
use shoal_run::status;

use super::listen::ListenArgs;
use super::training::OutputMode;
use super::training::run_training;

#[derive(Args, Clone, Debug)]
pub(crate) struct ResumeArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Environment steps of all actors together, including those already taken [default: as before].
    #[arg(long, value_name = "N", value_parser = count)]
    pub(crate) steps: Option<u64>,
    /// Episodes of all actors together, including those already finished [default: as before].
    #[arg(long, value_name = "M", value_parser = count)]
    pub(crate) episodes: Option<u64>,
    #[command(flatten)]
    pub(crate) output: OutputMode,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
}

/// Continues with the run's replay, counters and noise, until its old or new number of steps or episodes.
pub(crate) fn run(args: &ResumeArgs) -> anyhow::Result<ExitCode> {
    let run = RunDir::open(&args.run)?;
    let mut config = run.config()?;
    // Only the holder of the lock may change the configuration.
    let lock = run.lock()?;
    let here = args.run.display();
    let saved = status::saved_status(&config, &run).with_context(|| format!("cannot resume {here}"))?;
    let (steps_taken, episodes_ended) = (saved.env_steps, saved.episodes);
    let steps = args.steps.unwrap_or(config.run.steps);
    let episodes = args.episodes.or(config.run.episodes);
    // A run with all its steps may still lack updates or the last evaluation.
    if saved.finished || (steps, episodes) != (config.run.steps, config.run.episodes) {
        if steps_taken >= steps {
            bail!("{here} has taken {steps_taken} of {steps} steps already: give it more with --steps");
        }
        if let Some(episodes) = episodes.filter(|episodes| episodes_ended >= *episodes) {
            bail!("{here} has finished {episodes_ended} of {episodes} episodes already: give it more with --episodes");
        }
    }
    // Found now, and not by roles that fail one after the other.
    ServerLocation::of_run(&run).with_context(|| format!("cannot resume {here}"))?;
    if (steps, episodes) != (config.run.steps, config.run.episodes) {
        (config.run.steps, config.run.episodes) = (steps, episodes);
        config.check()?;
        run.write_config(&config)?;
    }
    if let Some(signal) = evaluate_best_anew(&run, &config)? {
        return Ok(exit_code(signal));
    }
    if let Some(warning) = warning(&config) {
        writeln!(std::io::stderr(), "warning: {warning}")?;
    }
    run_training(config, &run, &lock, &args.output, &args.listen)
}

/// Evaluates the best policy again if an earlier version did that from other starts. Returns the signal that ended it, if
/// one did.
fn evaluate_best_anew(run: &RunDir, config: &Config) -> anyhow::Result<Option<i32>> {
    let signals = Signals::register()?;
    let interrupt = signals.interrupt();
    let here = run.path().display();
    match (evaluate_anew(run, config, &interrupt), interrupt.signal()) {
        (Err(_), Some(signal)) => {
            writeln!(
                std::io::stderr(),
                "ended by signal {signal}; nothing has changed in {here}"
            )?;
            Ok(Some(signal))
        }
        (evaluated, _) => {
            let evaluated = evaluated.with_context(|| format!("cannot resume {here}: its best policy"))?;
            if let Some(EvaluatedAnew { before, now }) = evaluated {
                writeln!(
                    std::io::stderr(),
                    "the best policy is evaluated anew, for an earlier version used other starts: {:.2} instead of {before:.2}",
                    now.return_mean
                )?;
            }
            Ok(None)
        }
    }
}
