//! One kill before one system call of one process, and what has to follow.

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
use crate::place::{Place, Program, Watchdog};
use crate::sweep::number;
use crate::tracer::{Followed, Target, follow};

/// A run takes less than a second; after so long it hangs.
fn limit() -> Duration {
    Duration::from_secs(number("SHOAL_CRASH_SECONDS").unwrap_or(60))
}

/// So long the roles of a launcher that was killed may take to end.
const ENDING: Duration = Duration::from_secs(30);

/// Steps of a run in which a role is killed, and of one that is asked something.
const STEPS: u64 = 1500;
const STEPS_WHILE_ASKED: u64 = 20_000;

/// The run's size: what is learned does not matter, only that it is learned to the end.
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

/// Who is killed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Victim {
    Role(&'static str, u32),
    /// An environment server that is a program of Gymnasium's.
    Python(u32),
    Launcher,
    /// A command that is given while the run goes on.
    Asker(&'static str),
    /// The process that cleans up in shared memory after a killed actor. It is started here while the launcher is stopped,
    /// which does it again then.
    CleanUp,
}

/// The environment server of the evaluator comes after those of all actors that there may be.
const EVALUATION: u32 = 4;

impl Victim {
    pub(crate) const ALL: [Self; 12] = [
        Self::Role("learner", 0),
        Self::Role("actor", 0),
        Self::Role("env-server", 0),
        Self::Role("evaluator", 0),
        Self::Role("env-server", EVALUATION),
        Self::Launcher,
        Self::Asker("status"),
        Self::Asker("scale"),
        Self::Asker("stop"),
        Self::CleanUp,
        Self::Python(0),
        Self::Python(EVALUATION),
    ];

    /// Which calls are tried where none are named. Python opens hundreds of files of its own before it serves anything.
    pub(crate) fn calls(self) -> impl Iterator<Item = Call> {
        let all = Call::ALL.into_iter();
        all.filter(move |call| !matches!((self, call), (Self::Python(_), Call::Open)))
    }

    fn target(self) -> Target {
        match self {
            Self::Role(name, index) => Target::Role(name, index),
            Self::Python(index) => Target::Program(index),
            Self::Launcher | Self::Asker(_) | Self::CleanUp => Target::Command,
        }
    }

    /// What is trained.
    fn environment(self) -> &'static str {
        match self {
            Self::Python(_) => "gym:Pendulum-v1",
            _ => "pendulum",
        }
    }

    fn steps(self) -> u64 {
        match self {
            Self::Asker(_) | Self::CleanUp => STEPS_WHILE_ASKED,
            _ => STEPS,
        }
    }

    /// Whether a lockstep run ends with the same bits though this one was killed.
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
            Self::Asker(command) => write!(f, "{command}"),
            Self::CleanUp => write!(f, "clean-up"),
        }
    }
}

/// A victim, and the run in which it is killed.
#[derive(Clone, Copy)]
pub(crate) struct Scene<'a> {
    pub(crate) program: &'a Program,
    pub(crate) victim: Victim,
    pub(crate) mode: Mode,
}

/// What came of a kill.
pub(crate) enum Verdict {
    /// The victim never made that call.
    NotReached,
    Survived,
    /// What went wrong.
    Failed(String),
}

/// A run that nobody is killed in.
pub(crate) struct Calm {
    /// How many calls of each kind the victim begins.
    pub(crate) counts: std::collections::BTreeMap<Call, u32>,
    weights: String,
}

