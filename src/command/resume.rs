//! `shoal resume`: continues a run that was stopped or killed.

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use clap::Args;
use clap_complete::engine::ArgValueCompleter;
use shoal_common::message::say;
use shoal_common::run_dir::{LockedRun, RunDir};
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::earlier_best::{ReevaluatedPolicy, reevaluate_best, reevaluate_if_needed};
use shoal_run::external_environment::server_location::ServerLocation;
use shoal_run::files::is_there;
use shoal_run::numbers::parse_count;
use shoal_run::origin::Origin;
use shoal_run::plan::{RequestedChanges, Revision, warning};
use shoal_run::records::recorder::{ChangeRecord, Moment};
use shoal_run::signals::{Signals, describe, exit_code};
use shoal_run::status;
use shoal_run::suite::{Suite, configuration};
use shoal_run::usage::UsageError;

use super::listen::ListenArgs;
use super::training::{OutputOptions, run_training};
use super::{detach, suite};
use crate::{completion, launcher};

#[derive(Args, Clone, Debug)]
pub(crate) struct ResumeArgs {
    /// Run directory, or the directory of a suite.
    pub(crate) run: PathBuf,
    /// Environment steps of all actors together, including those already taken [default: as before].
    #[arg(long, value_name = "N", value_parser = parse_count)]
    pub(crate) steps: Option<u64>,
    /// Episodes of all actors together, including those already finished [default: as before].
    #[arg(long, value_name = "M", value_parser = parse_count)]
    pub(crate) episodes: Option<u64>,
    /// Change a key that may change in a run, as in --set ddpg.tau=0.005. May be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE", add = ArgValueCompleter::new(completion::settings))]
    pub(crate) set: Vec<String>,
    /// Runs of a suite at a time [default: what cores and /dev/shm allow].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) jobs: Option<u16>,
    #[command(flatten)]
    pub(crate) output: OutputOptions,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
}

impl ResumeArgs {
    /// All options except the output options, for another process.
    fn for_another_process(&self) -> Vec<OsString> {
        let Self {
            run: _,
            steps,
            episodes,
            set,
            jobs,
            output: _,
            listen,
        } = self;
        let number = |name: &str, value: Option<u64>| value.map(|value| format!("--{name}={value}"));
        let numbers = [
            number("steps", *steps),
            number("episodes", *episodes),
            number("jobs", jobs.map(u64::from)),
        ];
        let set = set.iter().map(|assignment| format!("--set={assignment}"));
        let options = numbers.into_iter().flatten().chain(set).map(OsString::from);
        options.chain(listen.arguments()).collect()
    }
}

