//! `shoal export`: writes a run's policy or its replay for other programs.

use std::io::Write;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::ArgGroup;
use clap::Args;
use clap::ValueEnum;
use shoal_common::durable::write_atomically;
use shoal_common::run_dir::RunDir;
use shoal_report::export::PortablePolicy;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::final_evaluation::FinalEvaluation;
use shoal_run::python;
use shoal_run::usage::UsageError;

use super::output_file::check_replaceable;

#[derive(Args, Clone, Debug)]
#[command(group = ArgGroup::new("what").required(true))]
pub(crate) struct ExportArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Write the policy, in this format.
    #[arg(long, value_enum, group = "what")]
    pub(crate) format: Option<Format>,
    /// Which policy to write.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) policy: SavedPolicy,
    /// The file to write [default: <policy>.<format> in the run directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Write the replay as a new dataset of Minari, like pendulum/expert-v0. This needs Python's package minari.
    #[arg(long, value_name = "DATASET", group = "what", conflicts_with_all = ["policy", "out"])]
    pub(crate) minari: Option<String>,
    /// Who made the dataset.
    #[arg(long, value_name = "NAME", conflicts_with = "format")]
    pub(crate) author: Option<String>,
}

/// The format of the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// A graph for any ONNX runtime, including the scaling of actions.
    Onnx,
    /// The weights under PyTorch's names, with metadata.
    Safetensors,
}

impl Format {
    /// Whether a file that starts with these bytes is one of this format that Shoal has written.
    fn is(self, start: &[u8]) -> bool {
        match self {
            // The version of ONNX's file format, and the name of the program.
            Self::Onnx => start.starts_with(b"\x08\x08\x12\x05shoal"),
            // The length of the header, a small number of 64 bits, and the header, which is JSON.
            Self::Safetensors => start.get(5..9) == Some(b"\0\0\0{"),
        }
    }
}

/// Writes the policy or the replay and prints the path of the file or dataset.
pub(crate) fn run(args: &ExportArgs) -> anyhow::Result<()> {
    let run = RunDir::open(&args.run)?;
    match (args.format, &args.minari) {
        (Some(format), _) => write_policy(args, &run, format),
        (None, Some(dataset)) => write_dataset(args, dataset),
        (None, None) => Err(UsageError("name a --format for the policy, or a dataset with --minari".into()).into()),
    }
}

/// Replaces this process by `python3 -m shoal.datasets`.
fn write_dataset(args: &ExportArgs, dataset: &str) -> anyhow::Result<()> {
    let mut command = python::module("shoal.datasets")?;
    // A directory may begin with a hyphen.
    command.arg(Path::new(".").join(&args.run));
    command.arg(format!("--minari={dataset}"));
    command.args(args.author.iter().map(|author| format!("--author={author}")));
    Err(command.exec().into())
}

fn write_policy(args: &ExportArgs, run: &RunDir, format: Format) -> anyhow::Result<()> {
    let config = run.config()?;
    let name = |value: Option<clap::builder::PossibleValue>| {
        value.map_or_else(String::new, |value| value.get_name().to_owned())
    };
    let which = name(args.policy.to_possible_value());
    let file = args.policy.read(run, &config)?;
    let mut policy = PortablePolicy::new(&config, &file, &which)?;
    // The version tells whether the evaluation was of this policy.
    let evaluation = FinalEvaluation::read(run, 0)?;
    if let Some(evaluation) = evaluation
        && let Some(evaluated) = evaluation.of(args.policy).filter(|it| it.version == file.version)
    {
        policy = policy.evaluated(evaluation.seed, evaluated)?;
    }
    let bytes = match format {
        Format::Onnx => policy.to_onnx(),
        Format::Safetensors => policy.to_safetensors()?,
    };
    let file = format!("{which}.{}", name(format.to_possible_value()));
    let out = args.out.clone().unwrap_or_else(|| args.run.join(file));
    check_replaceable(&out, "an exported policy of this format", |start| format.is(start))?;
    write_atomically(&out, |to| to.write_all(&bytes))
        .with_context(|| format!("cannot write {}; choose another file with --out", out.display()))?;
    writeln!(std::io::stdout(), "{}", out.display())?;
    Ok(())
}
