//! One kill of one process before one system call, and the checks of the run afterwards.

use std::fmt;
use std::process::Command;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use shoal_learner::algorithms::registry;
use shoal_learner::networks::digest;
use shoal_learner::process::checkpoint::Checkpoints;

use crate::calls::Call;
use crate::sweep::number;
use crate::tracer::{Followed, Target, follow};
use crate::workplace::{Program, Watchdog, Workplace};

/// A run that takes longer hangs; an ordinary one takes less than a second.
fn limit() -> Duration {
    Duration::from_secs(number("SHOAL_CRASH_SECONDS").unwrap_or(60))
}

/// Longest wait for the roles to end after their launcher was killed.
const ENDING_TIMEOUT: Duration = Duration::from_secs(30);

/// Steps of a run in which a role is killed, and of a run beside which a command is killed.
const STEPS: u64 = 1500;
const STEPS_WITH_COMMAND: u64 = 20_000;

/// Settings for a small run.
pub(crate) const SMALL: [&str; 14] = [
    "--set",
    "ddpg.hidden=[8,8]",
    "--set",
    "ddpg.batch=8",
    "--set",
    "replay.warmup=64",
    "--set",
    "replay.capacity=5000",
    "--set",
    "evaluation.episodes=2",
    "--set",
    "evaluation.final_episodes=2",
    "--set",
    "actors.max=4",
];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    Free,
    Lockstep,
}

impl Mode {
    pub(crate) const BOTH: [Self; 2] = [Self::Free, Self::Lockstep];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Free => "free",
            Self::Lockstep => "lockstep",
        }
    }
}

/// The process to kill.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Victim {
    Role(&'static str, u32),
    /// An environment server in Python.
    Python(u32),
    Launcher,
    /// A command that is executed while the run is running.
    Command(&'static str),
    /// The process that cleans up shared memory after a killed actor. The test starts it while the launcher is stopped;
    /// the launcher repeats the clean-up afterwards.
    CleanUp,
}

/// Index of the evaluator's environment server: it follows the servers of all possible actors (`actors.max`).
const EVALUATION: u32 = 4;

impl Victim {
    pub(crate) const ALL: [Self; 12] = [
        Self::Role("learner", 0),
        Self::Role("actor", 0),
        Self::Role("env-server", 0),
        Self::Role("evaluator", 0),
        Self::Role("env-server", EVALUATION),
        Self::Launcher,
        Self::Command("status"),
        Self::Command("scale"),
        Self::Command("stop"),
        Self::CleanUp,
        Self::Python(0),
        Self::Python(EVALUATION),
    ];

    /// The calls to try. `open` is left out for Python, which opens hundreds of files of its own.
    pub(crate) fn calls(self) -> impl Iterator<Item = Call> {
        let all = Call::ALL.into_iter();
        all.filter(move |call| !matches!((self, call), (Self::Python(_), Call::Open)))
    }

    fn target(self) -> Target {
        match self {
            Self::Role(name, index) => Target::Role(name, index),
            Self::Python(index) => Target::Program(index),
            Self::Launcher | Self::Command(_) | Self::CleanUp => Target::Command,
        }
    }

    /// The environment to train in.
    fn environment(self) -> &'static str {
        match self {
            Self::Python(_) => "gym:Pendulum-v1",
            _ => "pendulum",
        }
    }

    fn steps(self) -> u64 {
        match self {
            Self::Command(_) | Self::CleanUp => STEPS_WITH_COMMAND,
            _ => STEPS,
        }
    }

    /// Whether a lockstep run ends with the same bits after this process was killed.
    fn keeps_bits(self) -> bool {
        !matches!(self, Self::Python(_))
    }
}

impl fmt::Display for Victim {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Role(name, index) => write!(f, "{name}-{index}"),
            Self::Python(index) => write!(f, "python-{index}"),
            Self::Launcher => write!(f, "launcher"),
            Self::Command(command) => write!(f, "{command}"),
            Self::CleanUp => write!(f, "clean-up"),
        }
    }
}

/// A process to kill, and the run in which it is killed.
#[derive(Clone, Copy)]
pub(crate) struct Case<'a> {
    pub(crate) program: &'a Program,
    pub(crate) victim: Victim,
    pub(crate) mode: Mode,
}

/// The result of a kill.
pub(crate) enum Outcome {
    /// The process never made that call.
    NotReached,
    Survived,
    Failed(String),
}

/// The result of a run without a kill.
pub(crate) struct Baseline {
    /// Calls of each kind that the victim makes.
    pub(crate) counts: std::collections::BTreeMap<Call, u32>,
    weights: String,
}

