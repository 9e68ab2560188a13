//! Bad input gets one line that states what is wrong, where, and what to do, and a non-zero exit code. Nothing is lost.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use support::{QUICK, Workplace, error_line, until};

#[test]
fn invalid_training_arguments_are_refused_before_anything_is_created() {
    let place = Workplace::new();
    std::fs::write(place.path().join("broken.toml"), "[run\n").unwrap();
    std::fs::write(
        place.path().join("strange.toml"),
        "[environment]\nname = \"pendulum\"\n[lerner]\n",
    )
    .unwrap();
    for (name, text) in [
        (
            "late",
            "[environment]\nname = \"pendulum\"\n[replay]\ncapacity = 1e4\nwarmup = 1.5\n",
        ),
        ("typed", "[environment]\nname = \"pendulum\"\n[run]\nmode = 3\n"),
        ("parameter", "[environment]\nname = \"pendulum\"\n\nstart_sped = 1\n"),
    ] {
        std::fs::write(place.path().join(format!("{name}.toml")), text).unwrap();
    }
    for (arguments, part) in [
        (
            &["pendulums"][..],
            "there is no preset `pendulums`; did you mean pendulum? Otherwise choose pendulum, point-mass-r1",
        ),
        (
            &["walker"],
            "there is no preset `walker`: choose pendulum, point-mass-r1",
        ),
        (&["Pendulum-v1"], "did you mean gym:Pendulum-v1?"),
        (&["missing.toml"], "cannot read missing.toml"),
        (&["broken.toml"], "broken.toml, line 1 (`[run`): "),
        (&["strange.toml"], "strange.toml, line 3: unknown field `lerner`"),
        (&["strange.toml"], "; did you mean `learner`?"),
        (
            &["late.toml"],
            "late.toml, line 5: replay.warmup = 1.5: must be a whole number",
        ),
        (&["typed.toml"], "typed.toml, line 4: run.mode = 3: "),
        (
            &["parameter.toml"],
            "parameter.toml, line 4: environment pendulum: unknown field `start_sped`",
        ),
        (
            &["pendulum", "--set", "ddpg.gama=0.9"],
            "ddpg.gama = 0.9: unknown field `gama`, expected one of",
        ),
        (&["pendulum", "--set", "ddpg.gama=0.9"], "; did you mean `gamma`?"),
        (
            &["pendulum", "--set", "dpg.gamma=0.9"],
            "error: unknown field `dpg`, expected",
        ),
        (
            &["pendulum", "--set", "environment.name=Ant-v5"],
            "did you mean gym:Ant-v5?",
        ),
        (
            &["pendulum", "--set", "ddpg.tau="],
            "error: ddpg.tau = \"\": must be a number, such as 0.5",
        ),
        (
            &["pendulum", "--set", "tau="],
            "--set tau=: must look like SECTION.KEY=VALUE; did you mean ddpg.tau",
        ),
        (
            &["pendulum", "--set", "ddpg.=3"],
            "--set ddpg.=3: must look like SECTION.KEY=VALUE",
        ),
        (
            &["pendulum", "--set", "run.steps=1.5"],
            "error: run.steps = 1.5: must be a whole number, such as 1000",
        ),
        (
            &["pendulum", "--set", "evaluation.keep_policies=yes"],
            "error: evaluation.keep_policies = \"yes\": must be true or false",
        ),
        (
            &["pendulum", "--set", "environment.start_speed=fast"],
            "environment pendulum: start_speed = \"fast\": must be a number, such as 0.5",
        ),
        (
            &["runs/first"],
            "there is no preset, directory or file `runs/first`: choose pendulum, ",
        ),
        (&["pendulum", "--seed", "x"], "x is not a whole number"),
        (&["pendulum", "--steps", "1.5"], "1.5 is not a whole number"),
        (&["pendulum", "--episodes", "1e-3"], "1e-3 is not a whole number"),
        (&["pendulum", "--actors", "1e10"], "1e10 is too large"),
        (
            &["pendulum", "--set", "replay.capacity=1.5k2"],
            "must be a whole number, such as 1000, 1e5 or 30k",
        ),
        (
            &["pendulum", "--set", "run.episodes=1e-3"],
            "run.episodes = 0.001: must be a whole number",
        ),
        (
            &["pendulum", "--set", "replay.capacity=500"],
            "error: replay.capacity = 500: does not go with replay.warmup = 1000 (the default), which must be from 1 to 500",
        ),
        (
            &["pendulum", "--actors", "300"],
            "error: --actors: actors.count = 300: must be from 1 to 256",
        ),
        (
            &["pendulum", "--set", "ddpg.gamma=1.1"],
            "ddpg.gamma = 1.1: must be from 0 to 1",
        ),
        (
            &["pendulum", "--set", "ddpg.tau=0"],
            "error: ddpg.tau = 0: must be above 0 and at most 1",
        ),
        (
            &["pendulum", "--set", "ddpg.actor_learning_rate=0"],
            "error: ddpg.actor_learning_rate = 0: must be above 0 and at most 1",
        ),
        (
            &["pendulum", "--set", "ddpg.critic_learning_rate=0.0"],
            "error: ddpg.critic_learning_rate = 0: must be above 0 and at most 1",
        ),
        (
            &["pendulum", "--set", "ddpg.hidden=[400, 0]"],
            "error: ddpg.hidden[1] = 0: must be from 1 to 8192",
        ),
        (
            &["pendulum", "--set", "ddpg.hidden=[64, 64, 8193]"],
            "error: ddpg.hidden[2] = 8193: must be from 1 to 8192",
        ),
        (
            &["pendulum", "--set", "ddpg.hidden=[]"],
            "ddpg.hidden = []: must be a list of 1 to 8 numbers",
        ),
        (
            &["pendulum", "--set", "ddpg.hidden=[1, 2, 3, 4, 5, 6, 7, 8, 9]"],
            "ddpg.hidden = [1, 2, 3, 4, 5, 6, 7, 8, 9]: must be a list of 1 to 8 numbers",
        ),
        (
            &["pendulum", "--set", "ddpg.hidden=64"],
            "ddpg.hidden = 64: must be a list, such as [64, 48]",
        ),
        (
            &["cart-pole", "--set", "reinforce.baseline_hidden=[]"],
            "reinforce.baseline_hidden = []: must be a list of 1 to 8 numbers",
        ),
        (
            &["pendulum", "--set", "ddpg.activation=sigmoid"],
            "ddpg.activation = \"sigmoid\": unknown variant `sigmoid`, expected `relu` or `tanh`",
        ),
        (
            &["pendulum", "--set", "replay.capacity=1000000001"],
            "error: replay.capacity = 1000000001: must be from 1 to 1000000000",
        ),
        (
            &["pendulum", "--set", "run.identity_format=0"],
            "run.identity_format cannot be set",
        ),
        (&["pendulum", "--set", "environment.start_sped=1"], "start_sped"),
        (&["point-mass-r1", "--set", "environment.friction=-1"], "friction"),
        (
            &["pendulum", "--set", "environment.name=cart-pole"],
            "ddpg cannot control cart-pole",
        ),
        (
            &["pendulum", "--set", "sarsa.alpha=0.1"],
            "sarsa cannot control pendulum: it needs a discrete action space",
        ),
        (
            &["frozen-lake", "--set", "ddpg.tau=1"],
            "ddpg cannot control frozen-lake: the action space is discrete (4 actions)",
        ),
        (
            &["frozen-lake", "--method", "reinforce"],
            "but these are indices of 16 states; choose one of q-learning, sarsa, or another environment",
        ),
        (
            &["pendulum", "--method", "sac", "--set", "td3.tau=0.01"],
            "sac and td3 are two algorithms, and a run has one",
        ),
        (
            &["pendulum", "--method", "dqn"],
            "choose one of ddpg, td3, sac, or another environment",
        ),
        (
            &["frozen-lake", "--set", "replay.n_step=2"],
            "replay.n_step = 2: must be 1: q-learning learns from each step once",
        ),
        (
            &["frozen-lake", "--set", "observation.normalise=true"],
            "[observation] and [reward] are for algorithms that learn from minibatches",
        ),
        (
            &["frozen-lake", "--set", "exploration.sigma=0.1"],
            "[exploration] is the noise of ddpg",
        ),
        (
            &["frozen-lake", "--set", "replay.warmup=64"],
            "replay.warmup = 64: must be 0: q-learning learns from each step once",
        ),
        (
            &["frozen-lake-sarsa", "--set", "run.mode=free"],
            "run.mode = free: must be lockstep: sarsa learns",
        ),
        (
            &["cart-pole", "--set", "run.mode=free"],
            "run.mode = free: must be lockstep: reinforce learns",
        ),
        (&["cart-pole", "--envs", "2"], "actors.envs = 2: must be 1: reinforce"),
        (
            &["cart-pole", "--set", "actors.chunk_steps=8"],
            "actors.chunk_steps = 8: must be 200, the time limit",
        ),
        (&["cart-pole", "--episodes", "0"], "run.episodes = 0: must be from 1"),
        (&["pendulum", "--steps", "0"], "run.steps = 0"),
    ] {
        let output = place.output(&[&["train"], arguments].concat());
        let message = error_line(&output);
        // A file is not part of the command line.
        let expected = if arguments[0].ends_with(".toml") { 1 } else { 2 };
        assert_eq!(output.status.code(), Some(expected), "{arguments:?}: {message}");
        assert!(
            message.starts_with("error: ") && message.contains(part),
            "{arguments:?}: {message}"
        );
    }
    assert!(!place.path().join("runs").exists(), "nothing was created");
}

