use rten::{Model, Value};
use shoal_common::config::Config;
use shoal_common::policy::{Policy, PolicyLayout};
use shoal_common::policy_file::PolicyFile;

use super::super::tests_support::{policies, some_observations, with_observed_indices, with_starts};
use super::*;

/// The output that an independent ONNX runtime computes from the observations.
fn computed(model: &Model, config: &Config, observations: &[f32], output: &str) -> Value {
    let is_table = model.find_node("state").is_some();
    let input = model.node_id(if is_table { "state" } else { "observation" }).unwrap();
    let width = config.spec.observation.width();
    let batch = observations.len() / width;
    let value = if is_table {
        // This runtime represents 64-bit indices with 32 bits.
        let states = observations.iter().map(|state| *state as i32).collect();
        Value::from_shape(&[batch], states).unwrap()
    } else {
        Value::from_shape(&[batch, width], observations.to_vec()).unwrap()
    };
    let output = model.node_id(output).unwrap();
    let mut outputs = model.run(vec![(input, value.into())], &[output], None).unwrap();
    outputs.remove(0)
}

fn computed_floats(model: &Model, config: &Config, observations: &[f32], output: &str) -> ([usize; 2], Vec<f32>) {
    computed(model, config, observations, output).into_shape_vec().unwrap()
}

fn assert_close(found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-5, "{found} for {expected}");
    }
}

fn scores(config: &Config, policy: &PolicyFile, observations: &[f32], batch: usize) -> Vec<f32> {
    let Policy::Scored(mut scores) = config.policy(batch).unwrap() else {
        panic!("this policy has no scores");
    };
    scores
        .compute(&policy.parameters, observations)
        .flatten()
        .copied()
        .collect()
}

#[test]
fn another_runtime_computes_the_same_outputs_for_any_batch_size() {
    for (config, policy) in policies() {
        let bytes = PortablePolicy::new(&config, &policy, "best").unwrap().to_onnx();
        let model = Model::load(bytes).unwrap();
        let layout = config.policy_layout().unwrap();
        for batch in [1, 2, 33] {
            let observations = some_observations(&config, batch);
            let mut actions = vec![0.0; batch * config.spec.action.width()];
            let mut ours = config.policy(batch).unwrap();
            ours.act(&policy.parameters, &observations, &mut actions);
            if let PolicyLayout::Deterministic(_) | PolicyLayout::Gaussian(_) = layout {
                let (shape, found) = computed_floats(&model, &config, &observations, "action");
                assert_eq!(shape, [batch, config.spec.action.width()]);
                assert_close(&found, &actions);
                continue;
            }
            let chosen = computed(&model, &config, &observations, "action");
            let (shape, chosen) = chosen.into_shape_vec::<i32, 1>().unwrap();
            assert_eq!(shape, [batch]);
            assert_eq!(chosen, actions.iter().map(|a| *a as i32).collect::<Vec<_>>());
            let scores = scores(&config, &policy, &observations, batch);
            let PolicyLayout::Softmax(network) = layout else {
                assert_close(
                    &computed_floats(&model, &config, &observations, "action_values").1,
                    &scores,
                );
                continue;
            };
            assert_close(&computed_floats(&model, &config, &observations, "logits").1, &scores);
            let probabilities = scores.chunks_exact(network.outputs()).flat_map(|scores| {
                let sum: f32 = scores.iter().map(|score| score.exp()).sum();
                scores.iter().map(move |score| score.exp() / sum)
            });
            let expected: Vec<f32> = probabilities.collect();
            assert_close(
                &computed_floats(&model, &config, &observations, "probabilities").1,
                &expected,
            );
        }
    }
}

#[test]
fn states_and_actions_have_the_environments_own_numbers() {
    let (config, policy) = with_starts();
    let bytes = PortablePolicy::new(&config, &policy, "best").unwrap().to_onnx();
    let model = Model::load(bytes).unwrap();
    let indices = some_observations(&config, 33);
    let states: Vec<f32> = indices.iter().map(|index| index + 1.0).collect();
    let mut expected = vec![0.0; 33];
    let mut ours = config.policy(33).unwrap();
    ours.act(&policy.parameters, &indices, &mut expected);
    let chosen = computed(&model, &config, &states, "action");
    let (_, chosen) = chosen.into_shape_vec::<i32, 1>().unwrap();
    assert_eq!(chosen, expected.iter().map(|a| *a as i32 + 5).collect::<Vec<_>>());
}

#[test]
fn a_network_sees_indices_that_are_counted_from_0() {
    let (config, policy) = with_observed_indices();
    let bytes = PortablePolicy::new(&config, &policy, "best").unwrap().to_onnx();
    let model = Model::load(bytes).unwrap();
    let indices = some_observations(&config, 33);
    let observed: Vec<f32> = indices.iter().map(|index| index + 5.0).collect();
    let mut expected = vec![0.0; 33];
    let mut ours = config.policy(33).unwrap();
    ours.act(&policy.parameters, &indices, &mut expected);
    assert_close(&computed_floats(&model, &config, &observed, "action").1, &expected);
}

#[test]
fn actions_of_the_model_stay_inside_the_bounds() {
    let (mut config, mut policy) = policies().remove(0);
    config.spec.action = shoal_common::space::Space::boxed(&[(0.05, 0.45)]);
    // The last bias: tanh is −1, then 1.
    for (bias, bound) in [(-1000.0, 0.05), (1000.0, 0.45)] {
        *policy.parameters.last_mut().unwrap() = bias;
        let bytes = PortablePolicy::new(&config, &policy, "best").unwrap().to_onnx();
        let model = Model::load(bytes).unwrap();
        let observations = some_observations(&config, 4);
        let (_, actions) = computed_floats(&model, &config, &observations, "action");
        assert!(
            actions.iter().all(|action| (0.05..=0.45).contains(action)),
            "{actions:?} near {bound}"
        );
    }
}

/// Checks the attribute, not the result: the runtime of these tests ignores the attribute and returns the last of equal
/// scores.
#[test]
fn the_model_requests_the_first_of_equal_scores() {
    let (config, policy) = policies().pop().unwrap();
    let bytes = PortablePolicy::new(&config, &policy, "last").unwrap().to_onnx();
    let graph = super::message::Model::decode(bytes.as_slice()).unwrap().graph.unwrap();
    let chosen = graph.node.iter().find(|node| node.op_type == "ArgMax").unwrap();
    let last = chosen
        .attribute
        .iter()
        .find(|attribute| attribute.name == "select_last_index")
        .unwrap();
    assert_eq!(last.i, Some(0));
}

#[test]
fn the_model_contains_its_origin() {
    let (config, policy) = policies().remove(0);
    let bytes = PortablePolicy::new(&config, &policy, "best").unwrap().to_onnx();
    let model = super::message::Model::decode(bytes.as_slice()).unwrap();
    let value = |key: &str| {
        model
            .metadata_props
            .iter()
            .find(|entry| entry.key == key)
            .unwrap()
            .value
            .clone()
    };
    assert_eq!(value("environment"), "pendulum");
    assert_eq!(value("action_low"), "[-2.0]");
    assert_eq!(value("evaluation_return"), "-150.5");
    assert_eq!(value("policy_version"), "7");
}