impl Case<'_> {
    /// Runs without a kill. The outer error means that the machine does not allow tracing.
    pub(crate) fn baseline(&self) -> nix::Result<Result<Baseline, String>> {
        let place = Workplace::new(self.program);
        let traced = self.traced(&place, None);
        let explained = |what| explain(&place, what);
        Ok(match traced? {
            Err(what) => Err(explained(what)),
            Ok(followed) => self.check(&place, &followed, None).map_err(explained).and_then(|()| {
                Ok(Baseline {
                    counts: followed.counts,
                    weights: weights(&place, "run").map_err(explained)?,
                })
            }),
        })
    }

    /// Kills the victim before a call, and checks the run.
    pub(crate) fn kill_before(&self, call: Call, number: u32, baseline: &Baseline) -> Outcome {
        let place = Workplace::new(self.program);
        let followed = match self.traced(&place, Some((call, number))) {
            Ok(Ok(followed)) => followed,
            Ok(Err(what)) => return Outcome::Failed(explain(&place, what)),
            Err(errno) => return Outcome::Failed(format!("cannot be traced: {errno}")),
        };
        match self.check(&place, &followed, Some(baseline)) {
            Err(what) => Outcome::Failed(explain(&place, format!("({}) {what}", description(&followed)))),
            Ok(()) if followed.hit.is_none() => Outcome::NotReached,
            Ok(()) => Outcome::Survived,
        }
    }

    /// Runs the training to its end, and the victim's command too if that is another one. Traces the victim's command.
    fn traced(&self, place: &Workplace<'_>, crash_point: Option<(Call, u32)>) -> nix::Result<Result<Followed, String>> {
        let train = self.train("run");
        let train: Vec<&str> = train.iter().map(String::as_str).collect();
        let traced = |name: &str, arguments: &[&str]| {
            std::thread::scope(|scope| {
                let watchdog = Watchdog::new(scope, place, limit());
                let prepare = |command: &mut Command| place.prepare(command, name);
                let followed = follow(
                    &place.command_line(arguments),
                    prepare,
                    self.victim.target(),
                    crash_point,
                );
                let found = watchdog.found();
                followed.map(|followed| match found {
                    None => Ok(followed),
                    Some(found) => Err(format!("({}) {name} {found}", description(&followed))),
                })
            })
        };
        let command = match self.victim {
            Victim::Command(command) => command,
            Victim::CleanUp => "clean-up",
            _ => return traced("train", &train),
        };
        let mut run = place.start("train", &train);
        let launcher = Pid::from_child(&run);
        let run_command = || {
            if let Err(what) = until(limit(), "every role is ready", || {
                place.read("run/shoal.log").contains("every role is ready")
            }) {
                return Ok(Err(what));
            }
            let followed = if self.victim == Victim::CleanUp {
                let id = match kill_actor(place, launcher) {
                    Ok(id) => id,
                    Err(what) => return Ok(Err(what)),
                };
                let followed = traced(command, &[command, &std::process::id().to_string(), &id]);
                let _ = kill_process(launcher, Signal::CONT);
                followed
            } else {
                traced(command, &arguments_of(command))
            };
            followed.map(|followed| followed.and_then(|followed| check_answer(place, command, followed)))
        };
        match run_command() {
            Ok(Ok(followed)) => Ok(place
                .wait(run, "train", limit())
                .map(|code| Followed { code, ..followed })),
            failed => {
                place.kill_all();
                let _ = run.wait();
                failed
            }
        }
    }

    fn train(&self, run: &str) -> Vec<String> {
        let steps = self.victim.steps();
        let (steps, every) = (steps.to_string(), format!("evaluation.every={}", steps / 3));
        let environment = self.victim.environment();
        let plain = ["train", environment, "--run", run, "--seed", "1", "--steps", &steps];
        let more = ["--actors", "1", "--quiet", "--json", "--set", &every];
        let mut words: Vec<String> = [&plain[..], &more, &SMALL]
            .concat()
            .into_iter()
            .map(Into::into)
            .collect();
        words.extend((self.mode == Mode::Lockstep).then(|| "--lockstep".into()));
        words
    }

    /// Checks the run after the traced command has ended.
    fn check(&self, place: &Workplace<'_>, followed: &Followed, baseline: Option<&Baseline>) -> Result<(), String> {
        let mut run = "run";
        if self.victim == Victim::Launcher && followed.hit.is_some() {
            run = self.recover_from_killed_launcher(place)?;
        } else if followed.code != 0 {
            return Err(format!("the run ended with {}", followed.code));
        }
        if self.victim == Victim::Command("stop") && steps(place, "train") < Some(self.victim.steps()) {
            match place.run("resume", &["resume", "run", "--quiet", "--json"], limit())? {
                0 => {}
                code => return Err(format!("the resumed run ended with {code}")),
            }
        }
        place.wait_until_empty(Duration::from_secs(5))?;
        for run in ["run", run] {
            let leftovers = place.leftovers(run);
            if !leftovers.is_empty() {
                return Err(format!(
                    "{} files are left: {:?}",
                    leftovers.len(),
                    &leftovers[..leftovers.len().min(3)]
                ));
            }
        }
        if let Some(baseline) = baseline.filter(|_| self.mode == Mode::Lockstep && self.victim.keeps_bits())
            && weights(place, run)? != baseline.weights
        {
            return Err("the run ended with other bits".into());
        }
        Ok(())
    }

    /// After a kill of the launcher: checks that its roles end and that the run can be resumed, or else another run
    /// started. Returns the directory of the run that ended successfully.
    fn recover_from_killed_launcher(&self, place: &Workplace<'_>) -> Result<&'static str, String> {
        place.wait_until_empty(ENDING_TIMEOUT)?;
        let again = self.train("again");
        let again: Vec<&str> = again.iter().map(String::as_str).collect();
        let another = || match place.run("again", &again, limit())? {
            0 => Ok("again"),
            code => Err(format!("another run ended with {code}")),
        };
        if !place.path("run/config.toml").exists() {
            return another();
        }
        match place.run("resume", &["resume", "run", "--quiet", "--json"], limit())? {
            0 => Ok("run"),
            // The run had completed. The next start removes its leftovers.
            1 if place.read("resume.err").contains("raise the limit with --steps") => another().map(|_| "run"),
            code => Err(format!("the resumed run ended with {code}")),
        }
    }
}

