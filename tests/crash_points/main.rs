//! Any process may be killed at any instruction, and the others continue. Other processes see most effects of a process
//! through its system calls, so these tests kill a process just before a chosen system call and check the run. Further
//! tests kill processes faster than they can start.
//!
//! The ordinary tests try a selection of calls. The ignored tests try more, and print the results of each kind of kill:
//!
//! ```text
//! cargo test --release --test crash_points -- --ignored --nocapture every_crash_point
//! cargo test --release --test crash_points -- --ignored --nocapture hostile
//! cargo test --release --test crash_points -- --ignored --nocapture a_million_steps
//! ```
//!
//! | variable | default or example | meaning |
//! | --- | --- | --- |
//! | `SHOAL_CRASH_JOBS` | 2 | runs at the same time; with 1, runs cannot disturb each other |
//! | `SHOAL_CRASH_SECONDS` | 60 | a run that takes longer hangs |
//! | `SHOAL_CRASH_ROLES` | `learner-0,launcher,status` | `every_crash_point`: processes to kill |
//! | `SHOAL_CRASH_CALLS` | `ftruncate,fchmod` | `every_crash_point`: system calls |
//! | `SHOAL_CRASH_MODES` | `free,lockstep` | `every_crash_point`: modes |
//! | `SHOAL_CRASH_USERS` | `own,nobody` | `every_crash_point`: users |
//! | `SHOAL_CRASH_UPTO` | 200 | `every_crash_point`: calls of each kind |
//! | `SHOAL_CRASH_BURSTS` | 10 | `hostile`: bursts of kills |
//! | `SHOAL_CRASH_SEED` | 1 | `hostile` and `a_million_steps`: random seed |
//! | `SHOAL_CRASH_STEPS` | 1000000 | `a_million_steps`: environment steps |
//!
//! The tests trace processes (`ptrace`) and are ignored on a machine that does not allow it.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]
#![allow(
    clippy::print_stderr,
    reason = "tests print the results of their kills, and long tests their progress"
)]

mod calls;
mod schedules;
#[path = "../support/suite.rs"]
mod suite;
mod sweep;
mod tracer;
mod trial;
mod workplace;

use std::process::{Command, ExitCode};
use std::time::Duration;

use calls::Call;
use schedules::Schedule;
use suite::{Need, PYTHON, ROOT, test};
use sweep::{Sweep, Table, in_parallel, list, number};
use tracer::{Target, follow};
use trial::{Mode, Victim};
use workplace::User;

/// Permission to trace child processes.
static TRACING: Need = Need::new("this machine does not allow tracing", tracer::is_allowed, None);

fn main() -> ExitCode {
    suite::run(vec![
        test!(a_process_killed_before_a_call_has_not_made_it, TRACING),
        test!(a_role_killed_before_a_call_is_replaced_and_the_run_completes, TRACING),
        test!(an_evaluator_killed_before_a_call_is_replaced, TRACING),
        test!(a_lockstep_run_with_a_kill_ends_with_the_same_bits, TRACING),
        test!(
            after_a_kill_of_the_launcher_its_roles_end_and_the_run_can_be_resumed,
            TRACING
        ),
        test!(a_command_killed_before_a_call_does_not_disturb_its_run, TRACING),
        test!(a_clean_up_killed_before_a_call_is_repeated, TRACING),
        test!(a_python_server_killed_before_a_call_is_replaced, TRACING, PYTHON),
        test!(an_ordinary_users_run_survives_the_same_kills, TRACING, ROOT),
        // Takes hours: kills before every call.
        test!(every_crash_point, TRACING).with_ignored_flag(true),
        test!(roles_killed_faster_than_they_can_start_recover_soon_after),
        // Takes ten minutes or more.
        test!(hostile_schedules_of_kills_never_stop_a_run).with_ignored_flag(true),
        // Takes up to an hour for each mode.
        test!(a_million_steps_with_a_kill_every_tenth_of_a_second).with_ignored_flag(true),
    ])
}

/// A selection of kills stops after this many failures, because each may take a minute.
const MAX_FAILURES: usize = 3;

/// Calls between which a file exists and is incomplete.
const DANGEROUS: [Call; 3] = [Call::Create, Call::Ftruncate, Call::Fchmod];

/// The number of calls of each kind before which a process is killed.
#[derive(Clone, Copy)]
struct Selection {
    /// The first calls of a dangerous kind.
    first: u32,
    /// Further calls of a dangerous kind, spread evenly.
    dangerous: u32,
    /// Calls of every other kind, spread evenly.
    others: u32,
}

