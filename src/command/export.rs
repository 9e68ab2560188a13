//! `shoal export`: writes a run's policy for other programs.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use clap::ValueEnum;
use shoal_common::durable::write_atomically;
use shoal_common::run_dir::RunDir;
use shoal_report::export::PortablePolicy;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::final_evaluation::FinalEvaluation;

#[derive(Args, Clone, Debug)]
pub(crate) struct ExportArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Format of the file.
    #[arg(long, value_enum)]
    pub(crate) format: Format,
    /// Which policy to write.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) policy: SavedPolicy,
    /// The file to write [default: <policy>.<format> in the run directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
}

/// The format of the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// A graph for any ONNX runtime, including the scaling of actions.
    Onnx,
    /// The weights under PyTorch's names, with metadata.
    Safetensors,
}

/// Writes the policy and prints the path of the file.
pub(crate) fn run(args: &ExportArgs) -> anyhow::Result<()> {
    let run = RunDir::open(&args.run)?;
    let config = run.config()?;
    let name = |value: Option<clap::builder::PossibleValue>| {
        value.map_or_else(String::new, |value| value.get_name().to_owned())
    };
    let which = name(args.policy.to_possible_value());
    let file = args.policy.read(&run, &config)?;
    let mut policy = PortablePolicy::new(&config, &file, &which)?;
    // The version tells whether the evaluation was of this policy.
    let evaluation = FinalEvaluation::read(&run, 0)?;
    if let Some(evaluation) = evaluation
        && let Some(evaluated) = evaluation.of(args.policy).filter(|it| it.version == file.version)
    {
        policy = policy.evaluated(evaluation.seed, evaluated)?;
    }
    let bytes = match args.format {
        Format::Onnx => policy.to_onnx(),
        Format::Safetensors => policy.to_safetensors()?,
    };
    let file = format!("{which}.{}", name(args.format.to_possible_value()));
    let out = args.out.clone().unwrap_or_else(|| args.run.join(file));
    write_atomically(&out, |to| to.write_all(&bytes))
        .with_context(|| format!("cannot write {}; choose another file with --out", out.display()))?;
    writeln!(std::io::stdout(), "{}", out.display())?;
    Ok(())
}
