//! The progress of a suite: a live line, or a line for each event where standard error is not a terminal.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use shoal_common::message::say;
use shoal_run::numbers::thousands;
use shoal_run::suite::Suite;
use shoal_run::suite::measure::{self, best_return, final_return};
use shoal_run::suite::schedule::{Event, Observer};

/// Prints how the training of a suite goes.
pub(super) struct SuiteProgress<'a> {
    directory: &'a Path,
    quiet: bool,
    /// The runs that are being trained.
    training: Option<TrainingProgress>,
}

impl<'a> SuiteProgress<'a> {
    pub(super) fn new(directory: &'a Path, quiet: bool) -> Self {
        Self {
            directory,
            quiet,
            training: None,
        }
    }

    fn print(&self, line: &str) {
        if !self.quiet {
            say(line);
        }
    }
}

impl Observer for SuiteProgress<'_> {
    fn begin(&mut self, suite: &Suite, due: &VecDeque<usize>, until: Option<f64>) {
        let until_then = until.map_or_else(String::new, |share| {
            format!("until each has done {:.0} % of its steps: ", 100.0 * share)
        });
        let (due_runs, all) = (due.len(), suite.trials.len());
        self.print(&format!("{until_then}{due_runs} of {all} runs to train"));
        self.training = Some(TrainingProgress::new(suite, self.directory, due, until, self.quiet));
    }

    fn observe(&mut self, event: Option<Event>) {
        if let Some(training) = &mut self.training {
            training.observe(event);
        }
    }

    fn end(&mut self) {
        if let Some(training) = self.training.take() {
            training.bar.finish_and_clear();
        }
    }

    fn end_round(&mut self, share: f64, ended: &[String]) {
        self.print(&format!("ended early at {:.0} %: {}", 100.0 * share, ended.join("; ")));
    }
}

/// The progress of some runs of a suite.
struct TrainingProgress {
    /// The directories of all runs of the suite, by the numbers of their trials.
    runs: Vec<PathBuf>,
    /// The names of the runs.
    names: Vec<String>,
    bar: ProgressBar,
    live: bool,
    quiet: bool,
    /// Each run is trained until it has done this share of its steps.
    until: f64,
    /// The runs that are to be trained, by the numbers of their trials.
    due: BTreeMap<usize, DueRun>,
    running: Vec<usize>,
    failed: BTreeSet<usize>,
    started_at: Instant,
}

struct DueRun {
    /// What it had done when this process began.
    begin: u64,
    ended: bool,
}

/// The steps of a run, or its episodes, that the remaining time is estimated from.
struct RunLength {
    /// Made since this process began.
    made: u64,
    left: u64,
    /// Of the whole run; `None` if nobody knows yet.
    goal: Option<u64>,
}

impl TrainingProgress {
    /// The progress of the trials with the numbers `due`, each until it has done the share `until` of its steps.
    fn new(suite: &Suite, directory: &Path, due: &VecDeque<usize>, until: Option<f64>, quiet: bool) -> Self {
        let names: Vec<String> = suite.trials.iter().map(|trial| trial.name.clone()).collect();
        let runs: Vec<PathBuf> = names.iter().map(|name| directory.join(name)).collect();
        let live = !quiet && std::io::stderr().is_terminal();
        let target = if live {
            ProgressDrawTarget::stderr()
        } else {
            ProgressDrawTarget::hidden()
        };
        let bar = ProgressBar::with_draw_target(Some(runs.len() as u64), target);
        if let Ok(style) = ProgressStyle::with_template("{bar:16.cyan/dim} {msg}") {
            bar.set_style(style.progress_chars("━━─"));
        }
        let due_run = |number: &usize| {
            let begin = measure::progress(&runs[*number]).map_or(0, |(done, _)| done);
            (*number, DueRun { begin, ended: false })
        };
        Self {
            due: due.iter().map(due_run).collect(),
            runs,
            names,
            bar,
            live,
            quiet,
            until: until.unwrap_or(1.0),
            running: Vec::new(),
            failed: BTreeSet::new(),
            started_at: Instant::now(),
        }
    }

