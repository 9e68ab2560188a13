//! A policy as a safetensors file: tensors with the names of a PyTorch module's `state_dict`, and metadata.

use safetensors::Dtype;
use safetensors::tensor::TensorView;

use super::{ExportedNetwork, PolicyFunction, PortablePolicy};

/// The bytes of the file. A network has `layers.<i>.weight` (outputs × inputs, row-major) and `layers.<i>.bias` for
/// each layer i from 0, the output layer last. If observations are normalised, `observation.mean` and
/// `observation.factor` say how: x ← (x − mean) · factor, clipped to ±`observation_clip` of the metadata. A table has
/// `action_values` (states × actions). The metadata describes the rest.
pub(super) fn file(policy: &PortablePolicy) -> anyhow::Result<Vec<u8>> {
    let tensors = match &policy.body {
        PolicyFunction::Actions { network, .. }
        | PolicyFunction::Probabilities { network }
        | PolicyFunction::Values { network } => of_network(network),
        PolicyFunction::Table {
            states,
            actions,
            values,
        } => vec![("action_values".into(), vec![*states, *actions], values.as_slice())],
    };
    let views: Result<Vec<_>, _> = tensors
        .iter()
        .map(|(name, shape, numbers)| {
            let view = TensorView::new(Dtype::F32, shape.clone(), bytemuck::cast_slice(numbers));
            view.map(|view| (name.as_str(), view))
        })
        .collect();
    let metadata = policy.metadata.clone().into_iter().collect();
    Ok(safetensors::serialize(views?, Some(metadata))?)
}

type Named<'a> = (String, Vec<usize>, &'a [f32]);

fn of_network(network: &ExportedNetwork) -> Vec<Named<'_>> {
    let normalisation = network.normalisation.iter().flat_map(|(mean, factor)| {
        [("observation.mean", mean), ("observation.factor", factor)]
            .map(|(name, numbers)| (name.to_owned(), vec![numbers.len()], numbers.as_slice()))
    });
    let each = network.layers.iter().enumerate().flat_map(|(number, layer)| {
        let outputs = layer.biases.len();
        [
            (
                format!("layers.{number}.weight"),
                vec![outputs, layer.inputs],
                layer.weights.as_slice(),
            ),
            (format!("layers.{number}.bias"), vec![outputs], layer.biases.as_slice()),
        ]
    });
    normalisation.chain(each).collect()
}

#[cfg(test)]
mod tests {
    use safetensors::SafeTensors;

    use super::super::tests_support::{policies, some_observations};
    use super::*;

    fn numbers(tensors: &SafeTensors<'_>, name: &str) -> (Vec<usize>, Vec<f32>) {
        let tensor = tensors.tensor(name).unwrap();
        let numbers = tensor
            .data()
            .as_chunks::<4>()
            .0
            .iter()
            .map(|bytes| f32::from_le_bytes(*bytes));
        (tensor.shape().to_vec(), numbers.collect())
    }

    /// y = W x + b as in `torch.nn.Linear`, with the tensors of the file.
    fn linear(tensors: &SafeTensors<'_>, layer: usize, x: &[f32]) -> Vec<f32> {
        let (shape, weights) = numbers(tensors, &format!("layers.{layer}.weight"));
        let (_, biases) = numbers(tensors, &format!("layers.{layer}.bias"));
        assert_eq!(shape, [biases.len(), x.len()]);
        let rows = weights.chunks_exact(x.len()).zip(&biases);
        rows.map(|(row, bias)| row.iter().zip(x).map(|(w, x)| w * x).sum::<f32>() + bias)
            .collect()
    }

    #[test]
    fn tensors_and_metadata_suffice_to_compute_the_same_actions() {
        for (config, policy) in policies() {
            let bytes = PortablePolicy::new(&config, &policy, "best")
                .unwrap()
                .to_safetensors()
                .unwrap();
            let tensors = SafeTensors::deserialize(&bytes).unwrap();
            let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
            let metadata = header.metadata().clone().unwrap();
            assert_eq!(metadata["environment"], config.environment.name);
            let observations = some_observations(&config, 5);
            let mut ours = config.policy(1).unwrap();
            let width = config.spec.observation.width();
            for observation in observations.chunks_exact(width) {
                let mut expected = vec![0.0; config.spec.action.width()];
                ours.act(&policy.parameters, observation, &mut expected);
                if !metadata.contains_key("hidden_activation") {
                    let (shape, values) = numbers(&tensors, "action_values");
                    let row = &values[observation[0] as usize * shape[1]..][..shape[1]];
                    assert_eq!(shoal_common::policy::argmax(row) as f32, expected[0]);
                    continue;
                }
                let mut x = observation.to_vec();
                if let Some(clip) = metadata.get("observation_clip") {
                    let clip: f32 = clip.parse().unwrap();
                    let [mean, factor] =
                        ["observation.mean", "observation.factor"].map(|name| numbers(&tensors, name).1);
                    for (x, (mean, factor)) in x.iter_mut().zip(mean.into_iter().zip(factor)) {
                        *x = ((*x - mean) * factor).clamp(-clip, clip);
                    }
                }
                let activation: fn(f32) -> f32 = match metadata["hidden_activation"].as_str() {
                    "relu" => |z| z.max(0.0),
                    "tanh" => f32::tanh,
                    other => panic!("unknown activation {other}"),
                };
                let layers = tensors.names().iter().filter(|name| name.ends_with(".weight")).count();
                let last = layers - 1;
                for layer in 0..last {
                    x = linear(&tensors, layer, &x).into_iter().map(activation).collect();
                }
                let z = linear(&tensors, last, &x);
                if ["reinforce", "dqn"].contains(&config.algorithm.name()) {
                    assert_eq!(shoal_common::policy::argmax(&z) as f32, expected[0]);
                    continue;
                }
                let bound = |name: &str| -> Vec<f32> { serde_json::from_str(&metadata[name]).unwrap() };
                let (low, high) = (bound("action_low"), bound("action_high"));
                for (i, z) in z.iter().enumerate() {
                    let action = low[i] + (high[i] - low[i]) * (z.tanh() + 1.0) / 2.0;
                    assert!((action - expected[i]).abs() < 1e-5, "{action} for {}", expected[i]);
                }
            }
        }
    }
}
