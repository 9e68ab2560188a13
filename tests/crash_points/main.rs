//! Any process may be killed at any instruction, and the others go on. What a process says to others it says in system
//! calls, so each of these tests kills one process just before a certain call, of libc's or the program's own, and looks at
//! what becomes of the run. Others kill faster than a process can begin its work.
//!
//! The tests of every day try a selection; the others are asked for, and say what came of each kind of kill:
//!
//! ```text
//! cargo test --release --test crash_points -- --ignored --nocapture every_crash_point
//! cargo test --release --test crash_points -- --ignored --nocapture hostile
//! cargo test --release --test crash_points -- --ignored --nocapture a_million_steps
//! ```
//!
//! `SHOAL_CRASH_JOBS` says how many runs are under way at a time (2). `SHOAL_CRASH_ROLES` (`learner-0,launcher,status`),
//! `SHOAL_CRASH_CALLS` (`ftruncate,fchmod`), `SHOAL_CRASH_MODES` (`free,lockstep`), `SHOAL_CRASH_USERS` (`own,nobody`) and
//! `SHOAL_CRASH_UPTO` (200) restrict the first; `SHOAL_CRASH_SECONDS` (60) says after how long a run hangs;
//! `SHOAL_CRASH_BURSTS` (10) and `SHOAL_CRASH_SEED` (1) belong to the second, `SHOAL_CRASH_STEPS` to the third.
//!
//! With `SHOAL_CRASH_JOBS=1` no run has a neighbour, and each failure is its own.
//!
//! Processes are traced (`ptrace`); where the machine does not allow it, these tests are ignored.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]
#![allow(
    clippy::print_stderr,
    reason = "a test says what came of its kills, and a long one how it gets on"
)]

mod calls;
mod place;
mod schedules;
#[path = "../support/suite.rs"]
mod suite;
mod sweep;
mod tracer;
mod trial;

use std::process::{Command, ExitCode};
use std::time::Duration;

use calls::Call;
use place::User;
use schedules::Schedule;
use suite::{Need, PYTHON, ROOT, test};
use sweep::{Sweep, Table, in_parallel, list, number};
use tracer::{Target, follow};
use trial::{Mode, Victim};

/// The right to trace one's children.
static TRACING: Need = Need::new("this machine allows no tracing", tracer::is_allowed, None);

fn main() -> ExitCode {
    suite::run(vec![
        test!(who_is_killed_before_a_call_has_not_made_it, TRACING),
        test!(
            a_role_killed_before_a_call_of_its_start_is_replaced_and_the_run_ends_as_it_was_to,
            TRACING
        ),
        test!(an_evaluator_killed_before_a_call_of_its_start_is_replaced, TRACING),
        test!(in_lockstep_the_run_ends_with_the_same_bits_too, TRACING),
        test!(
            when_the_launcher_is_killed_before_a_call_its_roles_end_and_the_run_goes_on_when_it_is_resumed,
            TRACING
        ),
        test!(
            a_command_killed_before_a_call_does_not_disturb_the_run_that_it_asks,
            TRACING
        ),
        test!(a_clean_up_that_is_killed_before_a_call_is_done_again, TRACING),
        test!(a_python_server_killed_before_a_call_is_replaced, TRACING, PYTHON),
        test!(an_ordinary_users_run_goes_on_where_roots_does, TRACING, ROOT),
        // Hours: kills before every call.
        test!(every_crash_point, TRACING).with_ignored_flag(true),
        test!(who_is_killed_faster_than_it_can_begin_is_at_work_again_soon_after),
        // Ten minutes and more: hostile schedules of kills.
        test!(hostile_schedules_of_kills_never_stop_a_run).with_ignored_flag(true),
        // Up to an hour each: a kill every 100 ms, all the way.
        test!(a_million_steps_are_taken_under_a_kill_every_tenth_of_a_second).with_ignored_flag(true),
    ])
}

/// A selection for one run gives up after so many failures: each may take a minute.
const FEW: usize = 3;

/// Calls between which a file is there and not yet what it is to be.
const DANGEROUS: [Call; 3] = [Call::Create, Call::Ftruncate, Call::Fchmod];

/// Before how many calls of a kind somebody is killed.
#[derive(Clone, Copy)]
struct Choice {
    /// The first ones of a dangerous kind.
    first: u32,
    /// More of a dangerous kind, spread over all there are.
    dangerous: u32,
    /// Of every other kind, spread likewise.
    others: u32,
}

