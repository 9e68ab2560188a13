//! Invalid configurations.

use proptest::prelude::*;
use shoal_common::commit::ReplayLayout;
use shoal_common::config::{ActorsConfig, Config};
use toml::{Table, Value};

const WHOLE: &str = r#"
    [run]
    id = "1f"
    seed = 1
    mode = "free"
    steps = 1000
    [environment]
    name = "pendulum"
    start_speed = 1.0
    [spec]
    time_limit = 200
    observation.box = { low = [-1.0, -1.0, -8.0], high = [1.0, 1.0, 8.0] }
    action.box = { low = [-2.0], high = [2.0] }
"#;

fn whole() -> Table {
    let read = Config::from_table(WHOLE.parse().unwrap(), "test").unwrap();
    read.to_toml().unwrap().parse().unwrap()
}

/// The paths of all keys below `value`.
fn keys(value: &Value, path: &[String]) -> Vec<Vec<String>> {
    let children: Vec<(String, &Value)> = match value {
        Value::Table(table) => table.iter().map(|(key, value)| (key.clone(), value)).collect(),
        Value::Array(values) => values
            .iter()
            .enumerate()
            .map(|(i, value)| (i.to_string(), value))
            .collect(),
        _ => vec![],
    };
    let below = children.into_iter().flat_map(|(key, value)| {
        let path = [path, &[key]].concat();
        [vec![path.clone()], keys(value, &path)].concat()
    });
    below.collect()
}

fn replace(value: &mut Value, path: &[String], new: Value) {
    match (path, value) {
        ([], value) => *value = new,
        ([key, rest @ ..], Value::Table(table)) => replace(&mut table[key.as_str()], rest, new),
        ([key, rest @ ..], Value::Array(values)) => replace(&mut values[key.parse::<usize>().unwrap()], rest, new),
        _ => unreachable!("the path is one of the value's"),
    }
}

fn anything() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        any::<i64>().prop_map(Value::Integer),
        (0..63_u32, -1..2_i64).prop_map(|(bit, off)| Value::Integer((1 << bit) + off)),
        prop::sample::select(vec![4_096, 8_192, 65_536, 256, 64, 1_000_000_000, 1_000_000_000_000])
            .prop_map(Value::Integer),
        any::<f64>().prop_map(Value::Float),
        prop::sample::select(vec![f64::NAN, f64::INFINITY, -f64::INFINITY, -0.0, 5e-324, 1e308]).prop_map(Value::Float),
        ".{0,40}".prop_map(Value::String),
        any::<bool>().prop_map(Value::Boolean),
        Just(Value::Datetime("1979-05-27T07:32:00Z".parse().unwrap())),
    ];
    leaf.prop_recursive(2, 8, 4, |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..4).prop_map(Value::Array),
            prop::collection::vec(("[a-z_]{1,8}", inner), 0..4)
                .prop_map(|entries| Value::Table(entries.into_iter().collect())),
        ]
    })
}

/// Asserts that everything computed from an accepted configuration can be computed.
fn assert_usable(config: &Config) {
    let row = config.row_layout();
    let chunk = config.chunk_rows().checked_mul(row.width()).unwrap();
    assert!(
        chunk > 0
            && chunk
                .checked_mul(size_of::<f32>() * 4 * config.actors.window as usize)
                .is_some()
    );
    // An upper bound: the sampling window, all rows of the run, and a few rounds.
    let round = config.chunk_rows() as u64 * u64::from(config.actors.max);
    let ring = config.replay.capacity + config.run.steps + 4 * round;
    let layout = ReplayLayout {
        row,
        ring,
        actors: config.actors.max as usize,
        actor_snapshot_words: 0,
        fingerprint: config.fingerprint(),
    };
    assert!(layout.offsets().is_some());
    if let Some(ddpg) = config.algorithm.ddpg() {
        let batch = ddpg.batch.max(config.actors.envs as usize);
        let network = ddpg.networks(&config.spec).critic;
        assert!(network.parameters().checked_mul(size_of::<f32>() * batch).is_some());
    }
    assert!(config.evaluation_server() <= ActorsConfig::MAX_ACTORS && (1..=64).contains(&config.evaluation_envs()));
    assert_eq!(config.evaluation.period(0), 0);
    assert!(std::time::Duration::try_from_secs_f64(config.checkpoint.every_seconds).is_ok());
    let written = config.to_toml().unwrap().parse().unwrap();
    let read = Config::from_table(written, "the written configuration").unwrap();
    assert_eq!(read.fingerprint(), config.fingerprint());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 3000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_value_of_a_key_is_accepted_or_refused_in_one_line(which in any::<prop::sample::Index>(), new in anything()) {
        let mut table = Value::Table(whole());
        let keys = keys(&table, &[]);
        replace(&mut table, which.get::<Vec<String>>(&keys), new);
        let Value::Table(table) = table else { unreachable!() };
        match Config::from_table(table, "test") {
            Ok(config) => assert_usable(&config),
            Err(error) => prop_assert!(!error.to_string().contains('\n'), "{}", error),
        }
    }

    #[test]
    fn random_text_is_refused(text in ".{0,200}", lines in prop::collection::vec("\\[?\\[?[a-z\".]{0,6}\\]? ?=? ?[-\\[{\"0-9a-z_.]{0,20}\n", 0..10)) {
        for text in [text, lines.concat()] {
            if let Ok(table) = text.parse::<Table>() {
                prop_assert!(Config::from_table(table, "test").is_err());
            }
        }
    }
}

