//! The report of real runs: a self-contained file, tested in a real browser.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that panics has failed")]

mod browser;
#[path = "../support/suite.rs"]
mod suite;
#[path = "../support/mod.rs"]
mod support;

use std::path::PathBuf;
use std::process::ExitCode;

use browser::{Browser, CHROMIUM};
use libtest_mimic::Completion;
use serde_json::Value;
use suite::test;
use support::{Running, Workplace, error_line, until};

fn main() -> ExitCode {
    suite::run(vec![
        test!(a_report_works_in_a_browser, CHROMIUM),
        test!(a_running_run_and_one_with_few_records_can_be_reported),
        test!(an_impossible_report_is_refused_in_one_line),
    ])
}

/// Short runs of each environment, and of the pendulum also one with another seed and one with a kill.
fn runs() -> (Workplace, Vec<&'static str>) {
    let place = Workplace::new();
    let evaluate = ["--set", "evaluation.every=200", "--steps", "800"];
    place.train(&[&["pendulum", "--run", "swing", "--lockstep"], &evaluate[..]].concat());
    place.train(&[&["point-mass-r3", "--run", "drive", "--lockstep"], &evaluate[..]].concat());
    place.train(
        &[
            &["pendulum", "--run", "swing-2", "--lockstep", "--seed", "2"],
            &evaluate[..],
        ]
        .concat(),
    );
    for (preset, name, episodes) in [("cart-pole", "balance", "10"), ("frozen-lake", "lake", "40")] {
        let arguments = ["train", preset, "--run", name, "--episodes", episodes, "--quiet"];
        let trained = place.output(
            &[
                &arguments[..],
                &["--set", "evaluation.episodes=3", "--set", "evaluation.final_episodes=3"],
            ]
            .concat(),
        );
        assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    }
    train_with_a_kill(&place, "again");
    (place, vec!["swing", "swing-2", "drive", "balance", "lake", "again"])
}

/// A run of the pendulum in which an actor is killed, and which is then stopped.
fn train_with_a_kill(place: &Workplace, name: &str) {
    let running = place.start(
        name,
        &[
            "--steps",
            "1000000000",
            "--actors",
            "1",
            "--set",
            "evaluation.every=200",
        ],
    );
    running.wait_for_learning();
    running.kill("actor-0");
    until("the kill is recorded", || {
        incidents(&running).contains("actor,0,started-again")
    });
    until("a policy was evaluated", || {
        running.run.join("checkpoints/best.policy").exists()
    });
    assert!(place.output(&["stop", name]).status.success());
    running.wait();
}

fn incidents(running: &Running) -> String {
    std::fs::read_to_string(running.run.join("incidents.csv")).unwrap_or_default()
}

