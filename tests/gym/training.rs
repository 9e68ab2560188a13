//! Runs with environments of Gymnasium: their seeds, spaces and ends of episodes.

use shoal_common::space::Space;

use crate::helpers::{OURS, SHORT, config, place};
use crate::support::{self, error_line, final_result, parse, until};

pub(crate) fn a_gymnasium_pendulum_is_trained_while_its_servers_are_killed() {
    let place = place();
    // Long enough for two kills, because a process that is killed while the run ends is not replaced.
    let steps = ["--steps", "20000"];
    let running = place.start_in("run", "gym:Pendulum-v1", &[&SHORT[..], &steps].concat());
    for who in ["env-server-0", "env-server-16"] {
        running.wait_for_learning();
        running.kill(who);
        until("it is replaced", || running.pids(who).len() >= 2);
    }
    running.wait_for_learning();
    let (code, printed, leftovers) = running.wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    assert_eq!(parse(&printed)["env_steps"], 20000);

    let spec = config(&place).spec;
    assert_eq!(spec.observation, Space::boxed(&[(-1.0, 1.0), (-1.0, 1.0), (-8.0, 8.0)]));
    assert_eq!(spec.action, Space::boxed(&[(-2.0, 2.0)]));
    assert_eq!((spec.time_limit, spec.state_width), (200, 0));

    let evaluated = || place.output(&["eval", "run", "--episodes", "3", "--json"]);
    let (first, second) = (evaluated(), evaluated());
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    assert_eq!(first.stdout, second.stdout, "evaluation episodes have the same starts");
    let output = place.output(&["report", "run", "--out", "page.html"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    assert!(page.contains("\"terminated\":false"), "the report has episodes");
}

pub(crate) fn environments_receive_seeds_and_lockstep_runs_are_repeatable() {
    let place = place();
    let environment = format!("{OURS}Ends-v0");
    let weights = |name: &str, seed: &str| {
        let arguments = ["--lockstep", "--steps", "400", "--seed", seed];
        final_result(place.start_in(name, &environment, &[&SHORT[..], &arguments].concat()))
    };
    let first = weights("run", "1");
    assert_eq!(weights("again", "1"), first);
    assert_ne!(weights("other", "2"), first);
    let spec = config(&place).spec;
    assert_eq!((spec.observation.width(), spec.action.width()), (4, 2), "flattened");
}

pub(crate) fn a_resumed_lockstep_run_begins_other_episodes() {
    let place = place();
    let steps = ["--lockstep", "--steps", "200", "--set", "environment.after=0"];
    let running = place.start_in("run", &format!("{OURS}Ends-v0"), &[&SHORT[..], &steps].concat());
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
    let output = place.output(&["resume", "run", "--steps", "400"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // Every episode has five steps, and the same reward in each, which depends on its seed.
    let mut episodes = csv::Reader::from_path(place.path().join("run/episodes.csv")).unwrap();
    let column = episodes
        .headers()
        .unwrap()
        .iter()
        .position(|name| name == "return")
        .unwrap();
    let mut returns: Vec<String> = episodes.records().map(|row| row.unwrap()[column].to_owned()).collect();
    let count = returns.len();
    assert!(count > 50, "{count} episodes");
    returns.sort();
    returns.dedup();
    assert_eq!(returns.len(), count, "some episodes came twice");
}

pub(crate) fn termination_and_truncation_are_distinguished() {
    let place = place();
    for (after, steps, terminated) in [("3", "3", "1"), ("0", "5", "0"), ("5", "5", "1")] {
        let name = format!("after-{after}");
        let after = format!("environment.after={after}");
        let arguments = ["--steps", "300", "--set", &after];
        let running = place.start_in(&name, &format!("{OURS}Ends-v0"), &[&SHORT[..], &arguments].concat());
        let episodes = running.run.join("episodes.csv");
        assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
        let mut episodes = csv::Reader::from_path(episodes).unwrap();
        let rows: Vec<_> = episodes.records().map(Result::unwrap).collect();
        assert!(rows.len() > 20);
        for row in rows {
            assert_eq!((&row[4], &row[5]), (steps, terminated), "{row:?}");
        }
    }
}

pub(crate) fn discrete_spaces_with_an_offset_are_learned_by_a_table() {
    let place = place();
    let arguments = ["--steps", "3000", "--set", "q-learning.epsilon=0.5"];
    let plain = ["train", &format!("{OURS}Offset-v0"), "--run", "run", "--json"];
    let output = place.output(&[&plain[..], &arguments].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let spec = config(&place).spec;
    assert_eq!(
        (spec.observation, spec.action),
        (Space::Discrete { n: 4, start: 5 }, Space::Discrete { n: 3, start: -1 })
    );
    assert_eq!(
        support::json(&output)["eval_return_mean"],
        3.0,
        "the policy reaches the end"
    );
}

pub(crate) fn an_unsupported_environment_is_refused_in_one_line_and_leaves_no_run() {
    let place = place();
    let odd = format!("{OURS}Odd-v0");
    let endless = format!("{OURS}Endless-v0");
    let fails = format!("{OURS}Fails-v0");
    for (arguments, part) in [
        (vec!["gym:Nonsense-v9"], "Nonsense"),
        (vec![&odd], "only Box and Discrete can be served"),
        (vec![&endless], "environment.max_episode_steps=1000"),
        (vec![&fails], "how"),
        (vec!["gym:no_such_module:X-v0"], "no_such_module"),
        (
            vec!["gym:Pendulum-v1", "--set", r#"environment.server=["no-such-program"]"#],
            "cannot start the environment server no-such-program",
        ),
        (
            vec!["gym:Pendulum-v1", "--set", r#"environment.server=["true"]"#],
            "ended",
        ),
        (
            vec![
                "gym:Pendulum-v1",
                "--set",
                r#"environment.server=["python3","-S","-m","shoal_gym"]"#,
            ],
            "pip install ./python",
        ),
        (
            vec!["gym:CartPole-v1", "--set", "ddpg.gamma=0.9"],
            "ddpg cannot control",
        ),
    ] {
        let arguments: Vec<&str> = arguments.into_iter().collect();
        let message = error_line(&place.output(&[&["train"], &arguments[..]].concat()));
        assert!(message.contains(part), "{arguments:?}: {message}");
        assert!(!place.path().join("runs").exists(), "{arguments:?}");
    }
}
