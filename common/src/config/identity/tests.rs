use super::*;
use shoal_policy::network::Activation;

/// Runs of commit 2d50610 from `tests/data/2d50610`: name, fingerprint in the replay's header, and configuration.
const OLD: [(&str, u64, &str); 4] = [
    (
        "free-finished",
        0x06b4_e289_6b02_80a0,
        r#"
        [run]
        id = "4279ab2b"
        mode = "free"
        [environment]
        name = "point-mass"
        amplitude = 2.0
        c_d = 0.7071067811865476
        c_force = 0.03
        c_theta_dot = 0.0015
        friction = 0.01
        goal_radius = 0.05
        gravity = 9.81
        mass = 1.0
        reward = "r3"
        stiction_ratio = 1.2
        time_limit = 200
        variance = 0.1
        [spec]
        time_limit = 200
        observation.box = { low = [-4.0, -4.0, -1.0, -1.0, -10.0, -inf], high = [4.0, 4.0, 1.0, 1.0, 10.0, inf] }
        action.box = { low = [-3.1415927, 0.0], high = [3.1415927, 2.0] }
        [ddpg]
        hidden = [8, 8]
        batch = 8
        "#,
    ),
    (
        "gym-stopped",
        0xe2ed_38f1_d4e5_c5d2,
        r#"
        [run]
        id = "48fee774"
        mode = "free"
        [environment]
        name = "gym:Pendulum-v1"
        server = ["python3", "-m", "shoal_gym"]
        [spec]
        time_limit = 200
        observation.box = { low = [-1.0, -1.0, -8.0], high = [1.0, 1.0, 8.0] }
        action.box = { low = [-2.0], high = [2.0] }
        [exploration]
        theta = 1.0
        sigma = 0.1
        warmup = "uniform"
        [ddpg]
        hidden = [8, 8]
        gamma = 0.98
        tau = 0.005
        actor_learning_rate = 0.001
        critic_learning_rate = 0.001
        batch = 8
        "#,
    ),
    (
        "gym-finished",
        0xce67_9e75_942a_a071,
        r#"
        [run]
        id = "19556cd8"
        mode = "lockstep"
        [environment]
        name = "gym:CartPole-v1"
        server = ["python3", "-m", "shoal_gym"]
        [spec]
        time_limit = 500
        observation.box = { low = [-4.8, -inf, -0.41887903, -inf], high = [4.8, inf, 0.41887903, inf] }
        action.discrete = { n = 2 }
        [actors]
        chunk_steps = 500
        [reinforce]
        hidden = [8, 8]
        gamma = 0.99
        learning_rate = 0.001
        [replay]
        warmup = 0
        "#,
    ),
    (
        "lockstep-finished",
        0x4c53_85a6_6c73_1eeb,
        r#"
        [run]
        id = "f4500cb1"
        mode = "lockstep"
        [environment]
        name = "frozen-lake"
        time_limit = 100
        [spec]
        time_limit = 100
        observation.discrete = { n = 16 }
        action.discrete = { n = 4 }
        [q-learning]
        epsilon = 0.9
        [replay]
        warmup = 0
        "#,
    ),
];

fn config(text: &str) -> Config {
    Config::from_table(text.parse().unwrap(), "test").unwrap()
}

#[test]
fn a_run_without_a_format_number_keeps_its_original_fingerprint() {
    for (name, fingerprint, text) in OLD {
        let config = config(text);
        assert_eq!(config.fingerprint(), fingerprint, "{name}: {}", config.identity());
        assert!(
            !config.to_toml().unwrap().contains("identity_format"),
            "{name}: a format number was added"
        );
    }
}

/// `tests/data` has no run of SARSA.
#[test]
fn the_unnumbered_text_of_sarsa_is_unchanged() {
    let sarsa = config(&OLD[3].2.replace("q-learning", "sarsa"));
    assert_eq!(
        sarsa.identity(),
        "f4500cb1 1 Lockstep frozen-lake {\"time_limit\": Integer(100)} \
         Sarsa(Tabular { gamma: 0.999, alpha: 0.03, epsilon: 0.9 })"
    );
}

