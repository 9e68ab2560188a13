//! `shoal bench`: how fast each stage is on this machine.

use clap::Args;
use shoal_bench::Stage;

#[derive(Args, Clone, Debug)]
pub(crate) struct BenchArgs {
    /// What to measure.
    #[arg(value_enum)]
    pub(crate) stage: Stage,
    /// With `actors`: how many actors to measure, one after the other [default: 1,2,4, and doubled up to the cores].
    #[arg(long, value_name = "N,N,…", allow_hyphen_values = true)]
    pub(crate) actors: Option<String>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Measures a stage and tells the person, or a script, how fast it is.
pub(crate) fn run(args: &BenchArgs) -> anyhow::Result<()> {
    shoal_bench::run(args.stage, args.actors.as_deref(), args.json)
}