impl Choice {
    fn numbers(self, call: Call, count: u32) -> Vec<u32> {
        let (first, spread) = if DANGEROUS.contains(&call) {
            (self.first.min(count), self.dangerous)
        } else {
            (0, self.others)
        };
        let spread = spread.min(count);
        let mut numbers: Vec<u32> = (1..=first).collect();
        numbers.extend((0..spread).map(|i| 1 + (2 * i + 1) * count / (2 * spread)));
        numbers.retain(|number| *number <= count);
        numbers.sort_unstable();
        numbers.dedup();
        numbers
    }
}

/// Kills before a selection of calls.
fn some(user: User, modes: &[Mode], victims: &[Victim], [first, dangerous, others]: [u32; 3]) {
    let choice = Choice {
        first,
        dangerous,
        others,
    };
    let table = Sweep {
        user,
        modes,
        victims: victims.to_vec(),
        points: &|_, call, count| choice.numbers(call, count),
        patience: FEW,
    }
    .run();
    eprint!("{}", table.text());
    table.evaluate();
}

const EVALUATOR: Victim = Victim::Role("evaluator", 0);

/// Everybody else who belongs to a run.
const ROLES: [Victim; 4] = [
    Victim::Role("learner", 0),
    Victim::Role("actor", 0),
    Victim::Role("env-server", 0),
    Victim::Role("env-server", 4),
];

fn who_is_killed_before_a_call_has_not_made_it() {
    let directory = tempfile::tempdir().unwrap();
    let words = ["sh", "-c", ": > first; : > second; : > third"].map(String::from);
    let made = |number| {
        let settle = |command: &mut Command| {
            command.current_dir(directory.path());
        };
        let followed = follow(&words, settle, Target::Command, Some((Call::Create, number)));
        let mut names: Vec<_> = std::fs::read_dir(directory.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort_unstable();
        (followed, names)
    };
    let (followed, names) = made(2);
    let followed = followed.unwrap();
    assert_eq!((followed.code, followed.hit.as_deref()), (-9, Some("second")));
    assert_eq!(followed.counts[&Call::Create], 2);
    assert_eq!(names, ["first"]);
    let (followed, names) = made(4);
    let followed = followed.unwrap();
    assert_eq!((followed.code, followed.hit), (0, None));
    assert_eq!(names, ["first", "second", "third"]);
}

fn a_role_killed_before_a_call_of_its_start_is_replaced_and_the_run_ends_as_it_was_to() {
    some(User::Own, &[Mode::Free], &ROLES, [2, 3, 1]);
}

fn an_evaluator_killed_before_a_call_of_its_start_is_replaced() {
    // A free run may wait some seconds for its last evaluation.
    some(User::Own, &[Mode::Free], &[EVALUATOR], [1, 1, 0]);
}

fn in_lockstep_the_run_ends_with_the_same_bits_too() {
    let everybody = [&ROLES[..], &[EVALUATOR]].concat();
    some(User::Own, &[Mode::Lockstep], &everybody, [1, 1, 1]);
}

fn when_the_launcher_is_killed_before_a_call_its_roles_end_and_the_run_goes_on_when_it_is_resumed() {
    some(User::Own, &Mode::BOTH, &[Victim::Launcher], [1, 1, 1]);
}

fn a_command_killed_before_a_call_does_not_disturb_the_run_that_it_asks() {
    let askers = ["status", "scale", "stop"].map(Victim::Asker);
    some(User::Own, &[Mode::Free], &askers, [1, 1, 0]);
}

fn a_clean_up_that_is_killed_before_a_call_is_done_again() {
    some(User::Own, &Mode::BOTH, &[Victim::CleanUp], [1, 2, 1]);
}

fn a_python_server_killed_before_a_call_is_replaced() {
    some(User::Own, &[Mode::Free], &[Victim::Python(0)], [1, 1, 1]);
}

fn an_ordinary_users_run_goes_on_where_roots_does() {
    some(User::Nobody, &[Mode::Free], &ROLES, [1, 2, 0]);
}

fn every_crash_point() {
    let upto: u32 = number("SHOAL_CRASH_UPTO").unwrap_or(200);
    let chosen = |variable: &str, name: &str| list(variable).is_none_or(|names| names.iter().any(|it| it == name));
    let named = list("SHOAL_CRASH_CALLS");
    let mut victims: Vec<_> = Victim::ALL.into();
    victims.retain(|victim| chosen("SHOAL_CRASH_ROLES", &victim.to_string()));
    assert!(!victims.is_empty(), "SHOAL_CRASH_ROLES names nobody");
    let has_python = victims.iter().any(|victim| matches!(victim, Victim::Python(_)));
    if let Some(missing) = PYTHON.missing().filter(|_| has_python) {
        eprintln!("left out: {missing}");
        victims.retain(|victim| !matches!(victim, Victim::Python(_)));
    }
    let mut modes: Vec<_> = Mode::BOTH.into();
    modes.retain(|mode| chosen("SHOAL_CRASH_MODES", mode.name()));
    // What is created is opened.
    let is_meant = |call: Call| match &named {
        None => call != Call::Create,
        Some(names) => names.iter().any(|name| name == call.name()),
    };
    let mut table = Table::default();
    for (user, name) in [(User::Own, "own"), (User::Nobody, "nobody")] {
        if !chosen("SHOAL_CRASH_USERS", name) {
            continue;
        }
        if let Some(missing) = ROOT.missing().filter(|_| user == User::Nobody) {
            eprintln!("left out: {missing}");
            continue;
        }
        let sweep = Sweep {
            user,
            modes: &modes,
            victims: victims.clone(),
            points: &|victim, call, count| match victim {
                // Python opens too many files of its own; those it makes are looked at.
                Victim::Python(_) if named.is_none() && call == Call::Create => (1..=count.min(upto)).collect(),
                _ if is_meant(call) => (1..=count.min(upto)).collect(),
                _ => Vec::new(),
            },
            patience: usize::MAX,
        };
        table.join(sweep.run());
    }
    eprint!("{}", table.text());
    table.evaluate();
}

/// Which roles are killed.
const SETS: [&[&str]; 5] = [
    &["env-server"],
    &["env-server", "actor"],
    &["learner"],
    &["evaluator"],
    &[],
];

fn schedules(sets: &[&'static [&'static str]], actors: &[u32], bursts: u32, seed: u64) {
    let mut all = Vec::new();
    for roles in sets {
        for mode in Mode::BOTH {
            all.extend(actors.iter().map(|actors| Schedule {
                roles,
                mode,
                actors: *actors,
                seed,
            }));
        }
    }
    let results = in_parallel(all, |schedule| (schedule, schedule.bursts(bursts)));
    let mut failures = Vec::new();
    for (schedule, result) in results {
        match result {
            Ok(kills) => eprintln!("{schedule}: {kills} kills, always went on"),
            Err(what) => failures.push(what),
        }
    }
    assert!(
        failures.is_empty(),
        "{} schedules:\n{}",
        failures.len(),
        failures.join("\n\n")
    );
}

