//! `shoal eval`: evaluates a run's policy.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use comfy_table::Table;
use comfy_table::presets::UTF8_BORDERS_ONLY;
use shoal_common::policy_file::PolicyFile;
use shoal_common::run_dir::RunDir;
use shoal_env_server::environment::Goal;
use shoal_run::description;
use shoal_run::evaluation::{EpisodeSet, EvaluationSummary, SavedPolicy, evaluate_policy};
use shoal_run::numbers::{parse_count, parse_positive_count};
use shoal_run::signals::{Signals, describe, exit_code};

#[derive(Args, Clone, Debug)]
pub(crate) struct EvalArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Which policy to evaluate.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) policy: SavedPolicy,
    /// Number of episodes. Their start states are the same every time.
    #[arg(long, default_value_t = 100, value_parser = parse_positive_count)]
    pub(crate) episodes: u32,
    /// Seed of the start states [default: the run's seed].
    #[arg(long, value_parser = parse_count)]
    pub(crate) seed: Option<u64>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Evaluates a policy and prints the result as a table or as JSON. A signal ends it in order.
pub(crate) fn run(args: &EvalArgs) -> anyhow::Result<ExitCode> {
    let run = RunDir::open(&args.run)?;
    let config = run.config()?;
    let policy = args.policy.read(&run, &config)?;
    let seed = args.seed.unwrap_or(config.run.seed);
    let signals = Signals::register()?;
    let interrupt = signals.interrupt();
    let episodes = EpisodeSet {
        count: args.episodes,
        seed,
    };
    let evaluated = evaluate_policy(&run, &config, &policy.parameters, episodes, &interrupt, |_| ());
    if let (Err(_), Some(signal)) = (&evaluated, interrupt.signal()) {
        writeln!(
            std::io::stderr(),
            "the evaluation was ended by {}; nothing of it is kept",
            describe(signal)
        )?;
        return Ok(exit_code(signal));
    }
    let summary = evaluated?;
    let goal = description::of_run(&run, &config)?.goal;
    let table = table(&summary, &policy, seed, goal.as_ref());
    if args.json {
        writeln!(std::io::stderr().lock(), "{table}")?;
        writeln!(std::io::stdout().lock(), "{}", serde_json::to_string(&summary)?)?;
    } else {
        writeln!(std::io::stdout().lock(), "{table}")?;
    }
    Ok(ExitCode::SUCCESS)
}

fn table(summary: &EvaluationSummary, policy: &PolicyFile, seed: u64, goal: Option<&Goal>) -> Table {
    let mut table = Table::new();
    table.load_style(UTF8_BORDERS_ONLY);
    let mut row = |name: &str, value: String| {
        table.add_row([name.to_owned(), value]);
    };
    row(
        "policy",
        format!(
            "version {}, learned from {} environment steps",
            policy.version, policy.env_steps
        ),
    );
    row(
        "episodes",
        format!("{} from the start states of seed {seed}", summary.episodes),
    );
    row(
        "return",
        format!(
            "{:.2} ± {:.2} (mean ± standard deviation)",
            summary.return_mean, summary.return_std
        ),
    );
    if let Some(goal) = goal {
        let unit = &goal.distance.unit;
        if let Some(distance) = summary.final_distance_mean {
            row("distance at the end", format!("{distance:.4} {unit} on average"));
        }
        if let Some(reached) = summary.reached_fraction {
            row(
                "goal reached",
                format!(
                    "{:.0} % of the episodes (within {} {unit} at the end)",
                    100.0 * reached,
                    goal.within
                ),
            );
        }
    }
    table
}