/// Writes a report of these runs and returns its path.
fn report(place: &Workplace, runs: &[&str]) -> PathBuf {
    let output = place.output(&[&["report"], runs, &["--out", "page.html"]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(String::from_utf8_lossy(&output.stdout), "page.html\n");
    std::fs::canonicalize(place.path().join("page.html")).unwrap()
}

/// The position of the moving part of the player's picture.
fn moving_part(browser: &mut Browser) -> Vec<Value> {
    let place = "(() => { const b = document.querySelector('[data-part=moves]').getBoundingClientRect(); \
                 return [Math.round(b.left * 10), Math.round((b.top + scrollY) * 10)]; })()";
    browser.value(place).as_array().unwrap().clone()
}

fn frame(browser: &mut Browser) -> u64 {
    let frame = browser.value("document.querySelector('.player input[type=range]').value");
    frame.as_str().unwrap().parse().unwrap()
}

fn is_playing(browser: &mut Browser) -> bool {
    browser.value("document.querySelector('.play').dataset.playing") == "true"
}

fn a_report_works_in_a_browser() {
    let mut browser = Browser::start();
    let (place, runs) = runs();
    let page = report(&place, &runs);
    browser.open(&page, 1200, false);
    assert_eq!(browser.problems(), [""; 0]);
    assert_eq!(
        browser.requests(),
        [format!("file://{}", page.display())],
        "requests only itself"
    );

    check_final_evaluations(&mut browser, &place, &runs);
    let names = browser.value("document.querySelector('.legend').innerText");
    assert!(names.as_str().unwrap().contains("median of 2 runs of ddpg"), "{names}");

    // Every chart has a curve, and the time line shows the kill.
    let charts = browser.value("[...document.querySelectorAll('figure.chart .plot:not(.timeline)')].map((plot) => [...plot.querySelectorAll('.line')].some((line) => line.getAttribute('d').includes('L')) || plot.querySelector('circle') !== null)");
    let charts = charts.as_array().unwrap();
    assert!(
        charts.len() >= 8 && charts.iter().all(|drawn| drawn == true),
        "{charts:?}"
    );
    let signs = browser
        .value("[...document.querySelectorAll('.timeline .sign title')].map((title) => title.textContent).join('\\n')");
    let signs = signs.as_str().unwrap();
    assert!(
        signs.contains("actor 0 killed by signal 9") && signs.contains("actor 0 started again"),
        "{signs}"
    );

    for (i, run) in runs.iter().enumerate() {
        browser.value(&format!(
            "(() => {{ const choice = document.querySelector('.player select'); choice.value = {i}; choice.dispatchEvent(new Event('change')); }})()"
        ));
        check_player(&mut browser, run);
    }
    check_readout_and_zoom(&mut browser);
    assert_eq!(browser.problems(), [""; 0]);
    check_narrow_and_dark(&mut browser, &page);
}

/// The row of the final evaluation has each run's, and none for the stopped one.
fn check_final_evaluations(browser: &mut Browser, place: &Workplace, runs: &[&str]) {
    let row =
        "[...document.querySelectorAll('tr')].find((row) => row.querySelector('th')?.innerText === 'final evaluation')";
    let cells = browser.value(&format!(
        "[...{row}.querySelectorAll('td')].map((cell) => cell.innerText)"
    ));
    let cells = cells.as_array().unwrap();
    assert_eq!(cells.len(), runs.len());
    for (run, cell) in runs.iter().zip(cells) {
        let cell = cell.as_str().unwrap();
        let file = place.path().join(run).join("final-evaluation.json");
        match std::fs::read_to_string(file) {
            Ok(text) => {
                let found: Value = serde_json::from_str(&text).unwrap();
                let episodes = &found["policies"][0]["episodes"];
                assert!(
                    cell.contains(&format!("({episodes} episodes, 95 % interval")),
                    "{run}: {cell}"
                );
            }
            Err(_) => assert_eq!((*run, cell), ("again", "none")),
        }
    }
}

/// Plays an episode with the slider, with the keyboard and automatically.
fn check_player(browser: &mut Browser, run: &str) {
    let start = moving_part(browser);
    browser.click(".player input[type=range]", 0.5);
    let middle = frame(browser);
    assert!(middle > 0, "{run}: the slider was moved");
    // Several positions, because the lake's walker is back at its start half-way.
    let mut places = vec![start, moving_part(browser)];
    browser.value("document.querySelector('.player').focus()");
    browser.key("Home");
    assert_eq!(frame(browser), 0, "{run}");
    for step in 1..=3 {
        browser.key("ArrowRight");
        assert_eq!(frame(browser), step.min(last_frame(browser)), "{run}");
        places.push(moving_part(browser));
    }
    browser.key("ArrowLeft");
    browser.key("End");
    assert_eq!(frame(browser), last_frame(browser), "{run}");
    places.push(moving_part(browser));
    assert!(
        places.iter().any(|place| place != &places[0]),
        "{run}: something moves: {places:?}"
    );

    browser.key("Home");
    browser.key(" ");
    until("space plays", || frame(browser) > 0);
    // The other episodes may be over by now; this one takes ten seconds.
    if run == "swing" {
        assert!(is_playing(browser));
        browser.key(" ");
        assert!(!is_playing(browser), "space pauses");
        let paused = frame(browser);
        browser.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))");
        assert_eq!(frame(browser), paused);
    }
}

fn last_frame(browser: &mut Browser) -> u64 {
    let last = browser.value("document.querySelector('.player input[type=range]').max");
    last.as_str().unwrap().parse().unwrap()
}

fn check_readout_and_zoom(browser: &mut Browser) {
    browser.value("document.querySelector('.plot').focus()");
    browser.key("ArrowRight");
    browser.key("ArrowRight");
    let readout = browser.value("document.querySelector('.plot .readout').innerText");
    assert!(
        readout.as_str().unwrap().contains("step ") && readout.as_str().unwrap().contains("swing: "),
        "{readout}"
    );
    let curve = "document.querySelector('.plot .line').getAttribute('d')";
    let whole = browser.value(curve);
    browser.click(".chart .tools button:nth-child(2)", 0.5);
    let nearer = browser.value(curve);
    assert_ne!(nearer, whole, "zoomed in");
    browser.click(".chart .tools button:nth-child(3)", 0.5);
    assert_eq!(browser.value(curve), whole, "the whole curve again");
}

