//! `shoal join`: joins a run on another host.

#[cfg(feature = "remote")]
mod host;

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, ValueEnum};
use shoal_run::numbers::parse_positive_count;

#[cfg(feature = "remote")]
use self::host::join;

#[derive(Args, Clone, Debug)]
pub(crate) struct JoinArgs {
    /// Where the run listens, as `train --listen` prints it (tls/learner-7:7447); or the run's directory.
    #[arg(value_name = "ENDPOINT|RUN_DIR", required_unless_present = "template")]
    pub(crate) run: Option<String>,
    /// The run's key, the file join.key in its directory; - reads it from standard input [default: that of the
    /// directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) key: Option<PathBuf>,
    /// Actor processes on this host, each with its environment server.
    #[arg(long, value_name = "N", value_parser = parse_positive_count, required_unless_present = "template")]
    pub(crate) actors: Option<u32>,
    /// End, with exit code 4, if the run cannot be reached, or does not admit this host again, for this long, as in 90s,
    /// 10min or 2h.
    #[arg(long, value_name = "TIME", default_value = "10min", value_parser = parse_duration)]
    pub(crate) give_up: Duration,
    /// The host's name in `status` [default: the machine's].
    #[arg(long, value_name = "NAME")]
    pub(crate) name: Option<String>,
    /// Directory DIR for this host's log and other files; it is kept. If the host joins again: DIR-2, and so on [default:
    /// a temporary one].
    #[arg(long, value_name = "DIR")]
    pub(crate) local: Option<PathBuf>,
    /// Print a script or manifest that starts hosts, to be edited, and join nothing.
    #[arg(long, value_name = "FOR", exclusive = true)]
    pub(crate) template: Option<Template>,
}

/// What starts processes on other hosts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Template {
    /// A batch script for Slurm.
    Slurm,
    /// A manifest for Kubernetes.
    Kubernetes,
    /// A script that uses ssh.
    Ssh,
}

impl Template {
    fn text(self) -> &'static str {
        match self {
            Self::Slurm => include_str!("join/slurm.sh"),
            Self::Kubernetes => include_str!("join/kubernetes.yaml"),
            Self::Ssh => include_str!("join/ssh.sh"),
        }
    }
}

/// Joins a run, or prints a template.
pub(crate) fn run(args: &JoinArgs) -> anyhow::Result<ExitCode> {
    if let Some(template) = args.template {
        std::io::stdout().lock().write_all(template.text().as_bytes())?;
        return Ok(ExitCode::SUCCESS);
    }
    let (Some(place), Some(actors)) = (&args.run, args.actors) else {
        anyhow::bail!("name a run to join, and a number of actors");
    };
    join(args, place, actors)
}

/// Reads a time such as `90s`, `10min` or `2h`.
fn parse_duration(text: &str) -> Result<Duration, String> {
    let digits = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let seconds = match unit {
        "s" => Some(1),
        "min" => Some(60),
        "h" => Some(3600),
        _ => None,
    };
    let time = number.parse::<u32>().ok().zip(seconds);
    time.map(|(number, seconds)| Duration::from_secs(u64::from(number) * seconds))
        .filter(|time| !time.is_zero())
        .ok_or_else(|| "write a number above 0 and a unit: 90s, 10min or 2h".into())
}

#[cfg(not(feature = "remote"))]
fn join(_args: &JoinArgs, _place: &str, _actors: u32) -> anyhow::Result<ExitCode> {
    anyhow::bail!(shoal_remote::NOT_BUILT)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_has_a_number_and_a_unit() {
        assert_eq!(parse_duration("90s"), Ok(Duration::from_secs(90)));
        assert_eq!(parse_duration("10min"), Ok(Duration::from_secs(600)));
        assert_eq!(parse_duration("2h"), Ok(Duration::from_secs(7200)));
        for wrong in ["", "0s", "10", "s", "-1s", "1.5h", "1d", "99999999999s"] {
            assert!(parse_duration(wrong).is_err(), "{wrong}");
        }
    }
}
