//! Many kills, some at a time, and a table of what came of them.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::{Condvar, Mutex};

use crate::calls::Call;
use crate::place::{Program, User};
use crate::trial::{Calm, Mode, Scene, Verdict, Victim};

/// Runs at a time, of all tests of this process together.
pub(crate) fn jobs() -> usize {
    number("SHOAL_CRASH_JOBS").unwrap_or(2).max(1)
}

pub(crate) fn number<N: std::str::FromStr>(variable: &str) -> Option<N> {
    let text = std::env::var(variable).ok()?;
    let parsed = text.parse().ok();
    assert!(parsed.is_some(), "{variable}={text} is no number");
    parsed
}

/// The words of a list in an environment variable.
pub(crate) fn list(variable: &str) -> Option<Vec<String>> {
    let text = std::env::var(variable).ok()?;
    Some(text.split(',').map(|word| word.trim().to_owned()).collect())
}

static RUNNING: (Mutex<usize>, Condvar) = (Mutex::new(0), Condvar::new());

/// The right to have a run under way.
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

/// Victims, calls and numbers to try.
pub(crate) struct Sweep<'a> {
    pub(crate) user: User,
    pub(crate) modes: &'a [Mode],
    pub(crate) victims: Vec<Victim>,
    /// Before which of a victim's calls of a kind it is killed, where it begins so many.
    pub(crate) points: &'a (dyn Fn(Victim, Call, u32) -> Vec<u32> + Sync),
    /// It ends after so many failures.
    pub(crate) patience: usize,
}

/// What came of the kills before one kind of call.
#[derive(Clone, Copy, Default)]
struct Row {
    tried: u32,
    hit: u32,
    failed: u32,
}

/// What came of all.
#[derive(Default)]
pub(crate) struct Table {
    rows: BTreeMap<(String, Call), Row>,
    failures: Vec<String>,
    hit: u32,
}

struct Point<'a> {
    scene: Scene<'a>,
    calm: &'a Calm,
    call: Call,
    number: u32,
}

impl Sweep<'_> {
    /// Does it all.
    pub(crate) fn run(&self) -> Table {
        let program = Program::of(self.user);
        let mut table = Table::default();
        let scenes = self.victims.iter().flat_map(|victim| {
            self.modes.iter().map(|mode| Scene {
                program: &program,
                victim: *victim,
                mode: *mode,
            })
        });
        // A lockstep run is asked nothing that changes it.
        let scenes = scenes.filter(|scene| (scene.victim, scene.mode) != (Victim::Asker("scale"), Mode::Lockstep));
        let calms = in_parallel(scenes.collect(), |scene: Scene<'_>| {
            let _permit = Permit::take();
            (scene, scene.calm())
        });
        let mut known = Vec::new();
        for (scene, calm) in calms {
            match calm {
                Err(errno) => table
                    .failures
                    .push(format!("{}, cannot be traced: {errno}", self.name(scene))),
                Ok(Err(what)) => table
                    .failures
                    .push(format!("{}, nobody killed: {what}", self.name(scene))),
                Ok(Ok(calm)) => known.push((scene, calm)),
            }
        }
        let mut points = Vec::new();
        for (scene, calm) in &known {
            for call in scene.victim.calls() {
                let count = calm.counts.get(&call).copied().unwrap_or(0);
                let numbers = (self.points)(scene.victim, call, count).into_iter();
                points.extend(numbers.map(|number| Point {
                    scene: *scene,
                    calm,
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
        if table.lock().unwrap().failures.len() >= self.patience {
            return;
        }
        let Point {
            scene,
            calm,
            call,
            number,
        } = *point;
        let verdict = scene.kill_before(call, number, calm);
        let mut table = table.lock().unwrap();
        let row = table.rows.entry((self.name(scene), call)).or_default();
        row.tried += 1;
        row.hit += u32::from(!matches!(verdict, Verdict::NotReached));
        row.failed += u32::from(matches!(verdict, Verdict::Failed(_)));
        table.hit += u32::from(!matches!(verdict, Verdict::NotReached));
        if let Verdict::Failed(what) = verdict {
            let text = format!(
                "{} killed before its {} number {number}: {what}",
                self.name(scene),
                call.name()
            );
            // The whole of it comes at the end.
            eprintln!("{}", text.lines().next().unwrap_or_default());
            table.failures.push(text);
        }
    }

    fn name(&self, scene: Scene<'_>) -> String {
        let user = match self.user {
            User::Own => "",
            User::Nobody => ", nobody",
        };
        format!("{} ({}{user})", scene.victim, scene.mode.name())
    }
}

impl Table {
    /// Fails with everything that went wrong.
    pub(crate) fn evaluate(&self) {
        let failures = self.failures.join("\n\n");
        assert!(
            self.failures.is_empty(),
            "{} of {} kills:\n{failures}",
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

/// Does something with each of these, some at a time; the results in the same order.
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
