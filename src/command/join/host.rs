//! The host of `shoal join`: asks the run to admit it, works for the run, and joins again when that is needed.

use std::cell::Cell;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, bail};
use shoal_common::channel::control::JoinAgain;
use shoal_common::message::say;
use shoal_common::run_dir::RunDir;
use shoal_remote::endpoint::Endpoint;
use shoal_remote::files::{HostFile, JoinFile, KeyFile};
use shoal_remote::join::{GateConnection, JoinError, LeaseKeeper, join as ask};
use shoal_remote::network::restart_with_one_thread;
use shoal_remote::wire::{Admission, Hello, WireLease, cores, vector_instructions};
use shoal_run::joining::make_host_directory;
use shoal_run::records::outcome::{RunOutcome, RunState};
use shoal_run::signals::{Interrupt, Signals, exit_code};
use shoal_run::usage::UsageError;

use super::JoinArgs;
use crate::launcher::joined_launcher::{self, JoinEnd, JoinEvents};

/// The exit code if the run could not be reached, or did not admit the host again, for too long.
const GAVE_UP: u8 = 4;

/// How the names of temporary directories begin; the host's id follows.
const TEMPORARY_PREFIX: &str = "shoal-join-";

/// How the work of a host has ended.
enum HostEnd {
    Exit(ExitCode),
    JoinAgain(JoinAgain),
    /// The run listens at another endpoint now.
    Moved,
}

/// How the run is reached.
#[derive(Clone)]
struct Address {
    endpoint: Endpoint,
    /// `None` if the connection is not encrypted.
    key: Option<KeyFile>,
}

/// This host, as the run knows it, and how it reaches the run.
struct JoiningHost {
    id: u64,
    name: String,
    address: Address,
}

/// Joins the run at `place`, an endpoint or a directory, and works for it until it is over. The host joins again if
/// it has lost its actors, if the run wants it to have another number of actors, or if the run listens at another
/// endpoint.
pub(super) fn join(args: &JoinArgs, place: &str, mut actors: u32) -> anyhow::Result<ExitCode> {
    restart_with_one_thread()?;
    let mut reached = address(args, place, None)?;
    remove_abandoned(&std::env::temp_dir());
    let signals = Signals::register()?;
    let mut attempt = 1;
    loop {
        match join_once(args, place, actors, &reached, &signals, attempt)? {
            HostEnd::Exit(code) => return Ok(code),
            HostEnd::Moved => {
                reached = address(args, place, reached.key.take())?;
                say(format!("the run listens on {} now; joining again", reached.endpoint));
            }
            HostEnd::JoinAgain(JoinAgain::LostActors) => {
                say("the run has given the actors of this host to others; joining again");
            }
            HostEnd::JoinAgain(JoinAgain::Scaled(wanted)) => {
                say(format!("the run wants {wanted} actors of this host; joining again"));
                actors = wanted;
            }
        }
        attempt += 1;
    }
}

/// Joins the run; `attempt` counts from 1.
fn join_once(
    args: &JoinArgs,
    place: &str,
    actors: u32,
    address: &Address,
    signals: &Signals,
    attempt: u32,
) -> anyhow::Result<HostEnd> {
    let interrupt = signals.interrupt();
    let id = draw_host_id()?;
    let name = match &args.name {
        Some(name) => name.clone(),
        None => rustix::system::uname().nodename().to_string_lossy().into_owned(),
    };
    let hello = Hello {
        program: env!("CARGO_PKG_VERSION").into(),
        host: id,
        name: name.clone(),
        instructions: vector_instructions(),
        actors,
        cores: cores(),
        held: Vec::new(),
    };
    let (lease, connection) = match ask_to_be_admitted(args, place, &hello, address, &interrupt, attempt)? {
        Answer::Admitted(lease, connection) => (lease, connection),
        Answer::Exit(code) => return Ok(HostEnd::Exit(code)),
        Answer::Moved => return Ok(HostEnd::Moved),
    };
    let temporary = std::env::temp_dir().join(format!("{TEMPORARY_PREFIX}{id:016x}"));
    let path = match (&args.local, attempt) {
        (None, _) => temporary,
        (Some(local), 1) => local.clone(),
        (Some(local), _) => unused_name(local, attempt),
    };
    let path = path.as_path();
    let address = address.clone();
    let host = JoiningHost { id, name, address };
    let worked = work(args, place, host, (lease, connection), path, signals);
    if args.local.is_none() {
        let log = RunDir::at(path).log();
        if worked.is_err() && log.exists() {
            say(format!("the log of this host is {}", log.display()));
        } else {
            let _ = RunDir::at(path).remove();
        }
    }
    worked
}

/// What has come of a host's request to be admitted.
enum Answer {
    Admitted(WireLease, GateConnection),
    Exit(ExitCode),
    /// The run listens at another endpoint.
    Moved,
}