fn at<'a>(value: &'a Value, path: &[String]) -> &'a Value {
    path.iter().fold(value, |value, key| {
        value
            .get(key.as_str())
            .or_else(|| value.get(key.parse::<usize>().ok()?))
            .unwrap()
    })
}

fn accepted(value: &Value) -> Option<Config> {
    Config::from_table(value.as_table().unwrap().clone(), "test").ok()
}

/// The limits are found by bisection, so that raising a limit too far fails here.
#[test]
fn the_least_and_the_greatest_allowed_numbers_do_not_overflow() {
    let mut table = Value::Table(whole());
    let integers: Vec<_> = keys(&table, &[])
        .into_iter()
        .filter(|path| at(&table, path).is_integer())
        .collect();
    // Twice, because some limits are the values of other keys.
    for path in integers.iter().chain(&integers) {
        for furthest in [-1, i64::MAX] {
            let (mut good, mut bad) = (at(&table, path).as_integer().unwrap(), furthest);
            while good.abs_diff(bad) > 1 {
                let middle = good + (bad - good) / 2;
                replace(&mut table, path, Value::Integer(middle));
                *(if accepted(&table).is_some() {
                    &mut good
                } else {
                    &mut bad
                }) = middle;
            }
            replace(&mut table, path, Value::Integer(bad));
            if accepted(&table).is_none() {
                replace(&mut table, path, Value::Integer(good));
            }
            assert_usable(&accepted(&table).unwrap());
        }
    }
    for space in ["observation", "action"] {
        let bounds = ["low", "high"].map(|bound| ["spec", space, "box", bound].map(String::from));
        let mut width = 1;
        while accepted(&table).is_some() && width < 1 << 20 {
            assert_usable(&accepted(&table).unwrap());
            width *= 2;
            for (bound, end) in bounds.iter().zip([-1.0, 1.0]) {
                replace(&mut table, bound, Value::Array(vec![Value::Float(end); width]));
            }
        }
        for (bound, end) in bounds.iter().zip([-1.0, 1.0]) {
            replace(&mut table, bound, Value::Array(vec![Value::Float(end); width / 2]));
        }
    }
    let largest = accepted(&table).unwrap();
    assert_eq!(
        (
            largest.actors.max,
            largest.actors.count,
            largest.row_layout().action_width()
        ),
        (ActorsConfig::MAX_ACTORS, ActorsConfig::MAX_ON_A_HOST, 4096)
    );
    assert_usable(&largest);
}

#[test]
fn an_id_that_could_match_other_files_is_refused() {
    for id in [
        "",
        ".",
        "..",
        "../..",
        "a/b",
        "/home",
        "a b",
        "a_b",
        "ä",
        "0\0",
        &"a".repeat(33),
    ] {
        let mut table = whole();
        table["run"]["id"] = id.into();
        let line = Config::from_table(table, "test").unwrap_err().to_string();
        assert!(line.starts_with("run.id = \"") && !line.contains('\n'), "{line}");
    }
}

#[test]
fn a_space_with_an_invalid_size_is_refused() {
    for (space, bounds) in [
        ("observation", "box = { low = [], high = [] }"),
        ("observation", "box = { low = [0.0, 0.0], high = [1.0] }"),
        ("action", "box = { low = [0.0], high = [1.0, 1.0] }"),
        ("observation", "discrete = { n = 0 }"),
    ] {
        let mut table = whole();
        table["spec"][space] = Value::Table(bounds.parse().unwrap());
        let line = Config::from_table(table, "test").unwrap_err().to_string();
        assert!(line.starts_with(&format!("spec.{space} = ")), "{line}");
    }
}
