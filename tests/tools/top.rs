//! `shoal top` on a terminal, with real runs.

use rustix::process::Signal;

use crate::support::{Workplace, error_line, until};
use crate::terminal::Terminal;

const ENDLESS: [&str; 4] = ["--steps", "100000000", "--actors", "1"];

#[test]
fn top_shows_scales_and_stops_a_run() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    let mut terminal = Terminal::start(&place, &["top", "run"], false);
    terminal.shows("actor 0");
    terminal.shows("learner 0");
    terminal.press("+");
    until("there are two actors", || place.status("run")["actors"] == 2);
    terminal.shows("actor 1");
    terminal.press("?");
    terminal.shows("one actor more");
    terminal.press("x");
    until("the help is gone", || !terminal.text().contains("one actor more"));
    terminal.resize(10, 40);
    terminal.shows("more");
    // A key together with a change of the size.
    for rows in 0..20 {
        terminal.resize(30 + rows, 100);
        terminal.press("?");
        terminal.shows("one actor more");
        terminal.press("x");
        until("the help is gone", || !terminal.text().contains("one actor more"));
    }
    terminal.resize(60, 200);
    terminal.shows("env-server 16");
    running.kill("actor-0");
    until("the restart is shown", || {
        let text = terminal.text();
        let actor = text
            .lines()
            .find(|line| line.starts_with("actor 0"))
            .unwrap_or_default();
        actor.split_whitespace().any(|word| word == "1")
    });
    terminal.press("s");
    terminal.shows("Stop the run?");
    terminal.press("n");
    until("the question is gone", || !terminal.text().contains("Stop the run?"));
    assert_eq!(place.status("run")["running"], true);
    terminal.press("sy");
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(0));
    terminal.shows("has ended");
    assert!(terminal.is_running(), "it stays open until the user quits");
    terminal.press("q");
    assert_eq!(terminal.end(), Some(0));
    leftovers.wait_until_gone();
}

#[test]
fn ending_top_restores_the_terminal_and_leaves_the_run_running() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    for (signal, code) in [(Signal::TERM, 143), (Signal::INT, 130), (Signal::HUP, 129)] {
        let mut terminal = Terminal::start(&place, &["top", "run"], true);
        terminal.shows("learner 0");
        terminal.signal(signal);
        assert_eq!(terminal.end(), Some(code));
    }
    let mut terminal = Terminal::start(&place, &["top", "run"], true);
    terminal.shows("learner 0");
    terminal.press("\x03");
    assert_eq!(terminal.end(), Some(0));
    running.wait_for_learning();
}

#[test]
fn without_a_terminal_or_a_run_top_is_refused_in_one_line() {
    let place = Workplace::new();
    assert!(error_line(&place.output(&["top", "nowhere"])).contains("nowhere is not a run directory"));
    place.train(&["pendulum", "--steps", "300", "--run", "run"]);
    let message = error_line(&place.output(&["top", "run"]));
    assert!(
        message.contains("draws on a terminal") && message.contains("shoal status run --watch"),
        "{message}"
    );
    let mut terminal = Terminal::start(&place, &["top", "run"], true);
    assert_eq!(terminal.end(), Some(3));
    terminal.shows("nothing runs in run");
}
