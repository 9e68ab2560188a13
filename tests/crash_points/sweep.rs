//! Many kills, several at a time, and a table of their results.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::{Condvar, Mutex};

use crate::calls::Call;
use crate::trial::{Baseline, Case, Mode, Outcome, Victim};
use crate::workplace::{Program, User};

/// Limit on the number of runs at the same time, of all tests of this process together.
pub(crate) fn jobs() -> usize {
    number("SHOAL_CRASH_JOBS").unwrap_or(2).max(1)
}

pub(crate) fn number<N: std::str::FromStr>(variable: &str) -> Option<N> {
    let text = std::env::var(variable).ok()?;
    let parsed = text.parse().ok();
    assert!(parsed.is_some(), "{variable}={text} is not a number");
    parsed
}

/// The entries of a comma-separated list in an environment variable.
pub(crate) fn list(variable: &str) -> Option<Vec<String>> {
    let text = std::env::var(variable).ok()?;
    Some(text.split(',').map(|word| word.trim().to_owned()).collect())
}

static RUNNING: (Mutex<usize>, Condvar) = (Mutex::new(0), Condvar::new());

/// Permission to have a run running.
pub(crate) struct Permit;

impl Permit {
    pub(crate) fn take() -> Self {
        let (running, freed) = &RUNNING;
        let mut running = freed
            .wait_while(running.lock().unwrap(), |running| *running >= jobs())
            .unwrap();
        *running += 1;
        Self
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        *RUNNING.0.lock().unwrap() -= 1;
        RUNNING.1.notify_one();
    }
}

/// Kills to try: processes, modes, calls and the numbers of the calls.
pub(crate) struct Sweep<'a> {
    pub(crate) user: User,
    pub(crate) modes: &'a [Mode],
    pub(crate) victims: Vec<Victim>,
    /// Maps a victim, a kind of call and the number of such calls in an undisturbed run to the calls to kill before.
    pub(crate) points: &'a (dyn Fn(Victim, Call, u32) -> Vec<u32> + Sync),
    /// The sweep stops after this many failures.
    pub(crate) max_failures: usize,
}

/// Results of the kills before one kind of call.
#[derive(Clone, Copy, Default)]
struct Row {
    tried: u32,
    hit: u32,
    failed: u32,
}

/// Results of all kills.
#[derive(Default)]
pub(crate) struct Table {
    rows: BTreeMap<(String, Call), Row>,
    failures: Vec<String>,
    hit: u32,
}

struct Point<'a> {
    case: Case<'a>,
    baseline: &'a Baseline,
    call: Call,
    number: u32,
}

impl Sweep<'_> {
    /// Runs everything.
    pub(crate) fn run(&self) -> Table {
        let program = Program::of(self.user);
        let mut table = Table::default();
        let cases = self.victims.iter().flat_map(|victim| {
            self.modes.iter().map(|mode| Case {
                program: &program,
                victim: *victim,
                mode: *mode,
            })
        });
        // A lockstep run cannot be scaled.
        let cases = cases.filter(|case| (case.victim, case.mode) != (Victim::Command("scale"), Mode::Lockstep));
        let baselines = in_parallel(cases.collect(), |case: Case<'_>| {
            let _permit = Permit::take();
            (case, case.baseline())
        });
        let mut known = Vec::new();
        for (case, baseline) in baselines {
            match baseline {
                Err(errno) => table
                    .failures
                    .push(format!("{}, cannot be traced: {errno}", self.name(case))),
                Ok(Err(what)) => table
                    .failures
                    .push(format!("{}, without a kill: {what}", self.name(case))),
                Ok(Ok(baseline)) => known.push((case, baseline)),
            }
        }
        let mut points = Vec::new();
        for (case, baseline) in &known {
            for call in case.victim.calls() {
                let count = baseline.counts.get(&call).copied().unwrap_or(0);
                let numbers = (self.points)(case.victim, call, count).into_iter();
                points.extend(numbers.map(|number| Point {
                    case: *case,
                    baseline,
                    call,
                    number,
                }));
            }
        }
        let table = Mutex::new(table);
        in_parallel(points, |point| self.attempt(&point, &table));
        table.into_inner().unwrap()
    }

    fn attempt(&self, point: &Point<'_>, table: &Mutex<Table>) {
        let _permit = Permit::take();
        if table.lock().unwrap().failures.len() >= self.max_failures {
            return;
        }
        let Point {
            case,
            baseline,
            call,
            number,
        } = *point;
        let outcome = case.kill_before(call, number, baseline);
        let mut table = table.lock().unwrap();
        let row = table.rows.entry((self.name(case), call)).or_default();
        row.tried += 1;
        row.hit += u32::from(!matches!(outcome, Outcome::NotReached));
        row.failed += u32::from(matches!(outcome, Outcome::Failed(_)));
        table.hit += u32::from(!matches!(outcome, Outcome::NotReached));
        if let Outcome::Failed(what) = outcome {
            let text = format!(
                "{} killed before its {} number {number}: {what}",
                self.name(case),
                call.name()
            );
            // The complete text is printed at the end.
            eprintln!("{}", text.lines().next().unwrap_or_default());
            table.failures.push(text);
        }
    }

    fn name(&self, case: Case<'_>) -> String {
        let user = match self.user {
            User::Own => "",
            User::Nobody => ", nobody",
        };
        format!("{} ({}{user})", case.victim, case.mode.name())
    }
}

impl Table {
    /// Panics with all failures if there are any.
    pub(crate) fn assert_no_failures(&self) {
        let failures = self.failures.join("\n\n");
        assert!(
            self.failures.is_empty(),
            "{} of {} kills failed:\n{failures}",
            self.failures.len(),
            self.hit
        );
    }

    pub(crate) fn join(&mut self, other: Self) {
        self.rows.extend(other.rows);
        self.failures.extend(other.failures);
        self.hit += other.hit;
    }

    pub(crate) fn text(&self) -> String {
        let mut text = format!(
            "{:<28} {:<10} {:>6} {:>6} {:>6}\n",
            "who", "call", "tried", "hit", "failed"
        );
        let mut sum = Row::default();
        for ((who, call), row) in &self.rows {
            let Row { tried, hit, failed } = row;
            let _ = writeln!(text, "{who:<28} {:<10} {tried:>6} {hit:>6} {failed:>6}", call.name());
            sum.tried += tried;
            sum.hit += hit;
            sum.failed += failed;
        }
        let Row { tried, hit, failed } = sum;
        let _ = writeln!(text, "{:<28} {:<10} {tried:>6} {hit:>6} {failed:>6}", "all", "");
        text
    }
}

/// Calls `work` with each item, several at a time. The results have the order of the items.
pub(crate) fn in_parallel<T: Send, R: Send>(items: Vec<T>, work: impl Fn(T) -> R + Sync) -> Vec<R> {
    let mut results: Vec<Option<R>> = items.iter().map(|_| None).collect();
    let left = Mutex::new(items.into_iter().zip(results.iter_mut()));
    std::thread::scope(|scope| {
        for _ in 0..jobs() {
            scope.spawn(|| {
                loop {
                    let Some((item, result)) = left.lock().unwrap().next() else {
                        return;
                    };
                    *result = Some(work(item));
                }
            });
        }
    });
    drop(left);
    results.into_iter().map(Option::unwrap).collect()
}