/// Asks the run to admit this host; `attempt` counts from 1.
///
/// # Errors
/// When the first attempt is refused, or the network fails.
fn ask_to_be_admitted(
    args: &JoinArgs,
    place: &str,
    hello: &Hello,
    address: &Address,
    interrupt: &Interrupt,
    attempt: u32,
) -> anyhow::Result<Answer> {
    let Address { endpoint, key } = address;
    let joins_again = attempt > 1;
    let ends = || interrupt.signal().is_some() || is_finished(place) || has_moved(place, endpoint);
    // When a host joins again, the run may not have got its former actors back yet.
    let said = Cell::new(false);
    let ask_again = |why: &str| {
        if joins_again && !said.replace(true) {
            say(format!("{endpoint} does not admit this host yet: {why}"));
        }
        joins_again
    };
    let run_is_over = || {
        say("the run is over");
        Ok(Answer::Exit(ExitCode::SUCCESS))
    };
    let give_up = |why: String| {
        say(format!("error: {why}"));
        Ok(Answer::Exit(GAVE_UP.into()))
    };
    match (
        ask(endpoint, key.as_ref(), hello, args.give_up, ends, ask_again),
        interrupt.signal(),
    ) {
        (Ok((Admission::Admitted(lease), connection)), _) => Ok(Answer::Admitted(lease, connection)),
        (_, Some(signal)) => Ok(Answer::Exit(exit_code(signal))),
        (Ok((Admission::RunIsEnding, _)), None) if joins_again => run_is_over(),
        (Ok((Admission::RunIsEnding, _)), None) => bail!("{endpoint} admits no host: the run is ending"),
        (Ok((Admission::Refused(_), _)), None) if joins_again && is_finished(place) => run_is_over(),
        (Ok((Admission::Refused(why), _)), None) if joins_again => {
            give_up(format!("{endpoint} does not admit this host again: {why}"))
        }
        (Ok((Admission::Refused(why), _)), None) => bail!("{endpoint} does not admit this host: {why}"),
        (Err(JoinError::Silence { .. }), None) if is_finished(place) => run_is_over(),
        (Err(JoinError::Silence { .. }), None) if has_moved(place, endpoint) => Ok(Answer::Moved),
        (Err(error @ JoinError::Silence { .. }), None) => give_up(error.to_string()),
        (Err(error), None) => Err(error.into()),
    }
}

/// The first of `local-NUMBER`, `local-NUMBER+1`, … that does not exist. An earlier `join` may have left some.
fn unused_name(local: &Path, mut number: u32) -> PathBuf {
    loop {
        let path = PathBuf::from(format!("{}-{number}", local.display()));
        if !path.exists() {
            return path;
        }
        number += 1;
    }
}

/// Works for the run at `place`, an endpoint or a directory.
fn work(
    args: &JoinArgs,
    place: &str,
    host: JoiningHost,
    (lease, connection): (WireLease, GateConnection),
    path: &Path,
    signals: &Signals,
) -> anyhow::Result<HostEnd> {
    let JoiningHost { id, name, address } = host;
    let Address { endpoint, key } = address;
    // The run's id, which names the run in its messages, is in its configuration.
    let run_id = joined_run_id(&lease.config)?;
    // The environment may take minutes to start, and it may not be usable here. If anything fails before the
    // relay runs, `keeper` is dropped, and that gives the actors back to the run.
    let keeper = LeaseKeeper::start(connection, run_id.clone(), id)?;
    let interrupt = signals.interrupt();
    if let Some(signal) = interrupt.signal() {
        return Ok(HostEnd::Exit(exit_code(signal)));
    }
    let (config, run) = make_host_directory(path, &lease.config, lease.first_incarnation, interrupt)?;
    if let Some(key) = key {
        key.write(&run.path().join(KeyFile::JOIN))?;
    }
    HostFile::new(endpoint.clone(), run_id, (id, name), &lease).write(&run)?;
    let has_heard = keeper.run_is_over();
    if has_heard() {
        say("the run is over");
        return Ok(HostEnd::Exit(ExitCode::SUCCESS));
    }
    let actors = lease.actors.clone();
    say(format!("joined {endpoint} with {} actors: {actors:?}", actors.len()));
    let events = JoinEvents {
        on_relay_ready: Box::new(|| keeper.end()),
        run_is_over: Box::new(|| has_heard() || is_finished(place)),
        run_has_moved: Box::new(|| has_moved(place, &endpoint)),
    };
    let ending = joined_launcher::run(config, &run, signals, actors, args.give_up, events);
    if args.local.is_none() && ending.is_err() {
        // While this process has the lock, so that no other one takes the directory for an abandoned one.
        keep_log(&run);
    }
    Ok(HostEnd::Exit(match ending? {
        JoinEnd::Over => {
            say("the run is over");
            ExitCode::SUCCESS
        }
        JoinEnd::JoinAgain(why) => return Ok(HostEnd::JoinAgain(why)),
        JoinEnd::Moved => return Ok(HostEnd::Moved),
        JoinEnd::Stopped => ExitCode::SUCCESS,
        JoinEnd::Interrupted(signal) => exit_code(signal),
        JoinEnd::GaveUp => {
            say(format!(
                "error: {endpoint} could not be reached, or did not admit this host again, for {} s; shoal.log \
                 in the run's directory may tell why",
                args.give_up.as_secs()
            ));
            GAVE_UP.into()
        }
    }))
}