impl Selection {
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

/// Kills each of `victims` before a selection of its calls, and checks the runs.
fn kill_before_some_calls(user: User, modes: &[Mode], victims: &[Victim], [first, dangerous, others]: [u32; 3]) {
    let selection = Selection {
        first,
        dangerous,
        others,
    };
    let table = Sweep {
        user,
        modes,
        victims: victims.to_vec(),
        points: &|_, call, count| selection.numbers(call, count),
        max_failures: MAX_FAILURES,
    }
    .run();
    eprint!("{}", table.text());
    table.assert_no_failures();
}

const EVALUATOR: Victim = Victim::Role("evaluator", 0);

/// The other roles of a run; `env-server` 4 is the evaluator's.
const ROLES: [Victim; 4] = [
    Victim::Role("learner", 0),
    Victim::Role("actor", 0),
    Victim::Role("env-server", 0),
    Victim::Role("env-server", 4),
];

fn a_process_killed_before_a_call_has_not_made_it() {
    let directory = tempfile::tempdir().unwrap();
    let words = ["sh", "-c", ": > first; : > second; : > third"].map(String::from);
    let made = |number| {
        let prepare = |command: &mut Command| {
            command.current_dir(directory.path());
        };
        let followed = follow(&words, prepare, Target::Command, Some((Call::Create, number)));
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

fn a_role_killed_before_a_call_is_replaced_and_the_run_completes() {
    kill_before_some_calls(User::Own, &[Mode::Free], &ROLES, [1, 1, 1]);
}

fn an_evaluator_killed_before_a_call_is_replaced() {
    // Few kills, because a free run may wait some seconds for its last evaluation.
    kill_before_some_calls(User::Own, &[Mode::Free], &[EVALUATOR], [1, 1, 0]);
}

fn a_lockstep_run_with_a_kill_ends_with_the_same_bits() {
    let all_roles = [&ROLES[..], &[EVALUATOR]].concat();
    kill_before_some_calls(User::Own, &[Mode::Lockstep], &all_roles, [1, 1, 1]);
}

fn after_a_kill_of_the_launcher_its_roles_end_and_the_run_can_be_resumed() {
    kill_before_some_calls(User::Own, &Mode::BOTH, &[Victim::Launcher], [1, 1, 1]);
}

fn a_command_killed_before_a_call_does_not_disturb_its_run() {
    let commands = ["status", "scale", "stop"].map(Victim::Command);
    kill_before_some_calls(User::Own, &[Mode::Free], &commands, [1, 1, 0]);
}

fn a_clean_up_killed_before_a_call_is_repeated() {
    kill_before_some_calls(User::Own, &Mode::BOTH, &[Victim::CleanUp], [1, 1, 1]);
}

fn a_python_server_killed_before_a_call_is_replaced() {
    kill_before_some_calls(User::Own, &[Mode::Free], &[Victim::Python(0)], [1, 1, 1]);
}

fn an_ordinary_users_run_survives_the_same_kills() {
    kill_before_some_calls(User::Nobody, &[Mode::Free], &ROLES, [1, 1, 0]);
}

fn every_crash_point() {
    let upto: u32 = number("SHOAL_CRASH_UPTO").unwrap_or(200);
    let is_chosen = |variable: &str, name: &str| list(variable).is_none_or(|names| names.iter().any(|it| it == name));
    let named = list("SHOAL_CRASH_CALLS");
    let mut victims: Vec<_> = Victim::ALL.into();
    victims.retain(|victim| is_chosen("SHOAL_CRASH_ROLES", &victim.to_string()));
    assert!(!victims.is_empty(), "SHOAL_CRASH_ROLES names no known process");
    let has_python = victims.iter().any(|victim| matches!(victim, Victim::Python(_)));
    if let Some(missing) = PYTHON.missing().filter(|_| has_python) {
        eprintln!("left out: {missing}");
        victims.retain(|victim| !matches!(victim, Victim::Python(_)));
    }
    let mut modes: Vec<_> = Mode::BOTH.into();
    modes.retain(|mode| is_chosen("SHOAL_CRASH_MODES", mode.name()));
    // `open` covers `create`.
    let is_selected = |call: Call| match &named {
        None => call != Call::Create,
        Some(names) => names.iter().any(|name| name == call.name()),
    };
    let mut table = Table::default();
    for (user, name) in [(User::Own, "own"), (User::Nobody, "nobody")] {
        if !is_chosen("SHOAL_CRASH_USERS", name) {
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
                // Python opens too many files of its own, so only calls that create files are tried.
                Victim::Python(_) if named.is_none() && call == Call::Create => (1..=count.min(upto)).collect(),
                _ if is_selected(call) => (1..=count.min(upto)).collect(),
                _ => Vec::new(),
            },
            max_failures: usize::MAX,
        };
        table.join(sweep.run());
    }
    eprint!("{}", table.text());
    table.assert_no_failures();
}

/// Sets of roles to kill; the empty set stands for all roles.
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
            Ok(kills) => eprintln!("{schedule}: {kills} kills, the run always recovered"),
            Err(what) => failures.push(what),
        }
    }
    assert!(
        failures.is_empty(),
        "{} schedules failed:\n{}",
        failures.len(),
        failures.join("\n\n")
    );
}

fn roles_killed_faster_than_they_can_start_recover_soon_after() {
    schedules(&[&["env-server"], &[]], &[1], 3, 1);
}

fn hostile_schedules_of_kills_never_stop_a_run() {
    let bursts = number("SHOAL_CRASH_BURSTS").unwrap_or(10);
    schedules(&SETS, &[1, 2], bursts, number("SHOAL_CRASH_SEED").unwrap_or(1));
}

fn a_million_steps_with_a_kill_every_tenth_of_a_second() {
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