fn who_is_killed_faster_than_it_can_begin_is_at_work_again_soon_after() {
    schedules(&[&["env-server"], &[]], &[1], 3, 1);
}

fn hostile_schedules_of_kills_never_stop_a_run() {
    let bursts = number("SHOAL_CRASH_BURSTS").unwrap_or(10);
    schedules(&SETS, &[1, 2], bursts, number("SHOAL_CRASH_SEED").unwrap_or(1));
}

fn a_million_steps_are_taken_under_a_kill_every_tenth_of_a_second() {
    let steps = number("SHOAL_CRASH_STEPS").unwrap_or(1_000_000);
    let limit = Duration::from_secs(3600);
    let often = Some(Duration::from_millis(100));
    let of = |mode| Schedule {
        roles: &[],
        mode,
        actors: 1,
        seed: number("SHOAL_CRASH_SEED").unwrap_or(1),
    };
    let all = vec![(Mode::Free, often), (Mode::Lockstep, often), (Mode::Lockstep, None)];
    let results = in_parallel(all, |(mode, every)| (mode, of(mode).to_the_end(steps, every, limit)));
    let mut weights = Vec::new();
    for (mode, result) in results {
        let (kills, wall, digest) = result.unwrap_or_else(|what| panic!("{what}"));
        eprintln!("{}: {steps} steps under {kills} kills in {wall:.0?}", mode.name());
        weights.extend((mode == Mode::Lockstep).then_some(digest));
    }
    assert_eq!(weights[0], weights[1], "the same bits as without kills");
}
