//! `shoal report`: an interactive report of one or several runs in a single HTML file.

use std::io::Write;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use clap::Args;
use indicatif::ProgressBar;
use shoal_common::durable::write_atomically;
use shoal_common::run_dir::RunDir;
use shoal_report::page::{self, MARK};
use shoal_run::records::start::StartRecord;
use shoal_run::suite::Suite;

use super::output_file::check_replaceable;

#[derive(Args, Clone, Debug)]
pub(crate) struct ReportArgs {
    /// Directories of runs or suites. Runs in the same environment are compared.
    #[arg(value_name = "RUN", required = true)]
    pub(crate) runs: Vec<PathBuf>,
    /// The file to write [default: report.html in that directory; for several, in the working directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
}

/// The default name of the report.
const NAME: &str = "report.html";

/// Collects the data of the runs, writes the page, and prints its path.
pub(crate) fn run(args: &ReportArgs) -> anyhow::Result<()> {
    let runs = open(&args.runs)?;
    let out = match (&args.out, &args.runs[..]) {
        (Some(out), _) => out.clone(),
        // A suite has a directory of its own too.
        (None, [one]) => std::fs::canonicalize(one)
            .with_context(|| format!("cannot resolve {}", one.display()))?
            .join(NAME),
        (None, _) => NAME.into(),
    };
    check_replaceable(&out, "a report", |start| start.starts_with(MARK.as_bytes()))?;
    let suite = match &args.runs[..] {
        [one] if Suite::read(one)?.is_some() => StartRecord::read(one)?,
        _ => None,
    };
    // Pictures of some environments take a while. Nothing is shown where standard error is not a terminal.
    let bar = ProgressBar::new_spinner().with_message("reading the runs and playing episodes");
    bar.enable_steady_tick(Duration::from_millis(200));
    let report = page::gather(&runs, suite);
    bar.finish_and_clear();
    let report = report?;
    for (reason, names) in report.runs_without_episodes() {
        writeln!(
            std::io::stderr().lock(),
            "{}: no episode is shown: {reason}",
            names.join(", ")
        )?;
    }
    let page = report.page()?;
    write_atomically(&out, |file| file.write_all(page.as_bytes()))
        .with_context(|| format!("cannot write {}; choose another place with --out", out.display()))?;
    writeln!(std::io::stdout().lock(), "{}", out.display())?;
    Ok(())
}

/// Opens the runs, and all runs of the suites. Each may be named only once.
fn open(paths: &[PathBuf]) -> anyhow::Result<Vec<RunDir>> {
    let mut runs: Vec<RunDir> = Vec::new();
    for path in paths {
        let of_suite = Suite::read(path)?.map(|suite| suite.runs(path));
        if of_suite.as_ref().is_some_and(Vec::is_empty) {
            bail!("no run of the suite in {} has begun yet", path.display());
        }
        for path in of_suite.unwrap_or_else(|| vec![path.clone()]) {
            let run = RunDir::open(&path)?;
            let twice = runs.contains(&run);
            ensure!(!twice, "{} is named twice: name each run once", path.display());
            runs.push(run);
        }
    }
    Ok(runs)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use shoal_run::testing::small;

    #[test]
    fn a_report_replaces_only_a_report() {
        let parent = tempfile::tempdir().unwrap();
        let run_dir = RunDir::create(&parent.path().join("run")).unwrap();
        let (config, _) = small("name = \"pendulum\"");
        std::fs::write(run_dir.config_file(), config.to_toml().unwrap()).unwrap();
        let report = |out: &Path| {
            run(&ReportArgs {
                runs: vec![run_dir.path().into()],
                out: Some(out.into()),
            })
        };
        let out = parent.path().join("page.html");
        report(&out).unwrap();
        report(&out).unwrap();
        let config = run_dir.config_file();
        let before = std::fs::read(&config).unwrap();
        assert!(
            report(&config)
                .unwrap_err()
                .to_string()
                .contains("exists and is not a report")
        );
        assert_eq!(std::fs::read(&config).unwrap(), before);
        assert!(
            report(parent.path())
                .unwrap_err()
                .to_string()
                .contains("is a directory")
        );
        let nowhere = report(Path::new("/nowhere/at/all.html")).unwrap_err().to_string();
        assert!(nowhere.contains("cannot write /nowhere/at/all.html"), "{nowhere}");
    }

    #[test]
    fn a_run_named_twice_is_an_error() {
        let parent = tempfile::tempdir().unwrap();
        let run_dir = RunDir::create(&parent.path().join("run")).unwrap();
        std::fs::write(run_dir.config_file(), "").unwrap();
        let around = run_dir.path().join("../run");
        let twice = open(&[run_dir.path().into(), around]).unwrap_err().to_string();
        assert!(twice.contains("is named twice"), "{twice}");
    }
}
