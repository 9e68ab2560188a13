//! `shoal top` on a terminal, with a real run.

use rustix::process::Signal;

use crate::support::{Workplace, complaint, until};
use crate::terminal::Terminal;

const ENDLESS: [&str; 4] = ["--steps", "100000000", "--actors", "1"];

#[test]
fn a_run_is_watched_scaled_and_stopped_by_keys() {
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
    assert!(terminal.is_at_work(), "it stays until somebody leaves");
    terminal.press("q");
    assert_eq!(terminal.end(), Some(0));
    leftovers.vanish();
}

#[test]
fn whoever_ends_it_gets_the_terminal_back_and_the_run_goes_on() {
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
    running.learns_on();
}

#[test]
fn without_a_terminal_or_a_run_one_line_says_so() {
    let place = Workplace::new();
    assert!(complaint(&place.output(&["top", "nowhere"])).contains("nowhere is not a run directory"));
    place.train(&["pendulum", "--steps", "300", "--run", "run"]);
    let said = complaint(&place.output(&["top", "run"]));
    assert!(
        said.contains("draws on a terminal") && said.contains("shoal status run --watch"),
        "{said}"
    );
    let mut terminal = Terminal::start(&place, &["top", "run"], true);
    assert_eq!(terminal.end(), Some(3));
    terminal.shows("nothing runs in run");
}
