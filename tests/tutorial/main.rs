//! `docs/TUTORIAL.md` is correct: its commands are run, and its environment is compiled and stepped.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

#[allow(
    unreachable_pub,
    reason = "it is public in the crate for which the tutorial writes it"
)]
mod rail;
#[path = "../support/mod.rs"]
mod support;

use std::process::Command;

use shoal_common::stream::{Purpose, stream};
use shoal_env_server::environment::{
    Class, Drawing, Environment, OutOfRange, RequestError, Signal, Step, check_time_limit,
};

use support::{Leftovers, Workplace};

const TUTORIAL: &str = include_str!("../../docs/TUTORIAL.md");

/// The contents of the fenced blocks of a language, in order.
fn blocks(language: &str) -> Vec<&'static str> {
    let fence = format!("```{language}\n");
    let after = TUTORIAL.split(fence.as_str()).skip(1);
    after.map(|rest| rest.split_once("```").unwrap().0).collect()
}

#[test]
fn the_tutorials_commands_work() {
    let place = Workplace::new();
    let binaries = std::path::Path::new(env!("CARGO_BIN_EXE_shoal")).parent().unwrap();
    let path = format!("{}:{}", binaries.display(), std::env::var("PATH").unwrap_or_default());
    let blocks = blocks("sh");
    assert!(blocks.len() >= 6, "the tutorial's commands are found");
    // After a failure, background jobs are ended in order.
    let script = format!("trap 'kill $(jobs -p) 2>/dev/null || true' EXIT\n{}", blocks.concat());
    let output = Command::new("timeout")
        .args(["500", "bash", "-e", "-o", "pipefail", "-c", &script])
        .current_dir(place.path())
        .env("PATH", path)
        .stdin(std::process::Stdio::null())
        .output()
        .unwrap();
    let [printed, errors] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text).into_owned());
    assert!(output.status.success(), "{printed}\n{errors}");
    for part in [
        "runs/first/swing-up.svg",
        "first.onnx",
        "actors: 4",
        "stopped; to continue",
    ] {
        assert!(printed.contains(part), "{part}: {printed}\n{errors}");
    }
    for file in ["runs/first/learning-curve.svg", "first.onnx", "first.safetensors"] {
        assert!(place.path().join(file).exists(), "{file}");
    }
    let log = std::fs::read_to_string(place.path().join("runs/second/shoal.log")).unwrap();
    assert!(log.contains("killed by signal 9"), "a learner was killed: {log}");
    Leftovers::of(&place.path().join("runs/second")).wait_until_gone();
}

#[test]
fn the_tutorials_environment_is_the_compiled_one() {
    assert_eq!(blocks("rust"), [include_str!("rail.rs")]);
}

/// The template in `examples/` is the same environment. It differs in what it imports and in what an environment of its
/// own need not explain.
#[test]
fn the_tutorials_environment_is_that_of_the_template() {
    let [own, template] = [include_str!("rail.rs"), include_str!("../../examples/rail/src/rail.rs")].map(|text| {
        let (_, body) = text.split_once("/// Δt").unwrap();
        let lines = body.lines().filter(|line| !line.contains("#[schemars("));
        let line = |line: &str| line.replace("pub(crate) ", "pub ").replace(", JsonSchema", "");
        lines.map(line).collect::<Vec<_>>()
    });
    assert_eq!(own, template);
}

#[test]
fn the_tutorials_environment_implements_the_trait_correctly() {
    let mut rail = rail::Rail::new(rail::Parameters::default()).unwrap();
    let spec = rail.spec();
    let mut rng = stream(1, Purpose::Environment, 0, 0);
    let mut observation = vec![f32::NAN; spec.observation.width()];
    for episode in 0..5 {
        rail.reset(&mut rng);
        for step in 0..spec.time_limit {
            let action = [f64::from((episode + step) % 3) - 1.0];
            let mut state = vec![0.0; spec.state_width];
            rail.save(&mut state);
            let mut twin = rail.clone();
            twin.restore(&state).unwrap();
            let (here, there) = (rail.step(&action, &mut rng), twin.step(&action, &mut rng));
            assert_eq!((here, here.terminated), (there, false));
            assert!(here.reward <= 0.0);
            rail.observe(&mut observation);
            assert!(observation.iter().all(|number| number.abs() <= 2.0));
        }
    }
    assert!(rail.reset_to(&[3.0, 0.0]).is_err() && rail.restore(&[1.0]).is_err());
    let signals = rail.signals();
    let keys: Vec<_> = signals.iter().map(|signal| signal.key.as_str()).collect();
    assert_eq!(keys, ["position", "velocity", "force"]);
    assert_eq!(signals[2].range(&spec), Some([-1.0, 1.0]));
    let explained = shoal_common::config::explanation::keys::<rail::Parameters>();
    assert!(
        explained
            .iter()
            .all(|key| !key.meaning.is_empty() && !key.unit.is_empty())
    );
}
