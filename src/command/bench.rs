//! `shoal bench`: measures the speed of each stage on this machine.

use clap::Args;
use clap::builder::PossibleValuesParser;
use shoal_bench::Stage;

#[derive(Args, Clone, Debug)]
pub(crate) struct BenchArgs {
    /// What to measure.
    #[arg(value_enum)]
    pub(crate) stage: Stage,
    /// With `actors`: the numbers of actors to measure [default: 1,2,4, … up to the number of cores, at least 4 and
    /// at most 64].
    #[arg(long, value_name = "N,N,…", allow_hyphen_values = true)]
    pub(crate) actors: Option<String>,
    /// With `learner` and `policy`: the algorithm to measure [default: ddpg].
    #[arg(long = "method", value_name = "ALGORITHM", value_parser = PossibleValuesParser::new(shoal_bench::algorithms()))]
    pub(crate) algorithm: Option<String>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Measures a stage and prints the result as a table or as JSON.
pub(crate) fn run(args: &BenchArgs) -> anyhow::Result<()> {
    shoal_bench::run(args.stage, args.actors.as_deref(), args.algorithm.as_deref(), args.json)
}
