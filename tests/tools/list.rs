//! The list of runs in a directory.

use serde_json::Value;

use crate::support::{QUICK, Workplace, error_line, json, output_of};

fn listed<'a>(list: &'a Value, name: &str) -> &'a Value {
    let mut runs = list["runs"].as_array().unwrap().iter();
    runs.find(|run| run["name"] == name)
        .unwrap_or_else(|| panic!("{name} is not in {list}"))
}

#[test]
fn every_run_is_listed_with_its_state() {
    let place = Workplace::new();
    let message = error_line(&place.output(&["list"]));
    assert!(message.contains("there is no directory runs"), "{message}");
    std::fs::create_dir(place.path().join("runs")).unwrap();
    let empty = place.output(&["list"]);
    assert_eq!(String::from_utf8_lossy(&empty.stdout), "no runs in runs\n");

    let length = ["--steps", "400", "--lockstep", "--set", "evaluation.every=100"];
    let trained = place.train(&[&["pendulum", "--run", "runs/finished"][..], &length].concat());
    let endless = ["--steps", "100000000"];
    let killed = place.start("runs/killed", &endless);
    killed.wait_for_learning();
    killed.kill_all();
    let stopped = place.start("runs/stopped", &endless);
    stopped.wait_for_learning();
    assert!(place.output(&["stop", "runs/stopped"]).status.success());
    stopped.wait();
    std::fs::create_dir(place.path().join("runs/damaged")).unwrap();
    std::fs::write(place.path().join("runs/damaged/config.toml"), "[run\n").unwrap();
    std::fs::create_dir(place.path().join("runs/notes")).unwrap();
    let running = place.start("runs/running", &endless);
    running.wait_for_learning();

    let list = json(&place.output(&["list", "--json"]));
    assert_eq!(list["runs"].as_array().unwrap().len(), 5, "{list}");
    for name in ["finished", "killed", "stopped", "damaged", "running"] {
        assert_eq!(listed(&list, name)["state"], name, "{list}");
    }
    let finished = listed(&list, "finished");
    assert_eq!((&finished["env_steps"], &finished["steps"]), (&400.into(), &400.into()));
    assert_eq!(
        (&finished["environment"], &finished["algorithm"]),
        (&"pendulum".into(), &"ddpg".into())
    );
    let evaluations = std::fs::read_to_string(place.path().join("runs/finished/evaluations.csv")).unwrap();
    let returns = evaluations.lines().skip(1).map(|row| row.split(',').nth(4).unwrap());
    let mut returns: Vec<f64> = returns.map(|mean| mean.parse().unwrap()).collect();
    returns.sort_by(f64::total_cmp);
    assert!(returns.first() < returns.last(), "more than one: {returns:?}");
    assert_eq!(finished["best_return"].as_f64(), returns.last().copied());
    assert!(finished["final_return"].is_f64());
    assert_eq!(finished["final_return"], trained["eval_return_mean"]);
    assert!(listed(&list, "stopped")["final_return"].is_null());
    assert!(
        listed(&list, "damaged")["reason"]
            .as_str()
            .unwrap()
            .contains("config.toml")
    );
    assert!(listed(&list, "running")["env_steps"].as_u64().unwrap() > 0);

    let table = place.output(&["list", "runs"]);
    let table = String::from_utf8(table.stdout).unwrap();
    assert_eq!(table.lines().count(), 7, "{table}");
    let last = table.lines().last().unwrap();
    assert!(last.starts_with("damaged: ") && last.contains("config.toml"), "{table}");
    assert!(table.contains("best return") && table.contains("400"), "{table}");
    let finally = format!("{:.2}", finished["final_return"].as_f64().unwrap());
    assert!(
        table.lines().next().unwrap().trim_end().ends_with("final return"),
        "{table}"
    );
    let row = table.lines().find(|line| line.contains(" finished ")).unwrap();
    assert!(row.trim_end().ends_with(&finally), "{table}");
}

#[test]
fn a_failed_run_is_listed_as_failed() {
    let place = Workplace::new();
    // The limit on file sizes is too small for the replay.
    let script = format!(
        "ulimit -f 8000; exec {} train pendulum --run runs/run --set run.give_up_seconds=1 {}",
        env!("CARGO_BIN_EXE_shoal"),
        QUICK[..2]
            .iter()
            .map(|word| format!("'{word}'"))
            .collect::<Vec<_>>()
            .join(" ")
    );
    let mut shell = std::process::Command::new("sh");
    let output = output_of(shell.args(["-c", &script]).current_dir(place.path()));
    assert_eq!(output.status.code(), Some(1));
    let list = json(&place.output(&["list", "--json"]));
    assert_eq!(listed(&list, "run")["state"], "failed", "{list}");
}
