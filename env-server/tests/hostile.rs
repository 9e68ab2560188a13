//! Arbitrary parameters give an environment that works, or an error of one line.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

use proptest::prelude::*;
use shoal_base::stream::{Purpose, stream};
use shoal_env_server::environment::{make, names, resolve};
use toml::{Table, Value};

fn any_value() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        any::<i64>().prop_map(Value::Integer),
        (-2..3_i64).prop_map(Value::Integer),
        any::<f64>().prop_map(Value::Float),
        (0.0..2.0_f64).prop_map(Value::Float),
        prop::sample::select(vec![f64::NAN, f64::INFINITY, -0.0, 5e-324, 1e308, 1e-3, 1e3, 1e-6])
            .prop_map(Value::Float),
        prop::sample::select(vec!["r1", "r2", "r3", "r4", "", "a\nb"]).prop_map(|text| Value::String(text.into())),
        any::<bool>().prop_map(Value::Boolean),
        Just(Value::Datetime("07:32:00".parse().unwrap())),
    ];
    leaf.prop_recursive(1, 4, 3, |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..3).prop_map(Value::Array),
            prop::collection::vec(("[a-z]{1,4}", inner), 0..3)
                .prop_map(|entries| Value::Table(entries.into_iter().collect())),
        ]
    })
}

/// A parameter of any environment, or an unknown one.
fn key() -> impl Strategy<Value = String> {
    let known = names().flat_map(|name| resolve(name, &Table::new()).unwrap().into_iter().map(|(key, _)| key));
    let known: Vec<String> = known
        .chain(["reward", "c_force_dot", "c_force"].map(String::from))
        .collect();
    prop_oneof![9 => prop::sample::select(known), 1 => "[a-z_ ]{0,9}"]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 3000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_parameters_make_a_working_environment_or_are_refused_in_one_line(
        name in prop::sample::select(names().collect::<Vec<_>>()),
        given in prop::collection::btree_map(key(), any_value(), 0..4),
        actions in prop::collection::vec(any::<f64>(), 20),
    ) {
        let given: Table = given.into_iter().collect();
        let mut environment = match make(name, &given) {
            Ok(environment) => environment,
            Err(error) => {
                prop_assert!(!error.to_string().contains('\n'), "{}", error);
                prop_assert!(resolve(name, &given).is_err());
                return Ok(());
            }
        };
        let resolved = resolve(name, &given).unwrap();
        prop_assert_eq!(&resolve(name, &resolved).unwrap(), &resolved);
        let spec = environment.spec();
        prop_assert!(spec.time_limit >= 1);
        let mut rng = stream(1, Purpose::Environment, 0, 0);
        environment.reset(&mut rng);
        let mut observation = vec![f32::NAN; spec.observation.width()];
        for action in actions.chunks_exact(spec.action.width()) {
            let step = environment.step(action, &mut rng);
            environment.observe(&mut observation);
            prop_assert!(step.reward.is_finite() && observation.iter().all(|x| x.is_finite()), "{:?}", observation);
        }
    }

    #[test]
    fn any_name_is_known_or_refused(
        name in prop_oneof![4 => ".{0,20}", 1 => prop::sample::select(names().map(String::from).collect::<Vec<_>>())],
    ) {
        prop_assert_eq!(make(&name, &Table::new()).is_ok(), names().any(|known| known == name));
    }
}
