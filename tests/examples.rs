//! `examples/`: an environment in a crate of its own trains, and has the guarantees of a built-in one.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that panics has failed")]

#[path = "report/browser.rs"]
#[allow(dead_code, reason = "this suite uses a part of this file")]
mod browser;
#[path = "support/suite.rs"]
mod suite;
mod support;

use std::path::PathBuf;
use std::process::ExitCode;

use browser::{Browser, CHROMIUM};
use suite::{Need, test};
use support::{Workplace, error_line, json, until};

fn main() -> ExitCode {
    suite::run(vec![
        test!(the_template_trains_and_is_evaluated, RAIL),
        test!(a_run_without_a_description_or_a_program_has_a_learning_curve, RAIL),
        test!(its_lockstep_run_has_the_same_bits_after_kills, RAIL),
        test!(its_drawings_are_played_in_the_report, RAIL, CHROMIUM),
        test!(its_errors_are_one_line, RAIL),
    ])
}

/// `cargo test --workspace` builds it; `cargo test -p shoal` does not.
static RAIL: Need = Need::new(
    "the example is not built: cargo build --release -p shoal-env-server --example rail",
    || program().exists(),
    Some("SHOAL_REQUIRE_EXAMPLES"),
);

fn program() -> PathBuf {
    let shoal = PathBuf::from(env!("CARGO_BIN_EXE_shoal"));
    shoal.parent().unwrap().join("examples/rail")
}

/// The folder of the template as a user has copied and built it.
fn copy() -> Workplace {
    let place = Workplace::new();
    let template = include_str!("../examples/rail/rail.toml");
    std::fs::write(place.path().join("rail.toml"), template).unwrap();
    std::fs::create_dir_all(place.path().join("target/release")).unwrap();
    std::fs::copy(program(), place.path().join("target/release/rail")).unwrap();
    place
}