/// The path or file of the call before which the victim was killed.
fn description(followed: &Followed) -> &str {
    followed.hit.as_deref().unwrap_or("no process was killed")
}

/// Stops the launcher and kills the actor, so that there is something to clean up. Returns the run's id.
fn kill_actor(place: &Workplace<'_>, launcher: Pid) -> Result<String, String> {
    let actors = || {
        let processes = place.processes().into_iter();
        let mut actors = processes.filter(|(_, words)| words.starts_with("shoal actor "));
        actors.next().and_then(|(pid, _)| Pid::from_raw(pid))
    };
    let config = Config::load(&place.path("run/config.toml")).map_err(|error| error.to_string())?;
    let failed = |errno| format!("cannot send a signal: {errno}");
    let actor = actors().ok_or("there is no actor")?;
    kill_process(launcher, Signal::STOP).map_err(failed)?;
    kill_process(actor, Signal::KILL).map_err(failed)?;
    until(limit(), "the actor has ended", || actors().is_none())?;
    Ok(config.run.id)
}

fn arguments_of(command: &'static str) -> Vec<&'static str> {
    match command {
        "scale" => vec!["scale", "run", "--actors", "2"],
        other => vec![other, "run"],
    }
}

/// Checks that a command got an answer or was killed, and that a `status` afterwards gets one.
fn check_answer(place: &Workplace<'_>, command: &str, followed: Followed) -> Result<Followed, String> {
    let fits = match followed.code {
        // The exit code for a run that is not running is 3.
        0 | 3 | -9 => true,
        // iceoryx2 does not always succeed at the first attempt. The launcher tries again.
        1 if command == "clean-up" => true,
        // A traced command is slow, so the run may end before it.
        1 => place.read(&format!("{command}.err")).contains("has ended meanwhile"),
        _ => false,
    };
    if !fits {
        return Err(format!("{command} ended with {}", followed.code));
    }
    match place.run("status", &["status", "run", "--json"], limit())? {
        0 | 3 => Ok(followed),
        code => Err(format!("status ended with {code} afterwards")),
    }
}

/// The environment steps that a run's command has reported.
fn steps(place: &Workplace<'_>, name: &str) -> Option<u64> {
    let printed = place.read(&format!("{name}.out"));
    let printed: serde_json::Value = serde_json::from_str(printed.lines().last()?).ok()?;
    printed["env_steps"].as_u64()
}

/// `weights_sha256` of a run's newest checkpoint.
pub(crate) fn weights(place: &Workplace<'_>, run: &str) -> Result<String, String> {
    let failed = |error: &dyn fmt::Display| format!("cannot read the checkpoint: {error}");
    let config = Config::load(&place.path(run).join("config.toml")).map_err(|error| failed(&error))?;
    let run = RunDir::open(&place.path(run)).map_err(|error| failed(&error))?;
    let loaded = Checkpoints::new(&run.checkpoints(), config.fingerprint()).load_newest();
    let loaded = loaded.map_err(|error| failed(&error))?;
    let checkpoint = loaded.ok_or_else(|| failed(&"there is no checkpoint"))?.checkpoint;
    let section = |name| checkpoint.arrays.iter().find(|(found, _)| found == name);
    let weights = registry::weight_names(&config).into_iter().filter_map(section);
    let weights: Vec<_> = weights.map(|(_, numbers)| numbers.as_slice()).collect();
    Ok(digest::sha256(&weights))
}

/// A failure, with the last lines of output and log.
pub(crate) fn explain(place: &Workplace<'_>, what: String) -> String {
    let mut text = what;
    for (name, lines) in [
        ("train.err", 4),
        ("status.err", 2),
        ("scale.err", 2),
        ("stop.err", 2),
        ("clean-up.err", 2),
        ("resume.err", 4),
        ("again.err", 4),
        ("run/shoal.log", 12),
    ] {
        let output = place.read(name);
        let output: Vec<&str> = output.lines().collect();
        for line in &output[output.len().saturating_sub(lines)..] {
            text += &format!("\n      {name}: {line}");
        }
    }
    text
}

/// Polls until `holds` returns true.
pub(crate) fn until(limit: Duration, what: &str, mut holds: impl FnMut() -> bool) -> Result<(), String> {
    let begun = Instant::now();
    while !holds() {
        if begun.elapsed() >= limit {
            return Err(format!("waited {limit:?} without success until {what}"));
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}