impl Scene<'_> {
    /// Runs it without a kill; the second `Err` is that the machine allows no tracing.
    pub(crate) fn calm(&self) -> nix::Result<Result<Calm, String>> {
        let place = Place::new(self.program);
        let traced = self.traced(&place, None);
        let explained = |what| explain(&place, what);
        Ok(match traced? {
            Err(what) => Err(explained(what)),
            Ok(followed) => self
                .all_is_well(&place, &followed, None)
                .map_err(explained)
                .and_then(|()| {
                    Ok(Calm {
                        counts: followed.counts,
                        weights: weights(&place, "run").map_err(explained)?,
                    })
                }),
        })
    }

    /// Kills the victim before the call.
    pub(crate) fn kill_before(&self, call: Call, number: u32, calm: &Calm) -> Verdict {
        let place = Place::new(self.program);
        let followed = match self.traced(&place, Some((call, number))) {
            Ok(Ok(followed)) => followed,
            Ok(Err(what)) => return Verdict::Failed(explain(&place, what)),
            Err(errno) => return Verdict::Failed(format!("cannot be traced: {errno}")),
        };
        match self.all_is_well(&place, &followed, Some(calm)) {
            Err(what) => Verdict::Failed(explain(&place, format!("({}) {what}", about(&followed)))),
            Ok(()) if followed.hit.is_none() => Verdict::NotReached,
            Ok(()) => Verdict::Survived,
        }
    }

    /// The run's first command to its end, and the victim's too where that is another one.
    fn traced(&self, place: &Place<'_>, aim: Option<(Call, u32)>) -> nix::Result<Result<Followed, String>> {
        let train = self.train("run");
        let train: Vec<&str> = train.iter().map(String::as_str).collect();
        let traced = |name: &str, arguments: &[&str]| {
            std::thread::scope(|scope| {
                let watchdog = Watchdog::new(scope, place, limit());
                let settle = |command: &mut Command| place.settle(command, name);
                let followed = follow(&place.words(arguments), settle, self.victim.target(), aim);
                let found = watchdog.found();
                followed.map(|followed| match found {
                    None => Ok(followed),
                    Some(found) => Err(format!("({}) {name} {found}", about(&followed))),
                })
            })
        };
        let command = match self.victim {
            Victim::Asker(command) => command,
            Victim::CleanUp => "clean-up",
            _ => return traced("train", &train),
        };
        let mut run = place.start("train", &train);
        let launcher = Pid::from_child(&run);
        let asked = || {
            if let Err(what) = until(limit(), "every role is ready", || {
                place.read("run/shoal.log").contains("every role is ready")
            }) {
                return Ok(Err(what));
            }
            let followed = if self.victim == Victim::CleanUp {
                let id = match after_an_actor(place, launcher) {
                    Ok(id) => id,
                    Err(what) => return Ok(Err(what)),
                };
                let followed = traced(command, &[command, &id]);
                let _ = kill_process(launcher, Signal::CONT);
                followed
            } else {
                traced(command, &asked(command))
            };
            followed.map(|followed| followed.and_then(|followed| answered(place, command, followed)))
        };
        match asked() {
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

    /// What has to hold once the traced run has ended.
    fn all_is_well(&self, place: &Place<'_>, followed: &Followed, calm: Option<&Calm>) -> Result<(), String> {
        let mut run = "run";
        if self.victim == Victim::Launcher && followed.hit.is_some() {
            run = self.go_on_without_launcher(place)?;
        } else if followed.code != 0 {
            return Err(format!("the run ended with {}", followed.code));
        }
        if self.victim == Victim::Asker("stop") && steps(place, "train") < Some(self.victim.steps()) {
            match place.run("resume", &["resume", "run", "--quiet", "--json"], limit())? {
                0 => {}
                code => return Err(format!("resumed, the run ended with {code}")),
            }
        }
        place.is_left_within(Duration::from_secs(5))?;
        for run in ["run", run] {
            let traces = place.traces(run);
            if !traces.is_empty() {
                return Err(format!(
                    "{} files are left: {:?}",
                    traces.len(),
                    &traces[..traces.len().min(3)]
                ));
            }
        }
        if let Some(calm) = calm.filter(|_| self.mode == Mode::Lockstep && self.victim.keeps_bits())
            && weights(place, run)? != calm.weights
        {
            return Err("the run ended with other bits".into());
        }
        Ok(())
    }

    /// The launcher was killed: its roles end, and the run can go on, or another can begin. In which directory.
    fn go_on_without_launcher(&self, place: &Place<'_>) -> Result<&'static str, String> {
        place.is_left_within(ENDING)?;
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
            // It had done everything, and what it left goes with the next start.
            1 if place.read("resume.err").contains("steps already") => another().map(|_| "run"),
            code => Err(format!("resumed, the run ended with {code}")),
        }
    }
}

/// What the call was about before which the victim was killed.
fn about(followed: &Followed) -> &str {
    followed.hit.as_deref().unwrap_or("nobody was killed")
}

/// Stops the launcher and kills the actor, so that there is something to clean up; the run's name in shared memory.
fn after_an_actor(place: &Place<'_>, launcher: Pid) -> Result<String, String> {
    let actors = || {
        let processes = place.processes().into_iter();
        let mut actors = processes.filter(|(_, words)| words.starts_with("shoal actor "));
        actors.next().and_then(|(pid, _)| Pid::from_raw(pid))
    };
    let config = Config::load(&place.path("run/config.toml")).map_err(|error| error.to_string())?;
    let failed = |errno| format!("no signal can be sent: {errno}");
    let actor = actors().ok_or("there is no actor")?;
    kill_process(launcher, Signal::STOP).map_err(failed)?;
    kill_process(actor, Signal::KILL).map_err(failed)?;
    until(limit(), "the actor is dead", || actors().is_none())?;
    Ok(config.run.id)
}

fn asked(command: &'static str) -> Vec<&'static str> {
    match command {
        "scale" => vec!["scale", "run", "--actors", "2"],
        other => vec![other, "run"],
    }
}

/// A command was answered, or killed, and the next one is answered.
fn answered(place: &Place<'_>, command: &str, followed: Followed) -> Result<Followed, String> {
    let fits = match followed.code {
        // What runs no more is 3.
        0 | 3 | -9 => true,
        // iceoryx2 cannot always clean up after somebody at once. The launcher has it tried again, and the run must go on.
        1 if command == "clean-up" => true,
        // A traced command is slow.
        1 => place.read(&format!("{command}.err")).contains("has ended meanwhile"),
        _ => false,
    };
    if !fits {
        return Err(format!("{command} ended with {}", followed.code));
    }
    match place.run("status", &["status", "run", "--json"], limit())? {
        0 | 3 => Ok(followed),
        code => Err(format!("afterwards status ended with {code}")),
    }
}

/// How many steps a run's command says it has taken.
fn steps(place: &Place<'_>, name: &str) -> Option<u64> {
    let printed = place.read(&format!("{name}.out"));
    let printed: serde_json::Value = serde_json::from_str(printed.lines().last()?).ok()?;
    printed["env_steps"].as_u64()
}

/// `weights_sha256` of what a run has saved last.
pub(crate) fn weights(place: &Place<'_>, run: &str) -> Result<String, String> {
    let failed = |error: &dyn fmt::Display| format!("what was learned cannot be read: {error}");
    let config = Config::load(&place.path(run).join("config.toml")).map_err(|error| failed(&error))?;
    let run = RunDir::open(&place.path(run)).map_err(|error| failed(&error))?;
    let loaded = Checkpoints::new(&run.checkpoints(), config.fingerprint()).load_newest();
    let loaded = loaded.map_err(|error| failed(&error))?;
    let checkpoint = loaded.ok_or_else(|| failed(&"there is no checkpoint"))?.checkpoint;
    let section = |name| checkpoint.sections.iter().find(|(found, _)| found == name);
    let weights = registry::weights(&config.algorithm).iter().filter_map(section);
    let weights: Vec<_> = weights.map(|(_, numbers)| numbers.as_slice()).collect();
    Ok(digest::sha256(&weights))
}

/// What went wrong, and what was said last.
pub(crate) fn explain(place: &Place<'_>, what: String) -> String {
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
        let said = place.read(name);
        let said: Vec<&str> = said.lines().collect();
        for line in &said[said.len().saturating_sub(lines)..] {
            text += &format!("\n      {name}: {line}");
        }
    }
    text
}

/// Waits until something holds.
pub(crate) fn until(limit: Duration, what: &str, mut holds: impl FnMut() -> bool) -> Result<(), String> {
    let begun = Instant::now();
    while !holds() {
        if begun.elapsed() >= limit {
            return Err(format!("waited {limit:?} in vain until {what}"));
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}