    /// Prints what the event says and draws the live line again; `None` only draws it.
    fn observe(&mut self, event: Option<Event>) {
        match event {
            None => {}
            Some(Event::Started(number)) => {
                self.running.push(number);
                if !self.live {
                    self.print(&format!("{}: started", self.names[number]));
                }
            }
            Some(Event::Finished(number)) => {
                self.end_run(number);
                let left = self
                    .time_left()
                    .map_or_else(String::new, |left| format!(", about {left} left"));
                let result =
                    final_return(&self.runs[number]).map_or_else(String::new, |mean| format!(", return {mean:.2}"));
                self.print(&format!("{}: done{result}, {}{left}", self.names[number], self.count()));
            }
            Some(Event::Interrupted(number)) => self.running.retain(|other| *other != number),
            Some(Event::Paused(number)) => {
                self.end_run(number);
                let best = best_return(&self.runs[number]);
                self.print(&format!("{}: best return so far {best:.2}", self.names[number]));
            }
            Some(Event::Failed(number, why)) => {
                self.end_run(number);
                self.failed.insert(number);
                self.print(&format!("{}: failed: {why}", self.names[number]));
            }
        }
        self.draw();
    }

    fn end_run(&mut self, number: usize) {
        self.running.retain(|other| *other != number);
        if let Some(run) = self.due.get_mut(&number) {
            run.ended = true;
        }
    }

    /// How many runs have nothing left to do, failed ones included.
    fn ended(&self) -> usize {
        self.runs.len() - self.due.values().filter(|run| !run.ended).count()
    }

    fn count(&self) -> String {
        format!("{} of {} runs", self.ended() - self.failed.len(), self.runs.len())
    }

    fn time_left(&self) -> Option<String> {
        let length = |(number, run): (&usize, &DueRun)| {
            let Some((done, all)) = measure::progress(&self.runs[*number]) else {
                let nothing = RunLength {
                    made: 0,
                    left: 0,
                    goal: None,
                };
                return run.ended.then_some(nothing);
            };
            let goal = (self.until * all as f64).ceil() as u64;
            Some(RunLength {
                made: done.saturating_sub(run.begin),
                left: if run.ended { 0 } else { goal.saturating_sub(done) },
                goal: Some(goal),
            })
        };
        let lengths: Vec<_> = self.due.iter().map(length).collect();
        let seconds = seconds_left(&lengths, self.started_at.elapsed())?;
        Some(format!("{:#}", HumanDuration(Duration::from_secs(seconds as u64))))
    }

    fn draw(&self) {
        if !self.live {
            return;
        }
        let mut lines = vec![self.count()];
        if let Some(left) = self.time_left() {
            lines[0] += &format!(" · {left} left");
        }
        for number in &self.running {
            if let Some((done, all)) = measure::progress(&self.runs[*number]) {
                let name: String = self.names[*number].chars().take(50).collect();
                lines.push(format!("{name}: {} of {}", thousands(done), thousands(all)));
            }
        }
        self.bar.set_position(self.ended() as u64);
        self.bar.set_message(lines.join("\n  "));
    }

    fn print(&self, line: &str) {
        if !self.quiet {
            self.bar.suspend(|| say(line));
        }
    }
}

/// The estimated remaining time in s, at the rate since `elapsed` ago; `None` if no rate is known or nothing is left. A
/// run that has not begun is `None` and as long as the others are on average.
fn seconds_left(runs: &[Option<RunLength>], elapsed: Duration) -> Option<f64> {
    let begun = || runs.iter().flatten();
    let made: u64 = begun().map(|run| run.made).sum();
    let left: u64 = begun().map(|run| run.left).sum();
    let waiting = runs.len() - begun().count();
    let goals: Vec<u64> = begun().filter_map(|run| run.goal).collect();
    let mean_goal = goals.iter().sum::<u64>() as f64 / goals.len().max(1) as f64;
    let left = left as f64 + waiting as f64 * mean_goal;
    (made > 0 && left > 0.0).then(|| elapsed.as_secs_f64() * left / made as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_remaining_time_counts_what_each_run_has_left() {
        let run = |made, left, goal| {
            let goal = (goal > 0).then_some(goal);
            Some(RunLength { made, left, goal })
        };
        let seconds = |runs: &[Option<RunLength>]| seconds_left(runs, Duration::from_secs(10));
        assert_eq!(seconds(&[run(100, 300, 400)]), Some(30.0));
        assert_eq!(seconds(&[run(100, 300, 900)]), Some(30.0), "a resumed run");
        assert_eq!(seconds(&[run(100, 0, 200), None]), Some(20.0), "one that waits");
        assert_eq!(
            seconds(&[run(10, 0, 200), run(90, 100, 200)]),
            Some(10.0),
            "one that failed"
        );
        assert_eq!(
            seconds(&[run(0, 0, 0), run(100, 0, 100), None]),
            Some(10.0),
            "one that failed at once"
        );
        assert_eq!(seconds(&[run(100, 0, 100)]), None, "nothing is left");
        assert_eq!(seconds(&[None, run(0, 100, 100)]), None, "there is no rate yet");
    }
}