#[test]
fn a_mistyped_command_is_wrong_usage_with_a_suggestion() {
    let output = Workplace::new().output(&["trian", "pendulum"]);
    assert_eq!(output.status.code(), Some(2));
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.contains("similar") && message.contains("'train'"), "{message}");
}

#[test]
fn counts_are_taken_as_people_write_them_and_a_run_without_learning_is_warned_of() {
    let place = Workplace::new();
    let counted = [
        "pendulum",
        "--steps",
        "0.4k",
        "--run",
        "run",
        "--set",
        "replay.capacity=2e3",
    ];
    assert_eq!(place.train(&counted)["env_steps"], 400);
    let config = std::fs::read_to_string(place.path().join("run/config.toml")).unwrap();
    assert!(
        config.contains("steps = 400\n") && config.contains("capacity = 2000\n"),
        "{config}"
    );

    let output = place.output(&[&["resume", "run", "--steps", "5e2"][..], &["--json"]].concat());
    assert_eq!(support::json(&output)["env_steps"], 500);
    let warned = |warmup: &str| {
        let warmup = format!("replay.warmup={warmup}");
        let output = place.output(&["train", "pendulum", "--steps", "300", "--quiet", "--set", &warmup]);
        assert!(output.status.success());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert!(!warned("200").contains("warning"), "it learns");
    let warning = warned("300");
    assert!(
        warning.starts_with("warning: nothing will be learned") && warning.contains("warm-up of 300 steps"),
        "{warning}"
    );
}

#[test]
fn what_an_algorithm_fixes_need_not_be_in_a_file() {
    let place = Workplace::new();
    let table = "[environment]\nname = \"frozen-lake\"\n[sarsa]\nalpha = 0.5\n";
    std::fs::write(place.path().join("table.toml"), table).unwrap();
    let episodes = "[environment]\nname = \"cart-pole\"\ntime_limit = 50\n[reinforce]\nhidden = [8]\n";
    std::fs::write(place.path().join("episodes.toml"), episodes).unwrap();
    for file in ["table.toml", "episodes.toml"] {
        let output = place.output(&["train", file, "--steps", "200", "--json"]);
        let steps = support::json(&output)["env_steps"].as_u64();
        assert!(steps >= Some(200), "{file}");
    }
}

#[test]
fn an_existing_directory_is_refused_and_left_unchanged() {
    let place = Workplace::new();
    std::fs::create_dir(place.path().join("mine")).unwrap();
    std::fs::write(place.path().join("mine/thesis.txt"), "four months of work").unwrap();
    let message = error_line(&place.output(&["train", "pendulum", "--run", "mine"]));
    assert!(message.contains("mine exists already"), "{message}");
    assert_eq!(std::fs::read_dir(place.path().join("mine")).unwrap().count(), 1);
}

#[test]
fn a_path_that_is_not_a_run_directory_is_refused() {
    let place = Workplace::new();
    for command in ["eval", "plot"] {
        let message = error_line(&place.output(&[command, "nowhere"]));
        assert!(message.contains("nowhere is not a run directory"), "{message}");
        std::fs::create_dir_all(place.path().join("runs/nowhere")).unwrap();
        std::fs::write(place.path().join("runs/nowhere/config.toml"), "").unwrap();
        let message = error_line(&place.output(&[command, "nowhere"]));
        assert!(message.contains("did you mean runs/nowhere?"), "{message}");
        std::fs::remove_dir_all(place.path().join("runs")).unwrap();
    }
}

#[test]
fn a_damaged_policy_is_refused_and_kept() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "400", "--run", "run"]);
    let policy = place.path().join("run/checkpoints/last.policy");
    let mut bytes = std::fs::read(&policy).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&policy, &bytes).unwrap();
    let message = error_line(&place.output(&["eval", "run", "--policy", "last"]));
    assert!(message.contains("last.policy"), "{message}");
    assert_eq!(std::fs::read(&policy).unwrap(), bytes);
}