fn numbered(text: &str) -> Config {
    config(&text.replace("[run]", "[run]\nidentity_format = 1"))
}

#[test]
fn the_text_of_format_1_is_unchanged() {
    let texts = OLD.map(|(_, _, text)| numbered(text).identity());
    assert_eq!(
        texts[0],
        "shoal run, identity 1\n\
         environment: \"point-mass\"\n\
         parameter \"amplitude\": 2\n\
         parameter \"c_d\": 0.7071067811865476\n\
         parameter \"c_force\": 0.03\n\
         parameter \"c_theta_dot\": 0.0015\n\
         parameter \"friction\": 0.01\n\
         parameter \"goal_radius\": 0.05\n\
         parameter \"gravity\": 9.81\n\
         parameter \"mass\": 1\n\
         parameter \"reward\": \"r3\"\n\
         parameter \"stiction_ratio\": 1.2\n\
         parameter \"time_limit\": 200\n\
         parameter \"variance\": 0.1\n\
         observation: box -4 .. 4 -4 .. 4 -1 .. 1 -1 .. 1 -10 .. 10 -inf .. inf\n\
         action: box -3.1415927 .. 3.1415927 0 .. 2\n\
         time limit: 200\n\
         algorithm: ddpg\n\
         learned actor: network 6 8 8 2\n\
         learned critic: network 6 8 8 1 late 2\n\
         gamma: 0.99\n\
         seed: 1\n\
         mode: free\n\
         row: s 6, a 2, r 1, discount 1, s' 6, last 1\n"
    );
    assert!(
        texts[3].contains("\nalgorithm: q-learning\nlearned action-values: table 16 4\n"),
        "{}",
        texts[3]
    );
    assert!(texts[2].contains("\nlearned policy: network 4 8 8 2\n"), "{}", texts[2]);
}

