//! A property: whatever an environment server answers, the run works, or one line names who is at fault.

use proptest::prelude::*;
use proptest::test_runner::{RngAlgorithm, TestRng, TestRunner};
use shoal_common::numbers::are_finite;
use shoal_learner::replay::Replay;

use crate::helpers::{SHORT, layout_of, place, server_of};
use crate::support::{Leftovers, QUICK};

/// Something that a server does to its answers now and then.
#[derive(Clone, Debug, serde::Serialize)]
struct Fault {
    what: &'static str,
    chance: f64,
    /// How often all servers of a run together do it at most.
    times: u32,
    number: String,
    count: u32,
}

fn any_fault() -> impl Strategy<Value = Fault> {
    let what = [
        "number", "numbers", "status", "length", "header", "none", "late", "exit", "refused", "twice",
    ];
    let number = ["nan", "inf", "-inf", "1e30", "-1e30", "1e-40", "0.5", "2", "-1", "0"];
    let chance = prop_oneof![Just(1.0), 0.0..0.3];
    let (what, number) = (
        prop::sample::select(what.to_vec()),
        prop::sample::select(number.to_vec()),
    );
    let times = prop_oneof![1_u32..4, Just(1000)];
    (what, chance, times, number, 0_u32..40).prop_map(|(what, chance, times, number, count)| Fault {
        what,
        chance,
        // Each of these costs the run some seconds.
        times: if matches!(what, "none" | "late" | "exit") {
            times.min(2)
        } else {
            times
        },
        number: number.into(),
        count,
    })
}

/// Trains with a server that follows the plan. It ends well, or one line names who is at fault.
fn survives_or_names(plan: &str) -> Result<(), TestCaseError> {
    let place = place();
    let server = server_of("scripted_server", &serde_json::to_string(plan).unwrap());
    let arguments = [
        &["train", "gym:Pendulum-v1", "--run", "run", "--steps", "300"],
        &SHORT[..],
        &["--set", "environment.faults=20", "--set", "run.stall_seconds=1"],
        &["--set", "environment.start_seconds=10", "--set", &server],
        &QUICK,
    ]
    .concat();
    let output = place.output(&arguments);
    let said = String::from_utf8_lossy(&output.stderr);
    let last = said.lines().last().unwrap_or_default();
    let errors = said.lines().filter(|line| line.starts_with("error: ")).count();
    match output.status.code() {
        Some(0) => {}
        // A reward of 1e30 is a number. What is learned from it is none.
        Some(1) => prop_assert!(
            errors == 1
                && [
                    "gym:Pendulum-v1",
                    "env-server",
                    "environment server",
                    "learner",
                    "evaluator",
                    "actor"
                ]
                .iter()
                .any(|who| said.contains(who)),
            "{said}"
        ),
        code => prop_assert!(false, "{code:?}: {said}"),
    }
    prop_assert!(!said.contains("panicked"), "{said}");
    let run = place.path().join("run");
    if run.join("replay.bin").exists() {
        let replay = Replay::open(&run.join("replay.bin"), &layout_of(&place, "run")).unwrap();
        prop_assert!(replay.rows().all(|row| are_finite(replay.row(row))), "{last}");
        let left = Leftovers::of(&run);
        prop_assert!(
            left.processes().is_empty() && left.files().is_empty(),
            "{:?}",
            left.files()
        );
    }
    Ok(())
}

pub(crate) fn random_wrong_answers_are_survived_or_one_line_names_the_culprit() {
    // Always the same plans, unless PROPTEST_CASES asks for more.
    let wanted = std::env::var("PROPTEST_CASES")
        .ok()
        .and_then(|cases| cases.parse().ok());
    let config = proptest::test_runner::Config {
        cases: wanted.unwrap_or(8),
        max_shrink_iters: 8,
        failure_persistence: None,
        ..Default::default()
    };
    let mut runner = match wanted {
        Some(_) => TestRunner::new(config),
        None => TestRunner::new_with_rng(config, TestRng::deterministic_rng(RngAlgorithm::ChaCha)),
    };
    let client = prop::sample::select(vec!["actor", "evaluator", ""]);
    let plans = (any::<u32>(), client, prop::collection::vec(any_fault(), 1..4));
    let plans = plans.prop_map(|(seed, client, faults)| {
        serde_json::json!({ "seed": seed, "client": client, "faults": faults }).to_string()
    });
    runner.run(&plans, |plan| survives_or_names(&plan)).unwrap();
}