#[test]
fn a_disk_too_small_for_the_replay_is_reported_and_ends_the_run() {
    let place = Workplace::new();
    // A file size limit of a few megabytes simulates a full disk: the replay needs forty.
    let script = format!(
        "ulimit -f 8000; exec {} train pendulum --run run --json --set run.give_up_seconds=1",
        env!("CARGO_BIN_EXE_shoal")
    );
    let mut shell = std::process::Command::new("sh");
    let output = support::output_of(shell.args(["-c", &script]).current_dir(place.path()));
    let message = error_line(&output);
    assert!(
        message.contains("learner-0") && message.contains("replay.bin"),
        "{message}"
    );
    assert!(!place.path().join("run/replay.bin").exists(), "no partial file is left");
}

#[test]
fn json_is_the_only_line_on_standard_output() {
    let place = Workplace::new();
    let result = place.train(&["point-mass-r3", "--steps", "400", "--run", "run"]);
    assert_eq!(result["env_steps"], 400);
    let evaluated = support::json(&place.output(&["eval", "run", "--policy", "last", "--episodes", "4", "--json"]));
    assert_eq!(evaluated["episodes"], 4);
    assert!(evaluated["final_distance_mean"].is_f64(), "{evaluated}");
    let reached = evaluated["reached_fraction"].as_f64().unwrap();
    assert_eq!(
        (reached * 4.0).fract(),
        0.0,
        "a whole number of the four episodes: {evaluated}"
    );
    let again = support::json(&place.output(&["eval", "run", "--policy", "last", "--episodes", "4", "--json"]));
    assert_eq!(again, evaluated, "every evaluation uses the same starts");
}

#[test]
fn two_runs_at_the_same_time_do_not_affect_each_other() {
    let place = Workplace::new();
    let other = Workplace::new();
    let running = place.start("run", &["--steps", "100000000"]);
    let starts = || running.log().matches("started as process").count();
    let before = starts();
    let output = other.output(&[&["train", "pendulum", "--steps", "300", "--lockstep"], &QUICK[..]].concat());
    assert!(output.status.success());
    until("the first run has saved a checkpoint", || {
        running.run.join("checkpoints/latest.ckpt").exists()
    });
    assert_eq!(starts(), before, "no process of the first run was replaced");
    assert!(running.leftovers().processes().len() >= 6);
}