#[test]
fn format_1_describes_any_list_of_layers_and_tanh() {
    let network = |settings: &str| {
        let text = OLD[0].2.replace("hidden = [8, 8]", settings);
        let identity = numbered(&text).identity();
        let lines = identity.lines().filter(|line| line.starts_with("learned "));
        lines.map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(
        network("hidden = [8]"),
        ["learned actor: network 6 8 2", "learned critic: network 6 8 1 late 2"]
    );
    assert_eq!(
        network("hidden = [8, 7, 6]\nactivation = \"tanh\""),
        [
            "learned actor: network 6 8 7 6 2 tanh",
            "learned critic: network 6 8 7 6 1 late 2 tanh"
        ]
    );
    assert_eq!(
        network("hidden = [8, 8]"),
        network("hidden = [8, 8]\nactivation = \"relu\"")
    );
}

/// A handwritten configuration has no format number. It gets the numbered text if the old one cannot describe its
/// networks.
#[test]
fn new_kinds_of_networks_have_no_unnumbered_text() {
    for settings in ["hidden = [8]", "hidden = [8, 8]\nactivation = \"tanh\""] {
        for old in [OLD[0].2, OLD[2].2] {
            let config = config(&old.replace("hidden = [8, 8]", settings));
            assert!(config.identity().starts_with("shoal run, identity 1\n"), "{settings}");
        }
    }
}

#[test]
fn format_1_changes_only_with_what_rows_and_weights_depend_on() {
    let base = numbered(OLD[0].2);
    type Change = fn(&mut Config);
    fn ddpg(config: &mut Config) -> &mut crate::algorithms::DdpgConfig {
        let crate::algorithms::AlgorithmConfig::Ddpg(ddpg) = &mut config.algorithm else {
            panic!("the base configuration is for ddpg");
        };
        ddpg
    }
    let same: [(&str, Change); 14] = [
        ("run.id", |c| c.run.id = "another".into()),
        ("run.steps", |c| c.run.steps += 1),
        ("run.episodes", |c| c.run.episodes = Some(5)),
        ("actors.count", |c| c.actors.count += 1),
        ("actors.chunk_steps", |c| c.actors.chunk_steps += 1),
        ("ddpg.tau", |c| ddpg(c).tau *= 2.0),
        ("ddpg.actor_learning_rate", |c| ddpg(c).actor_learning_rate *= 2.0),
        ("ddpg.critic_learning_rate", |c| ddpg(c).critic_learning_rate *= 2.0),
        ("ddpg.batch", |c| ddpg(c).batch += 1),
        ("exploration.sigma", |c| ddpg(c).exploration.sigma *= 2.0),
        ("exploration.warmup", |c| {
            ddpg(c).exploration.warmup = crate::algorithms::Warmup::Uniform
        }),
        ("evaluation.every", |c| c.evaluation.every += 1),
        ("checkpoint.every_updates", |c| c.checkpoint.every_updates += 1),
        ("environment.server", |c| c.environment.server = vec!["other".into()]),
    ];
    for (key, change) in same {
        let mut changed = base.clone();
        change(&mut changed);
        assert_ne!(changed, base, "{key}");
        assert_eq!(changed.identity(), base.identity(), "{key}");
    }
    let other: [(&str, Change); 14] = [
        ("environment.name", |c| c.environment.name.push('s')),
        ("a parameter's value", |c| {
            c.environment.parameters.insert("mass".into(), 2.0.into());
        }),
        ("an additional parameter", |c| {
            c.environment.parameters.insert("wind".into(), 2.0.into());
        }),
        ("spec.observation", |c| {
            c.spec.observation = Space::boxed(&[(-4.0, 4.5); 6])
        }),
        ("spec.action", |c| c.spec.action = Space::boxed(&[(-4.0, 4.5); 2])),
        ("the rows' widths", |c| c.spec.action = Space::boxed(&[(-4.0, 4.5); 3])),
        ("spec.time_limit", |c| c.spec.time_limit += 1),
        ("the algorithm", |c| {
            c.algorithm = crate::algorithms::AlgorithmConfig::Sarsa(Default::default())
        }),
        ("ddpg.hidden", |c| ddpg(c).hidden[1] += 1),
        ("an additional hidden layer", |c| ddpg(c).hidden = [8, 8, 8].into()),
        ("ddpg.activation", |c| ddpg(c).activation = Activation::Tanh),
        ("ddpg.gamma", |c| ddpg(c).gamma = 0.98),
        ("run.seed", |c| c.run.seed += 1),
        ("run.mode", |c| c.run.mode = Mode::Lockstep),
    ];
    for (key, change) in other {
        let mut changed = base.clone();
        change(&mut changed);
        assert_ne!(changed.identity(), base.identity(), "{key}");
        assert_ne!(changed.fingerprint(), base.fingerprint(), "{key}");
    }
}

#[test]
fn an_unknown_format_is_refused_in_one_line() {
    let text = OLD[0].2.replace("[run]", "[run]\nidentity_format = 2");
    let line = Config::from_table(text.parse().unwrap(), "config.toml")
        .unwrap_err()
        .to_string();
    assert!(
        line.contains("run.identity_format = 2: this program") && !line.contains('\n'),
        "{line}"
    );
}

#[test]
fn text_and_numbers_differ_and_the_order_of_keys_does_not_matter() {
    let value = |text: &str| written(&text.parse::<Table>().unwrap()["x"]);
    assert_eq!(value("x = 1"), value("x = 1.0"));
    assert_ne!(value("x = 1"), value("x = \"1\""));
    assert_eq!(
        value("x = { a = 1, b = [true, \"t\"] }"),
        "{\"a\": 1, \"b\": [true, \"t\"]}"
    );
    assert_eq!(value("x = { b = 1, a = 2 }"), value("x = { a = 2, b = 1 }"));
}
