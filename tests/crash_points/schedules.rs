//! Kills in quick succession, faster than a process can start, and the recovery that must follow.

use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use shoal_common::commit::CommitReader;
use shoal_common::stream::Stream;

use crate::sweep::Permit;
use crate::trial::{Mode, SMALL, explain, until, weights};
use crate::workplace::{Program, User, Workplace, kill};

/// The roles to kill, and the run in which they are killed.
#[derive(Clone, Copy)]
pub(crate) struct Schedule {
    /// Empty for every role.
    pub(crate) roles: &'static [&'static str],
    pub(crate) mode: Mode,
    pub(crate) actors: u32,
    pub(crate) seed: u64,
}

/// Pauses between kills, in milliseconds.
const PAUSES: std::ops::Range<u64> = 30..200;

/// Length of a burst of kills.
const BURST: Duration = Duration::from_secs(3);

/// Longest wait for new steps in the replay after a burst.
const RECOVERY_TIMEOUT: Duration = Duration::from_secs(15);

/// Longest wait for the start and for the end of a run.
const TIMEOUT: Duration = Duration::from_secs(60);

impl std::fmt::Display for Schedule {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            roles, mode, actors, ..
        } = self;
        let roles = if roles.is_empty() {
            "all".into()
        } else {
            roles.join("+")
        };
        write!(f, "{roles}, {}, actors: {actors}", mode.name())
    }
}

impl Schedule {
    /// Runs with `bursts` bursts of kills and checks the recovery after each. Returns the number of kills.
    pub(crate) fn bursts(&self, bursts: u32) -> Result<u32, String> {
        let _permit = Permit::take();
        let program = Program::of(User::Own);
        let place = Workplace::new(&program);
        let mut kills = 0;
        let done = self.bursts_in(&place, bursts, &mut kills);
        done.map_err(|what| explain(&place, format!("{self}: after {kills} kills {what}")))?;
        Ok(kills)
    }

    fn bursts_in(&self, place: &Workplace<'_>, bursts: u32, kills: &mut u32) -> Result<(), String> {
        let mut launcher = self.start(
            place,
            100_000_000,
            &["evaluation.every=3000", "checkpoint.every_updates=500"],
        );
        let mut ended = || {
            launcher
                .try_wait()
                .unwrap()
                .map(|status| format!("the launcher ended: {status}"))
        };
        until(TIMEOUT, "steps are committed", || rows(place) > 0 || ended().is_some())?;
        let mut rng = Stream::seed_from_u64(self.seed);
        for _ in 0..bursts {
            let begun = Instant::now();
            while begun.elapsed() < BURST {
                std::thread::sleep(Duration::from_millis(rng.random_range(PAUSES)));
                *kills += u32::from(self.kill_one(place, &mut rng));
            }
            let before = rows(place);
            until(RECOVERY_TIMEOUT, "new steps are committed", || {
                rows(place) > before || ended().is_some()
            })?;
            if let Some(how) = ended() {
                return Err(how);
            }
        }
        match place.run("stop", &["stop", "run"], TIMEOUT)? {
            0 => {}
            code => return Err(format!("stop ended with {code}")),
        }
        match place.wait(launcher, "train", TIMEOUT)? {
            0 => check_leftovers(place),
            code => Err(format!("the run ended with {code}")),
        }
    }

    /// A run of `steps` environment steps to its end, with a kill after every interval `every`. Returns the number of
    /// kills, the duration and the hash of the weights.
    pub(crate) fn to_the_end(
        self,
        steps: u64,
        every: Option<Duration>,
        limit: Duration,
    ) -> Result<(u32, Duration, String), String> {
        let _permit = Permit::take();
        let program = Program::of(User::Own);
        let place = Workplace::new(&program);
        let mut kills = 0;
        let begun = Instant::now();
        let mut done = || {
            let settings = [
                "evaluation.every=20000",
                "checkpoint.every_updates=1000",
                "checkpoint.every_seconds=0.2",
            ];
            let mut launcher = self.start(&place, steps, &settings);
            let mut rng = Stream::seed_from_u64(self.seed);
            while let Some(every) = every
                && begun.elapsed() < limit
                && launcher.try_wait().unwrap().is_none()
            {
                std::thread::sleep(every);
                kills += u32::from(self.kill_one(&place, &mut rng));
            }
            let taken = |place| format!("with {} of {steps} steps taken", rows(place));
            let code = place.wait(launcher, "train", limit.saturating_sub(begun.elapsed()));
            match code.map_err(|what| format!("{what}, {}", taken(&place)))? {
                0 => check_leftovers(&place)?,
                code => return Err(format!("the run ended with {code}, {}", taken(&place))),
            }
            weights(&place, "run")
        };
        match done() {
            Ok(weights) => Ok((kills, begun.elapsed(), weights)),
            Err(what) => Err(explain(&place, format!("{self}: after {kills} kills {what}"))),
        }
    }

    fn start(&self, place: &Workplace<'_>, steps: u64, settings: &[&str]) -> std::process::Child {
        let (seed, actors, steps) = (self.seed.to_string(), self.actors.to_string(), steps.to_string());
        let plain = [
            "train", "pendulum", "--run", "run", "--quiet", "--json", "--seed", &seed,
        ];
        let size = ["--actors", &actors, "--steps", &steps];
        let mut words = [&plain[..], &size, &SMALL].concat();
        words.extend(settings.iter().flat_map(|prepare| ["--set", prepare]));
        words.extend((self.mode == Mode::Lockstep).then_some("--lockstep"));
        place.start("train", &words)
    }

    /// Kills a random process of the roles. Returns whether there was one.
    fn kill_one(&self, place: &Workplace<'_>, rng: &mut Stream) -> bool {
        let is_selected = |words: &String| {
            let role = words.split(' ').nth(1).unwrap_or_default();
            ["learner", "actor", "env-server", "evaluator"].contains(&role)
                && (self.roles.is_empty() || self.roles.contains(&role))
        };
        let mut processes = place.processes();
        processes.retain(|(_, words)| is_selected(words));
        processes.sort_unstable();
        !processes.is_empty() && kill(processes[rng.random_range(0..processes.len())].0)
    }
}

/// Committed rows of the run.
fn rows(place: &Workplace<'_>) -> u64 {
    CommitReader::open(&place.path("run/replay.bin")).map_or(0, |commits| commits.rows())
}

/// Checks that no process and no file of the run is left.
fn check_leftovers(place: &Workplace<'_>) -> Result<(), String> {
    place.wait_until_empty(Duration::from_secs(5))?;
    match place.leftovers("run") {
        leftovers if leftovers.is_empty() => Ok(()),
        leftovers => Err(format!("{} files are left: {leftovers:?}", leftovers.len())),
    }
}
