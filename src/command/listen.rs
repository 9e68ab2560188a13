//! `--listen`, of `train` and `resume`: other hosts may join the run.

use std::io::Write;

use clap::Args;
use shoal_common::config::{Config, Mode};
use shoal_common::run_dir::RunDir;
use shoal_remote::endpoint::Endpoint;
use shoal_remote::files::JoinFile;
use shoal_run::plan::UsageError;

use super::join::NOT_BUILT;

#[derive(Args, Clone, Debug, Default)]
pub(crate) struct ListenArgs {
    /// Let other hosts join the run with `shoal join`. [default endpoint: a free port of this machine]
    #[arg(long, value_name = "ENDPOINT", num_args = 0..=1, default_missing_value = Endpoint::DEFAULT)]
    pub(crate) listen: Option<String>,
}

impl ListenArgs {
    /// Refuses what cannot be, before a run is made.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        let Some(endpoint) = &self.listen else { return Ok(()) };
        if !cfg!(feature = "remote") {
            anyhow::bail!(NOT_BUILT);
        }
        endpoint
            .parse::<Endpoint>()
            .map_err(|error| UsageError(error.to_string()))?;
        Ok(())
    }

    /// Writes `join.toml` and says how to join, if other hosts may. Returns whether they may.
    pub(crate) fn prepare(&self, config: &Config, run: &RunDir) -> anyhow::Result<bool> {
        self.check()?;
        let Some(endpoint) = &self.listen else { return Ok(false) };
        if config.run.mode == Mode::Lockstep {
            anyhow::bail!("other hosts cannot join a lockstep run yet: leave out --listen or --lockstep");
        }
        let endpoint = endpoint.parse::<Endpoint>()?.with_port()?;
        JoinFile::new(endpoint).write(run)?;
        // As everywhere, a terminal that is gone must not make the run a failure.
        let _ = writeln!(
            std::io::stderr(),
            "listening on {endpoint}; to join: shoal join {endpoint} --actors N"
        );
        Ok(true)
    }
}