/// Removes the temporary directories of hosts that were killed, with their copies of the key. A host locks its
/// directory before it writes the configuration, and as long as it lives.
fn remove_abandoned(temporary: &Path) {
    let user = rustix::process::getuid().as_raw();
    let is_number = |text: &str| text.len() == 16 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    for entry in std::fs::read_dir(temporary).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let has_name = name
            .to_str()
            .and_then(|name| name.strip_prefix(TEMPORARY_PREFIX))
            .is_some_and(is_number);
        // For a symbolic link, this describes the link itself.
        let is_ours = |metadata: std::fs::Metadata| metadata.is_dir() && metadata.uid() == user;
        if !(has_name && entry.metadata().is_ok_and(is_ours)) {
            continue;
        }
        if let Ok(run) = RunDir::open(&entry.path())
            && let Ok(false) = run.is_running()
            && let Ok(_lock) = run.lock()
        {
            // What cannot be removed is left to the next host.
            let _ = run.remove();
        }
    }
}

/// Removes everything but the log from the directory of a host that has failed. The configuration is last: with it,
/// the next host finds a directory whose removal was interrupted.
fn keep_log(run: &RunDir) {
    for entry in std::fs::read_dir(run.path()).into_iter().flatten().flatten() {
        let path = entry.path();
        if path != run.log() && path != run.config_file() {
            let _ = std::fs::remove_file(&path).or_else(|_| std::fs::remove_dir_all(&path));
        }
    }
    let _ = std::fs::remove_file(run.config_file());
}

/// Whether this is the directory of a run that has done everything: a host that comes late has nothing to wait for.
fn is_finished(place: &str) -> bool {
    let outcome = RunDir::open(Path::new(place)).map(|run| RunOutcome::read(&run));
    matches!(outcome, Ok(Ok(Some(outcome))) if outcome.state == RunState::Finished)
}

/// Whether this is the directory of a run that listens at another endpoint, as after a scheduler has moved it.
fn has_moved(place: &str, endpoint: &Endpoint) -> bool {
    let directory = Path::new(place);
    directory.is_dir() && JoinFile::read(directory).is_ok_and(|file| file.endpoint != *endpoint)
}

/// How the run at `place`, an endpoint or a directory, is reached. `before` is the key that an earlier call returned,
/// for a key from standard input.
fn address(args: &JoinArgs, place: &str, before: Option<KeyFile>) -> anyhow::Result<Address> {
    let directory = Path::new(place);
    let (endpoint, key) = if directory.is_dir() {
        let file = JoinFile::read(directory)
            .with_context(|| format!("nobody can join {place}: was it started with --listen?"))?;
        (
            file.endpoint,
            args.key.clone().unwrap_or_else(|| directory.join(KeyFile::JOIN)),
        )
    } else {
        let endpoint = place.parse::<Endpoint>();
        let endpoint = endpoint.map_err(|error| UsageError(error.to_string()))?;
        let key = match &args.key {
            None if endpoint.is_encrypted() => {
                let why = format!("{endpoint} needs the run's key: --key FILE, the join.key in its directory");
                return Err(UsageError(why).into());
            }
            key => key.clone().unwrap_or_default(),
        };
        (endpoint, key)
    };
    let read = || match before {
        // Standard input can be read only once.
        Some(before) if key == Path::new("-") => Ok(before),
        _ => KeyFile::read(&key),
    };
    let key = endpoint.is_encrypted().then(read).transpose()?;
    Ok(Address { endpoint, key })
}

fn joined_run_id(config: &str) -> anyhow::Result<String> {
    let table: toml::Table = config.parse().context("the run's configuration is damaged")?;
    let id = table
        .get("run")
        .and_then(|run| run.get("id"))
        .and_then(toml::Value::as_str);
    Ok(id.context("the run's configuration has no run.id")?.to_owned())
}

/// A number that no other host draws.
fn draw_host_id() -> anyhow::Result<u64> {
    let mut bytes = [0; 8];
    let mut file = std::fs::File::open("/dev/urandom").context("cannot draw a number")?;
    std::io::Read::read_exact(&mut file, &mut bytes).context("cannot draw a number")?;
    Ok(u64::from_le_bytes(bytes))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_key_from_standard_input_is_read_once() {
        let args = JoinArgs {
            run: None,
            key: Some("-".into()),
            actors: None,
            give_up: Duration::ZERO,
            name: None,
            local: None,
            template: None,
        };
        let key = KeyFile::new("1a".into(), "A".into(), "C".into(), "secret".into());
        let reached = address(&args, "tls/127.0.0.1:7", Some(key.clone())).unwrap();
        assert_eq!(reached.key, Some(key));
    }
}
