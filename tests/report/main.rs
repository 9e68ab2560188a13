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
use suite::{PYTHON, test};
use support::{Running, Workplace, error_line, until};

fn main() -> ExitCode {
    suite::run(vec![
        test!(a_report_works_in_a_browser, CHROMIUM),
        test!(the_report_of_one_run_begins_with_its_result, CHROMIUM),
        test!(frames_of_gymnasium_are_played, CHROMIUM, PYTHON),
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

/// How many pixels of the red column of `Draws` are seen: six for each state so far.
fn red_pixels(browser: &mut Browser) -> f64 {
    let count = "(async () => { const image = document.querySelector('.stage img'); await image.decode(); \
                 const canvas = document.createElement('canvas'); canvas.width = image.naturalWidth; \
                 canvas.height = image.naturalHeight; const drawn = canvas.getContext('2d'); \
                 drawn.drawImage(image, 0, 0); const { data } = drawn.getImageData(25, 0, 1, canvas.height); \
                 return [...data].filter((_, i) => i % 4 === 0 && data[i] > 120 && data[i + 1] < 120).length; })()";
    browser.value(count).as_f64().unwrap()
}

fn frames_of_gymnasium_are_played() {
    let place = Workplace::new();
    let module = include_str!("../gym/shoal_test_environments.py");
    std::fs::write(place.path().join("shoal_test_environments.py"), module).unwrap();
    let environment = "gym:shoal_test_environments:Draws-v0";
    place.train(&[environment, "--run", "run", "--steps", "200", "--envs", "2"]);
    let page = report(&place, &["run"]);
    let mut browser = Browser::start();
    browser.open(&page, 1200, true);
    assert!((red_pixels(&mut browser) - 6.0).abs() <= 1.0);
    browser.value("document.querySelector('.player').focus()");
    for (key, states) in [("ArrowRight", 2.0), ("ArrowRight", 3.0), ("End", 6.0), ("Home", 1.0)] {
        browser.key(key);
        let pixels = red_pixels(&mut browser);
        assert!((pixels - 6.0 * states).abs() <= 1.0, "{pixels} pixels after {key}");
    }
    browser.value(
        "(() => { const list = document.querySelector('.player .choices > span select'); list.value = 2; \
         list.dispatchEvent(new Event('change')); })()",
    );
    let without = browser.value("document.querySelector('.stage').innerText");
    assert!(
        without
            .as_str()
            .unwrap()
            .contains("Only the first episodes have pictures"),
        "{without}"
    );
    assert_eq!(browser.problems(), [""; 0]);
    assert_eq!(browser.requests(), [format!("file://{}", page.display())]);
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
    assert_eq!(
        sections(&mut browser),
        [
            "Result",
            "Learning curves",
            "Episodes",
            "Details",
            "Exploration",
            "Over time",
            "Settings"
        ]
    );
    let names = browser.value("document.querySelector('.legend').innerText");
    for part in ["median of 2 runs of ddpg", "(band: minimum to maximum)"] {
        assert!(names.as_str().unwrap().contains(part), "{names}");
    }
    let band = browser.value("document.querySelector('.thick .band').getBoundingClientRect().height");
    assert!(
        band.as_f64().unwrap() > 1.0,
        "the band around the median is drawn: {band}"
    );

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

/// The table of the results has each run's final evaluation, and none for the stopped one.
fn check_final_evaluations(browser: &mut Browser, place: &Workplace, runs: &[&str]) {
    let cells = browser.value(
        "[...document.querySelectorAll('#result tbody tr')].map((row) => [...row.querySelectorAll('td')].map((cell) => cell.innerText))",
    );
    // Before the results stands the ranking of the settings, the best first.
    let rows: Vec<Vec<&str>> = cells
        .as_array()
        .unwrap()
        .iter()
        .map(|row| {
            row.as_array()
                .unwrap()
                .iter()
                .map(|cell| cell.as_str().unwrap())
                .collect()
        })
        .collect();
    let rows = &rows[rows.len() - runs.len()..];
    for (run, row) in runs.iter().zip(rows) {
        assert_eq!(row[0], *run);
        let file = place.path().join(run).join("final-evaluation.json");
        match std::fs::read_to_string(file) {
            Ok(text) => {
                let found: Value = serde_json::from_str(&text).unwrap();
                let episodes = &found["policies"][0]["episodes"];
                assert_eq!(row[1], "finished");
                assert!(row[2].contains(&format!("({episodes} episodes)")), "{run}: {row:?}");
                assert!(row[3].contains(" … "), "{run}: {row:?}");
            }
            Err(_) => assert_eq!(
                (*run, &row[1..4]),
                ("again", &["not finished: stopped (by request)", "none", "–"][..])
            ),
        }
    }
}

/// The headings of the page's sections.
fn sections(browser: &mut Browser) -> Vec<String> {
    let headings = browser.value("[...document.querySelectorAll('main h2')].map((heading) => heading.innerText)");
    let headings = headings.as_array().unwrap();
    headings
        .iter()
        .map(|heading| heading.as_str().unwrap().into())
        .collect()
}

/// The names and values in the head of the page.
fn facts(browser: &mut Browser) -> Vec<(String, String)> {
    let facts = browser.value(
        "[...document.querySelectorAll('#facts dt')].map((name) => [name.innerText, name.nextElementSibling.innerText])",
    );
    serde_json::from_value(facts).unwrap()
}

fn the_report_of_one_run_begins_with_its_result() {
    let place = Workplace::new();
    let arguments = ["pendulum", "--run", "swing", "--lockstep", "--steps", "1500"];
    let more = ["--set", "evaluation.every=100"];
    place.train(&[&arguments[..], &more].concat());
    let curve = std::fs::read_to_string(place.path().join("swing/learning-curve.svg")).unwrap();
    assert!(curve.contains("swing: learning curve of ddpg"), "{curve}");

    let mut browser = Browser::start();
    let page = report(&place, &["swing"]);
    browser.open(&page, 1200, false);
    assert_eq!(
        sections(&mut browser),
        [
            "Result",
            "Learning curve",
            "Episodes",
            "Details",
            "Exploration",
            "Over time",
            "Settings"
        ]
    );
    let text = std::fs::read_to_string(place.path().join("swing/final-evaluation.json")).unwrap();
    let found: Value = serde_json::from_str(&text).unwrap();
    let shown = browser.value("document.querySelector('#result').innerText");
    let shown = shown.as_str().unwrap();
    let kept = &found["policies"]
        .as_array()
        .unwrap()
        .iter()
        .find(|it| it["policy"] == found["kept"])
        .unwrap();
    let mean = format!("−{:.0}", kept["return_mean"].as_f64().unwrap().abs());
    let first = shown.lines().nth(2).unwrap_or_default().replace(',', "");
    assert!(first.starts_with(&mean), "{mean} in {shown}");
    for part in [
        "mean return of the final evaluation",
        "95 % interval of the mean: −",
        "State: finished, 1,500 of 1,500 steps",
    ] {
        assert!(shown.contains(part), "{part} in {shown}");
    }

    let known = facts(&mut browser);
    let of = |name: &str| {
        known
            .iter()
            .find(|(known, _)| known == name)
            .map(|(_, value)| value.as_str())
    };
    assert_eq!(of("Algorithm"), Some("ddpg (lockstep)"));
    assert_eq!(of("Environment"), Some("pendulum"));
    let command = of("Command").unwrap();
    assert!(
        command.starts_with("shoal train pendulum --run swing --lockstep --steps 1500"),
        "{command}"
    );
    assert!(of("Version").unwrap().starts_with("Shoal ") && of("Machine").unwrap().contains(" core"));
    assert!(of("Start").unwrap().ends_with(" UTC") && of("Duration").unwrap().ends_with('s'));

    check_smoothing(&mut browser, &page);
    check_space(&mut browser, &page);

    // What a run has not recorded is left out.
    std::fs::remove_file(place.path().join("swing/start.json")).unwrap();
    report(&place, &["swing"]);
    browser.open(&page, 1200, false);
    let names: Vec<String> = facts(&mut browser).into_iter().map(|(name, _)| name).collect();
    assert_eq!(names, ["Algorithm", "Environment", "Seed", "Duration"]);
    assert_eq!(browser.problems(), [""; 0]);
}

/// The moving mean is drawn over the pale curve, by the keyboard alone, and forgotten with the page.
fn check_smoothing(browser: &mut Browser, page: &std::path::Path) {
    let drawn = |browser: &mut Browser, selector: &str| {
        browser.value(&format!(
            "document.querySelector('.chart').querySelector({selector:?})?.getAttribute('d') ?? null"
        ))
    };
    let raw = drawn(browser, ".line");
    assert_eq!(drawn(browser, ".smoothed .line"), Value::Null);
    browser.value("document.querySelector('#learning-curve select').focus()");
    for share in ["0.05", "0.1"] {
        browser.key("ArrowDown");
        assert_eq!(drawn(browser, ".pale .line"), raw, "{share}: the curve itself stays");
        let smoothed = drawn(browser, ".smoothed .line");
        assert!(smoothed.is_string() && smoothed != raw, "{share}: {smoothed}");
    }
    let pale = browser.value("getComputedStyle(document.querySelector('.pale .line')).opacity");
    assert!(pale.as_str().unwrap().parse::<f64>().unwrap() < 0.5, "{pale}");
    // Of -1, 1, 3, 1 with neighbours only, and with two points on either side.
    let means = "[0, 4].map((width) => movingMean({ x: [0, 1, 2, 3], y: [-1, 1, 3, 1] }, width).map((mean) => Number(mean.toFixed(3))))";
    assert_eq!(
        browser.value(means),
        serde_json::json!([[0, 1, 1.667, 2], [1, 1, 1, 1.667]])
    );
    // The second point is the last of three records.
    let selected = "movingMean({ x: [0, 1], y: [1, 9], sums: [1, 14], counts: [1, 3] }, 0)";
    assert_eq!(browser.value(selected), serde_json::json!([3.75, 3.75]));
    browser.key("Home");
    assert_eq!(drawn(browser, ".smoothed .line"), Value::Null);
    assert_eq!(drawn(browser, ".line"), raw);
    browser.key("End");
    browser.open(page, 1200, false);
    assert_eq!(
        drawn(browser, ".smoothed .line"),
        Value::Null,
        "a page that is opened again is not smoothed"
    );
}

/// Space plays and pauses from anywhere, except in what takes it itself.
fn check_space(browser: &mut Browser, page: &std::path::Path) {
    browser.open(page, 1200, false);
    let in_sight = "(() => { const box = document.querySelector('.stage').getBoundingClientRect(); return box.top >= 0 && box.bottom <= innerHeight; })()";
    assert_eq!(browser.value(in_sight), false, "the player is below the window");
    browser.key(" ");
    assert!(is_playing(browser));
    until("the picture is brought into sight", || browser.value(in_sight) == true);
    until("it plays", || frame(browser) > 0);
    browser.key(" ");
    assert!(!is_playing(browser));

    for (selector, toggles) in [
        ("nav a", true),
        (".plot", true),
        ("#details .scroll", true),
        ("#learning-curve select", false),
        ("#learning-curve input", false),
        (".chart .tools button", false),
        (".player select", false),
        (".player", true),
        (".player input[type=range]", true),
        // The page's own button for it.
        (".play", true),
    ] {
        browser.value(&format!("document.querySelector({selector:?}).focus()"));
        browser.key(" ");
        assert_eq!(is_playing(browser), toggles, "{selector}");
        if toggles {
            browser.key(" ");
            assert!(!is_playing(browser), "{selector}");
        }
        // Closes the list of a select.
        browser.key("Escape");
    }
}

/// Plays an episode with the slider, with the keyboard and automatically.
fn check_player(browser: &mut Browser, run: &str) {
    let start = moving_part(browser);
    browser.click(".player input[type=range]", 0.5);
    let middle = frame(browser);
    assert!(middle > 0, "{run}: the slider was moved");
    // Several positions, because the lake's agent is back at its start half-way.
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
    // The other episodes may be over; this one takes ten seconds.
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
    browser.open(page, 360, true);
    assert_eq!(browser.problems(), [""; 0]);
    assert_eq!(
        browser.value("document.documentElement.scrollWidth"),
        360,
        "no horizontal scrolling"
    );
    check_wide_table(browser);
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

/// A table that is too wide scrolls in its box, whose shadows show where there is more.
fn check_wide_table(browser: &mut Browser) {
    let shadows = "(() => { const box = document.querySelector('#details .box'); \
        const shade = (part, of, property) => getComputedStyle(part, of)[property]; \
        return [shade(box.querySelector('td'), null, 'boxShadow') !== 'none', shade(box, '::after', 'backgroundImage') !== 'none']; })()";
    until("a shadow on the right", || {
        browser.value(shadows) == serde_json::json!([false, true])
    });
    for (to, expected) in [(30, [true, true]), (100_000, [true, false]), (0, [false, true])] {
        browser.value(&format!("document.querySelector('#details .scroll').scrollLeft = {to}"));
        until("the shadows follow", || {
            browser.value(shadows) == serde_json::json!(expected)
        });
    }
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
            "nowhere is not a run directory: there is no such directory",
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