fn check_narrow_and_dark(browser: &mut Browser, page: &std::path::Path) {
    browser.open(page, 390, true);
    assert_eq!(browser.problems(), [""; 0]);
    assert_eq!(
        browser.value("document.documentElement.scrollWidth"),
        390,
        "no horizontal scrolling"
    );
    let small = browser.value(
        "[...document.querySelectorAll('button, select, input[type=range], nav a, summary')].filter((part) => part.offsetParent && part.getBoundingClientRect().height < 43).map((part) => part.outerHTML)",
    );
    assert_eq!(small, serde_json::json!([]), "controls are large enough for a finger");
    let [paper, ink] = ["backgroundColor", "color"].map(|name| {
        let colour = browser.value(&format!("getComputedStyle(document.body).{name}"));
        let parts = colour
            .as_str()
            .unwrap()
            .trim_start_matches("rgb(")
            .trim_end_matches(')')
            .to_owned();
        parts.split(", ").map(|part| part.parse::<u32>().unwrap()).sum::<u32>()
    });
    assert!(paper < 150 && ink > 600, "{paper} {ink}");
    browser.value("document.querySelector('.play').focus()");
    browser.key("Tab");
    let outline = browser.value("getComputedStyle(document.activeElement).outlineStyle");
    assert_eq!(outline, "solid", "the focus is visible");
}

fn a_running_run_and_one_with_few_records_can_be_reported() -> Completion {
    let place = Workplace::new();
    let running = place.start("run", &["--steps", "1000000000"]);
    running.wait_for_learning();
    let page = std::fs::read_to_string(report(&place, &["run"])).unwrap();
    assert!(page.contains("\"state\":\"training\""));
    assert!(place.output(&["stop", "run"]).status.success());
    let run = running.run.clone();
    running.wait();

    // A run without records, as an older version may have left it.
    for file in [
        "incidents.csv",
        "evaluations.csv",
        "episodes.csv",
        "learner.csv",
        "checkpoints/best.policy",
        "checkpoints/last.policy",
    ] {
        let _ = std::fs::remove_file(run.join(file));
    }
    let output = place.output(&["report", "run"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    assert!(page.contains("\"incidents\":null") && page.contains("No policy has been evaluated yet."));
    if let Some(missing) = CHROMIUM.missing() {
        return Completion::ignored_with(format!("the report was written but not opened: {missing}"));
    }
    let mut browser = Browser::start();
    browser.open(&run.join("report.html"), 800, false);
    assert_eq!(browser.problems(), [""; 0]);
    Completion::Completed
}

fn an_impossible_report_is_refused_in_one_line() {
    let place = Workplace::new();
    std::fs::create_dir(place.path().join("empty")).unwrap();
    place.train(&["pendulum", "--run", "run", "--steps", "200", "--lockstep"]);
    std::fs::write(place.path().join("letter.html"), "<!doctype html>\nDear reader").unwrap();
    for (arguments, part) in [
        (
            &["nowhere"][..],
            "nowhere is not a run directory: it has no config.toml",
        ),
        (&["run", "empty"], "empty is not a run directory"),
        (&["run", "run/../run"], "is named twice"),
        (
            &["run", "--out", "letter.html"],
            "letter.html exists and is not a report",
        ),
        (
            &["run", "--out", "empty"],
            "empty is a directory: give --out the name of a file",
        ),
        (
            &["run", "--out", "no/where.html"],
            "cannot write no/where.html; choose another place with --out",
        ),
    ] {
        let message = error_line(&place.output(&[&["report"], arguments].concat()));
        assert!(
            message.starts_with("error: ") && message.contains(part),
            "{arguments:?}: {message}"
        );
    }
    let kept = std::fs::read_to_string(place.path().join("letter.html")).unwrap();
    assert!(kept.ends_with("Dear reader"));
    std::fs::write(place.path().join("run/learner.csv"), "a,b\n1,2\n").unwrap();
    let message = error_line(&place.output(&["report", "run"]));
    assert!(
        message.contains("learner.csv is not a record of this program"),
        "{message}"
    );
}