fn the_template_trains_and_is_evaluated() {
    let place = copy();
    let output = place.output(&["train", "rail.toml", "--json", "--quiet"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // Without a force the cart stays where it starts: at -180 in the mean.
    let result = json(&output)["eval_return_mean"].as_f64().unwrap();
    assert!(result > -80.0, "{result}");
    let evaluated = place.output(&["eval", "runs/rail-1", "--json"]);
    assert_eq!(json(&evaluated)["return_mean"].as_f64().unwrap(), result);

    let filmed = place.output(&["film", "runs/rail-1", "--size", "150", "--out", "rail.gif"]);
    assert!(filmed.status.success(), "{}", String::from_utf8_lossy(&filmed.stderr));
    let film = std::fs::read(place.path().join("rail.gif")).unwrap();
    let decoder = gif::Decoder::new(&film[..]).unwrap();
    // The drawing is 4.8 m wide and 1.5 m high: at most twice as wide as 150 pixels.
    assert_eq!((decoder.width(), decoder.height()), (300, 94));
    let reported = place.output(&["report", "runs/rail-1", "--out", "page.html"]);
    assert!(
        reported.status.success(),
        "{}",
        String::from_utf8_lossy(&reported.stderr)
    );
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    // Two episodes of 100 steps.
    assert_eq!(page.matches("\"class\":\"body\"").count(), 2 * 101);
    // What `Rail::signals` and `Rail::time_step` say.
    assert!(page.contains("\"label\":\"velocity\",\"unit\":\"m/s\"") && page.contains("\"time_step\":0.05"));
    let figure = std::fs::read_to_string(place.path().join("runs/rail-1/episode.svg")).unwrap();
    for label in ["position", "velocity", "force", "time (s)", "m/s"] {
        assert!(figure.lines().any(|line| line.trim() == label), "{label}");
    }
}

/// A run that began before its program could describe itself, or whose program is gone.
fn a_run_without_a_description_or_a_program_has_a_learning_curve() {
    let place = copy();
    let options = ["--steps", "1000", "--quiet", "--set", "evaluation.final_episodes=1"];
    let trained = place.output(&[&["train", "rail.toml"], &options[..]].concat());
    assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    let run = place.path().join("runs/rail-1");
    std::fs::remove_file(run.join("episode.svg")).unwrap();
    let plotted = || {
        let output = place.output(&["plot", "runs/rail-1"]);
        assert!(output.status.success());
        assert!(!run.join("episode.svg").exists());
        let files = String::from_utf8_lossy(&output.stdout);
        assert!(
            files.trim_end().ends_with("learning-curve.svg") && files.lines().count() == 1,
            "{files}"
        );
        String::from_utf8(output.stderr).unwrap()
    };
    std::fs::rename(place.path().join("target/release/rail"), place.path().join("moved")).unwrap();
    let said = plotted();
    assert!(
        said.starts_with("no episode was drawn: ") && said.lines().count() == 1,
        "{said}"
    );
    std::fs::remove_file(run.join("description.json")).unwrap();
    assert_eq!(plotted(), "");
}

fn its_lockstep_run_has_the_same_bits_after_kills() {
    let place = copy();
    let train = |name: &str| {
        let options = [
            "--run",
            name,
            "--lockstep",
            "--steps",
            "2500",
            "--set",
            "evaluation.final_episodes=3",
        ];
        place.launch(name, &[&["train", "rail.toml"], &options[..]].concat())
    };
    let digest = |running: support::Running| {
        let (code, printed, left) = running.wait();
        assert_eq!(code, Some(0));
        assert!(left.processes().is_empty() && left.files().is_empty());
        serde_json::from_str::<serde_json::Value>(&printed).unwrap()["weights_sha256"].clone()
    };
    let undisturbed = digest(train("undisturbed"));
    let running = train("killed");
    for who in ["env-server-0", "actor-0", "env-server-0"] {
        let before = running.pids(who).len();
        running.kill_if_alive(who);
        until("it is replaced, or the run is over", || {
            running.pids(who).len() > before || running.log().contains("the run is finished")
        });
    }
    assert!(running.pids("env-server-0").len() > 1, "a server was killed");
    assert_eq!(digest(running), undisturbed);
}

fn its_drawings_are_played_in_the_report() {
    let place = copy();
    let trained = place.output(&["train", "rail.toml", "--steps", "3000", "--quiet"]);
    assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    assert!(
        place
            .output(&["report", "runs/rail-1", "--out", "page.html"])
            .status
            .success()
    );
    let mut browser = Browser::start();
    browser.open(&place.path().join("page.html").canonicalize().unwrap(), 1200, false);
    for key in ["Home", "End"] {
        browser.value("document.querySelector('.player').focus()");
        browser.key(key);
        // The picture is 4.8 m wide. The first line is the position.
        let middle = "(() => { const cart = document.querySelector('[data-part=moves]').getBoundingClientRect(); \
                      const scene = document.querySelector('.scene').getBoundingClientRect(); \
                      return [(cart.left + cart.width / 2 - scene.left) / scene.width * 4.8 - 2.4, \
                      document.querySelector('.strip b').textContent]; })()";
        let found = browser.value(middle);
        let position = found[1].as_str().unwrap().replace('\u{2212}', "-");
        let (drawn, position) = (found[0].as_f64().unwrap(), position.parse::<f64>().unwrap());
        assert!(
            (drawn - position).abs() < 0.05,
            "{key}: drawn at {drawn}, it is at {position}"
        );
    }
    let goal = browser.value("document.querySelector('.scene .goal') !== null");
    assert_eq!(goal, true, "the middle is marked");
    assert_eq!(browser.problems(), [""; 0]);
}

fn its_errors_are_one_line() {
    let place = copy();
    for (option, part) in [
        ("environment.tim_limit=5", "unknown field `tim_limit`"),
        ("environment.time_limit=\"long\"", "invalid type"),
        (
            "environment.server=[\"target/release/nothing\"]",
            "target/release/nothing",
        ),
    ] {
        let message = error_line(&place.output(&["train", "rail.toml", "--set", option]));
        assert!(message.contains(part), "{message}");
        assert!(!place.path().join("runs").exists(), "{option} leaves a run");
    }
}
