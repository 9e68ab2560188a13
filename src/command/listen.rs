//! `--listen`, of `train` and `resume`: other hosts may join the run.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use shoal_common::config::Config;
use shoal_common::message::say;
use shoal_common::run_dir::{LockedRun, RunDir};
use shoal_remote::NOT_BUILT;
use shoal_remote::endpoint::Endpoint;
use shoal_remote::files::JoinFile;
use shoal_run::usage::UsageError;

/// How long the gate of an earlier launcher may still be listening: it ends after its launcher, but not at once.
const EARLIER_GATE_TIMEOUT: Duration = Duration::from_secs(15);

/// Makes the keys of the run, unless it has them from an earlier start and no new ones are asked for. Returns the path
/// of the hosts' key.
#[cfg(feature = "remote")]
fn make_keys(config: &Config, run: &RunDir, new: bool) -> anyhow::Result<PathBuf> {
    use std::time::SystemTime;

    use shoal_remote::files::KeyFile;
    use shoal_remote::keys::{self, VALIDITY};
    use shoal_run::files::{is_there, remove_if_any};

    let (gate, join) = (run.path().join(KeyFile::GATE), run.path().join(KeyFile::JOIN));
    if new || !(is_there(&gate)? && is_there(&join)?) {
        let keys = keys::make(&config.run.id, SystemTime::now() + VALIDITY)?;
        // Removed first: if this process is killed in between, no pair of keys that do not match is left.
        remove_if_any(&join)?;
        keys.gate.write(&gate)?;
        keys.join.write(&join)?;
    }
    Ok(join)
}

#[cfg(not(feature = "remote"))]
fn make_keys(_config: &Config, _run: &RunDir, _new: bool) -> anyhow::Result<PathBuf> {
    anyhow::bail!(NOT_BUILT)
}

#[derive(Args, Clone, Debug, Default)]
pub(crate) struct ListenArgs {
    /// Let other hosts join the run with `shoal join`, at this address of this machine (tls/10.0.0.1:7447) [default:
    /// all addresses and a free port, or as before].
    #[arg(long, value_name = "ENDPOINT", num_args = 0..=1, default_missing_value = Endpoint::DEFAULT)]
    pub(crate) listen: Option<String>,

    /// Make new keys (with `resume`). Hosts with the old `join.key` are refused.
    #[arg(long, requires = "listen")]
    pub(crate) new_keys: bool,

    /// After SIGTERM, end without the other hosts: they wait for `resume`. For schedulers that requeue jobs.
    #[arg(long, requires = "listen")]
    pub(crate) hosts_wait: bool,
}

impl ListenArgs {
    /// These options, for another process.
    pub(crate) fn arguments(&self) -> Vec<OsString> {
        let Self {
            listen,
            new_keys,
            hosts_wait,
        } = self;
        let listen = listen.iter().map(|endpoint| format!("--listen={endpoint}").into());
        let flags = [(*new_keys, "--new-keys"), (*hosts_wait, "--hosts-wait")];
        let set = flags.into_iter().filter(|(is_set, _)| *is_set);
        listen.chain(set.map(|(_, flag)| flag.into())).collect()
    }

    /// Checks the endpoint before the run is created.
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
    pub(crate) fn prepare(&self, config: &Config, run: &LockedRun) -> anyhow::Result<bool> {
        self.check()?;
        let Some(endpoint) = &self.listen else { return Ok(false) };
        let mut endpoint = endpoint.parse::<Endpoint>()?;
        let before = JoinFile::read(run.path()).ok();
        let timeout = before.as_ref().map_or(Duration::ZERO, |_| EARLIER_GATE_TIMEOUT);
        // A resumed run listens where its earlier hosts try to reach it.
        if endpoint.to_string() == Endpoint::DEFAULT
            && let Some(before) = before
        {
            endpoint = before.listen;
        }
        let listen = endpoint.with_port(timeout)?;
        // The wait for the port may have been long: by now another run may be at this one's place.
        run.check()?;
        let machine = rustix::system::uname().nodename().to_string_lossy().into_owned();
        let endpoint = listen.seen_from_elsewhere(&machine);
        let mut line = format!("listening on {endpoint}; on other hosts: shoal join {endpoint}");
        if endpoint.is_encrypted() {
            let key = make_keys(config, run, self.new_keys)?;
            line += &format!(" --key {}", key.display());
        }
        // After the keys: a host that finds another endpoint here reads the key too.
        JoinFile::new(endpoint, listen).write(run)?;
        say(format!("{line} --actors N"));
        Ok(true)
    }
}