/// Continues with the run's replay, counters and noise, until its old or new number of steps or episodes, and with what
/// was changed in its configuration.
pub(crate) fn run(args: &ResumeArgs) -> anyhow::Result<ExitCode> {
    if Suite::read(&args.run)?.is_some() {
        return resume_suite(args);
    }
    if args.jobs.is_some() {
        return Err(UsageError("--jobs: only for suites, and this is one run".into()).into());
    }
    if args.output.detach {
        return detach::resume_run(&args.run, &args.for_another_process(), &args.output);
    }
    // Only the holder of the lock may change the configuration.
    let run = RunDir::open(&args.run)?.lock()?;
    let used = run.config()?;
    launcher::wait_for_predecessors(&used.run.id, &run)?;
    let here = args.run.display();
    if is_there(&run.replay_removed())? && !is_there(&run.replay_file())? {
        bail!(
            "cannot resume {here}: `shoal rm --replay` has removed its replay, from which it would learn; eval, report, \
             plot and film still work, and `shoal train … --from {here}` begins a new run with its networks"
        );
    }
    if used.run.has_origin() && Origin::read(&run)?.is_none() {
        bail!("{here} was interrupted while it copied its initial networks or rows; remove it and train again");
    }
    let saved = status::saved_status(&used, &run).with_context(|| format!("cannot resume {here}"))?;
    let asked = RequestedChanges {
        steps: args.steps,
        episodes: args.episodes,
        set: args.set.clone(),
    };
    let revision = Revision::new(&run, &used, &asked)?;
    let config = &revision.config;
    let (steps_taken, episodes_ended) = (saved.env_steps, saved.episodes);
    let (steps, episodes) = (config.run.steps, config.run.episodes);
    // A run with all its steps may still lack updates or the last evaluation.
    if saved.finished || (steps, episodes) != (used.run.steps, used.run.episodes) {
        if steps_taken >= steps {
            bail!("{here} has already taken {steps_taken} of {steps} steps; raise the limit with --steps");
        }
        if let Some(episodes) = episodes.filter(|episodes| episodes_ended >= *episodes) {
            bail!(
                "{here} has already finished {episodes_ended} of {episodes} episodes; raise the limit with --episodes"
            );
        }
    }
    // Checked here, so that a missing program is one error of this command and not repeated failures of the roles.
    ServerLocation::of_run(&run).with_context(|| format!("cannot resume {here}"))?;
    if let Some(signal) = reevaluate_best_policy(&run, &revision)? {
        return Ok(exit_code(signal));
    }
    // A learner that was killed has reported more steps than it has saved.
    let mut now = Moment::of_records(&run)?;
    now.env_steps = now.env_steps.max(steps_taken);
    run.check()?;
    for change in revision.apply(&run, now)? {
        let ChangeRecord {
            key,
            before,
            after,
            source,
            env_steps,
            ..
        } = change;
        let line = format!("{key} changes from {before} to {after} at step {env_steps} ({source})");
        launcher::note(&run, &line);
        if !args.output.quiet {
            say(line);
        }
    }
    if let Some(warning) = warning(config) {
        say(format!("warning: {warning}"));
    }
    run_training(revision.config, &run, &args.output, &args.listen)
}

fn resume_suite(args: &ResumeArgs) -> anyhow::Result<ExitCode> {
    if args.listen.listen.is_some() {
        return Err(UsageError("--listen: other hosts join a single run, and this is a suite".into()).into());
    }
    if args.output.detach {
        // The process that it starts makes the changes.
        return detach::resume_suite(&args.run, &args.for_another_process(), &args.output);
    }
    let number = |key: &str, value: Option<u64>| value.map(|value| format!("{key}={value}"));
    let numbers = [number("run.steps", args.steps), number("run.episodes", args.episodes)];
    let changes: Vec<String> = args.set.iter().cloned().chain(numbers.into_iter().flatten()).collect();
    configuration::change(&args.run, &changes)?;
    let options = suite::SuiteOptions {
        jobs: args.jobs,
        output: &args.output,
    };
    suite::resume(&args.run, options)
}

/// Evaluates the best policy again if an earlier version did that from other starts, or if later policies are evaluated
/// with another number of episodes. Returns the signal that ended it, if one did.
fn reevaluate_best_policy(run: &LockedRun, revision: &Revision) -> anyhow::Result<Option<i32>> {
    let signals = Signals::register()?;
    let interrupt = signals.interrupt();
    let here = run.path().display();
    let config = &revision.config;
    let episodes = u64::from(config.evaluation.episodes);
    // If the best policy cannot be read, the evaluator reports that.
    let has_other_episodes = SavedPolicy::Best
        .read(run, config)
        .is_ok_and(|best| ![0, episodes].contains(&best.episodes));
    let (evaluated, why) = if revision.changes_key("evaluation.episodes") {
        (
            reevaluate_best(run, config, &interrupt),
            "the number of episodes has changed",
        )
    } else if has_other_episodes {
        (
            reevaluate_best(run, config, &interrupt),
            "the final evaluation had another number of episodes",
        )
    } else {
        (
            reevaluate_if_needed(run, config, &interrupt),
            "an earlier version used other starts",
        )
    };
    match (evaluated, interrupt.signal()) {
        (Err(_), Some(signal)) => {
            say(format!("ended by {}; nothing has changed in {here}", describe(signal)));
            Ok(Some(signal))
        }
        (evaluated, signal) => {
            let evaluated = evaluated.with_context(|| format!("cannot resume {here}: its best policy"))?;
            if let Some(ReevaluatedPolicy { before, now }) = evaluated {
                say(format!(
                    "the best policy is re-evaluated, because {why}: {:.2} instead of {before:.2}",
                    now.return_mean
                ));
            }
            Ok(signal)
        }
    }
}
