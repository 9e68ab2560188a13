//! Kills that come faster than a process can begin its work, and what has to follow.

use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use shoal_common::commit::CommitReader;
use shoal_common::stream::Stream;

use crate::place::{Place, Program, User, kill};
use crate::sweep::Permit;
use crate::trial::{Mode, SMALL, explain, until, weights};

/// The roles that a schedule kills, and the run it does that in.
#[derive(Clone, Copy)]
pub(crate) struct Schedule {
    /// None of them: every role.
    pub(crate) roles: &'static [&'static str],
    pub(crate) mode: Mode,
    pub(crate) actors: u32,
    pub(crate) seed: u64,
}

/// From one kill to the next, in milliseconds.
const PAUSES: std::ops::Range<u64> = 30..200;

/// How long it is killed, before it is left alone.
const BURST: Duration = Duration::from_secs(3);

/// Within so long after a burst new steps are in the replay.
const RECOVERY: Duration = Duration::from_secs(15);

/// A run may take so long to begin, and to end.
const PATIENCE: Duration = Duration::from_secs(60);

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
    /// Kills in so many bursts; how many kills that were.
    pub(crate) fn bursts(&self, bursts: u32) -> Result<u32, String> {
        let _permit = Permit::take();
        let program = Program::of(User::Own);
        let place = Place::new(&program);
        let mut kills = 0;
        let done = self.bursts_in(&place, bursts, &mut kills);
        done.map_err(|what| explain(&place, format!("{self}: after {kills} kills {what}")))?;
        Ok(kills)
    }

    fn bursts_in(&self, place: &Place<'_>, bursts: u32, kills: &mut u32) -> Result<(), String> {
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
        until(PATIENCE, "steps are made", || rows(place) > 0 || ended().is_some())?;
        let mut rng = Stream::seed_from_u64(self.seed);
        for _ in 0..bursts {
            let begun = Instant::now();
            while begun.elapsed() < BURST {
                // The pauses are the schedule.
                std::thread::sleep(Duration::from_millis(rng.random_range(PAUSES)));
                *kills += u32::from(self.kill_one(place, &mut rng));
            }
            let before = rows(place);
            until(RECOVERY, "new steps are made", || {
                rows(place) > before || ended().is_some()
            })?;
            if let Some(how) = ended() {
                return Err(how);
            }
        }
        match place.run("stop", &["stop", "run"], PATIENCE)? {
            0 => {}
            code => return Err(format!("stop ended with {code}")),
        }
        match place.wait(launcher, "train", PATIENCE)? {
            0 => is_tidy(place),
            code => Err(format!("the run ended with {code}")),
        }
    }

    /// A run of so many steps to its end, with a kill every so often; how many, how long it took, and the weights.
    pub(crate) fn to_the_end(
        self,
        steps: u64,
        every: Option<Duration>,
        limit: Duration,
    ) -> Result<(u32, Duration, String), String> {
        let _permit = Permit::take();
        let program = Program::of(User::Own);
        let place = Place::new(&program);
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
                // The pauses are the schedule.
                std::thread::sleep(every);
                kills += u32::from(self.kill_one(&place, &mut rng));
            }
            let taken = |place| format!("with {} of {steps} steps taken", rows(place));
            let code = place.wait(launcher, "train", limit.saturating_sub(begun.elapsed()));
            match code.map_err(|what| format!("{what}, {}", taken(&place)))? {
                0 => is_tidy(&place)?,
                code => return Err(format!("the run ended with {code}, {}", taken(&place))),
            }
            weights(&place, "run")
        };
        match done() {
            Ok(weights) => Ok((kills, begun.elapsed(), weights)),
            Err(what) => Err(explain(&place, format!("{self}: after {kills} kills {what}"))),
        }
    }

    fn start(&self, place: &Place<'_>, steps: u64, settings: &[&str]) -> std::process::Child {
        let (seed, actors, steps) = (self.seed.to_string(), self.actors.to_string(), steps.to_string());
        let plain = [
            "train", "pendulum", "--run", "run", "--quiet", "--json", "--seed", &seed,
        ];
        let size = ["--actors", &actors, "--steps", &steps];
        let mut words = [&plain[..], &size, &SMALL].concat();
        words.extend(settings.iter().flat_map(|setting| ["--set", setting]));
        words.extend((self.mode == Mode::Lockstep).then_some("--lockstep"));
        place.start("train", &words)
    }

    /// Kills one process of the roles; whether there was one.
    fn kill_one(&self, place: &Place<'_>, rng: &mut Stream) -> bool {
        let is_meant = |words: &String| {
            let role = words.split(' ').nth(1).unwrap_or_default();
            ["learner", "actor", "env-server", "evaluator"].contains(&role)
                && (self.roles.is_empty() || self.roles.contains(&role))
        };
        let mut there = place.processes();
        there.retain(|(_, words)| is_meant(words));
        there.sort_unstable();
        !there.is_empty() && kill(there[rng.random_range(0..there.len())].0)
    }
}

/// Rows in the replay of the place's run.
fn rows(place: &Place<'_>) -> u64 {
    CommitReader::open(&place.path("run/replay.bin")).map_or(0, |commits| commits.rows())
}

/// Nothing of the run is left.
fn is_tidy(place: &Place<'_>) -> Result<(), String> {
    place.is_left_within(Duration::from_secs(5))?;
    match place.traces("run") {
        traces if traces.is_empty() => Ok(()),
        traces => Err(format!("{} files are left: {traces:?}", traces.len())),
    }
}
