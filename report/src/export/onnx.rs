//! A policy as an ONNX model. The first dimension of its inputs and outputs is the batch size, which is not fixed.

mod message;

use message::{
    Attribute, Dimension, FLOAT, Graph, INT, INT64, Metadata, Model, Node, Operators, Shape, Tensor, TensorType, Type,
    ValueInfo,
};
use prost::Message;

use super::{Activation, ExportedNetwork, OBSERVATION_CLIP, PolicyFunction, PortablePolicy};

/// The versions of the file format and of the operator set. They are old enough for every runtime, and new enough for
/// `ArgMax` to have `select_last_index`, which decides between equal values.
const IR_VERSION: i64 = 8;
const OPERATOR_SET_VERSION: i64 = 13;

/// The name of the first dimension.
const BATCH: &str = "batch";

/// The bytes of the model.
///
/// - DDPG, TD3 and SAC: `observation` (batch × n) to `action` (batch × m, in the environment's units).
/// - REINFORCE: `observation` to `logits`, `probabilities` (batch × actions) and `action` (batch, the most probable
///   one).
/// - DQN: `observation` to `action_values` (batch × actions) and `action` (batch, the one of highest value).
/// - Tables: `state` (batch, 64-bit) to `action_values` (batch × actions) and `action` (batch, the one of highest
///   value).
///
/// If the policy normalises observations, the model does so. Discrete states and actions have the environment's own
/// numbers, which begin at the `start` of their space.
pub(super) fn model(policy: &PortablePolicy) -> Vec<u8> {
    let mut graph = Graph {
        name: "policy".into(),
        ..Graph::default()
    };
    match &policy.body {
        PolicyFunction::Actions { network, range } => {
            let elements = 0..range.width();
            let half = range.half().to_vec();
            let centre: Vec<f32> = elements.map(|element| range.action(element, 0.0)).collect();
            let outputs = half.len();
            graph.add_input("observation", FLOAT, &[network.layers[0].inputs]);
            graph.add_network(network, policy.starts.observation, "z");
            graph.add_node("Tanh", &["z"], "tanh", vec![]);
            graph.add_tensor("action_half_width", &[outputs], &half);
            graph.add_node("Mul", &["tanh", "action_half_width"], "scaled", vec![]);
            graph.add_tensor("action_centre", &[outputs], &centre);
            graph.add_node("Add", &["scaled", "action_centre"], "unclipped", vec![]);
            // Rounding can leave the bounds.
            graph.add_tensor("action_low", &[outputs], range.low());
            graph.add_node("Max", &["unclipped", "action_low"], "bounded_below", vec![]);
            graph.add_tensor("action_high", &[outputs], range.high());
            graph.add_node("Min", &["bounded_below", "action_high"], "action", vec![]);
            graph.add_output("action", FLOAT, &[outputs]);
        }
        PolicyFunction::Probabilities { network } => {
            graph.add_input("observation", FLOAT, &[network.layers[0].inputs]);
            graph.add_network(network, policy.starts.observation, "logits");
            graph.add_node("Softmax", &["logits"], "probabilities", vec![integer("axis", 1)]);
            graph.add_arg_max("logits", policy.starts.action);
            let actions = network.layers.last().map_or(0, |last| last.biases.len());
            graph.add_output("logits", FLOAT, &[actions]);
            graph.add_output("probabilities", FLOAT, &[actions]);
            graph.add_output("action", INT64, &[]);
        }
        PolicyFunction::Values { network } => {
            graph.add_input("observation", FLOAT, &[network.layers[0].inputs]);
            graph.add_network(network, policy.starts.observation, "action_values");
            graph.add_arg_max("action_values", policy.starts.action);
            let actions = network.layers.last().map_or(0, |last| last.biases.len());
            graph.add_output("action_values", FLOAT, &[actions]);
            graph.add_output("action", INT64, &[]);
        }
        PolicyFunction::Table {
            states,
            actions,
            values,
        } => {
            graph.add_input("state", INT64, &[]);
            graph.add_tensor("table", &[*states, *actions], values);
            let mut row = "state";
            if policy.starts.observation != 0 {
                graph.add_integer("observation_start", policy.starts.observation);
                graph.add_node("Sub", &["state", "observation_start"], "row", vec![]);
                row = "row";
            }
            graph.add_node("Gather", &["table", row], "action_values", vec![integer("axis", 0)]);
            graph.add_arg_max("action_values", policy.starts.action);
            graph.add_output("action_values", FLOAT, &[*actions]);
            graph.add_output("action", INT64, &[]);
        }
    }
    let metadata = policy.metadata.iter().map(|(key, value)| Metadata {
        key: key.clone(),
        value: value.clone(),
    });
    Model {
        ir_version: IR_VERSION,
        producer_name: "shoal".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        graph: Some(graph),
        opset_import: vec![Operators {
            version: OPERATOR_SET_VERSION,
        }],
        metadata_props: metadata.collect(),
    }
    .encode_to_vec()
}

impl Graph {
    /// Adds the layers with the activation between them. The environment numbers discrete observations from `start` on,
    /// the network from 0. The output of the last layer is named `output`.
    fn add_network(&mut self, network: &ExportedNetwork, start: i32, output: &str) {
        let ExportedNetwork {
            normalisation,
            activation,
            layers,
        } = network;
        let activation = match activation {
            Activation::Relu => "Relu",
            Activation::Tanh => "Tanh",
        };
        let mut x = "observation".to_owned();
        if start != 0 {
            self.add_tensor("observation_start", &[], &[start as f32]);
            self.add_node(
                "Sub",
                &["observation", "observation_start"],
                "observation_index",
                vec![],
            );
            x = "observation_index".into();
        }
        if let Some((mean, factor)) = normalisation {
            self.add_tensor("observation_mean", &[mean.len()], mean);
            self.add_node("Sub", &[&x, "observation_mean"], "centred", vec![]);
            self.add_tensor("observation_factor", &[factor.len()], factor);
            self.add_node(
                "Mul",
                &["centred", "observation_factor"],
                "unclipped_observation",
                vec![],
            );
            self.add_tensor("observation_least", &[], &[-OBSERVATION_CLIP]);
            self.add_tensor("observation_most", &[], &[OBSERVATION_CLIP]);
            let clip = ["unclipped_observation", "observation_least", "observation_most"];
            self.add_node("Clip", &clip, "normalised_observation", vec![]);
            x = "normalised_observation".into();
        }
        for (number, layer) in layers.iter().enumerate() {
            let [weight, bias] = ["weight", "bias"].map(|what| format!("layers.{number}.{what}"));
            self.add_tensor(&weight, &[layer.biases.len(), layer.inputs], &layer.weights);
            self.add_tensor(&bias, &[layer.biases.len()], &layer.biases);
            let last = number + 1 == layers.len();
            let z: String = if last { output.into() } else { format!("z{number}") };
            self.add_node("Gemm", &[&x, &weight, &bias], &z, vec![integer("transB", 1)]);
            if !last {
                x = format!("h{number}");
                self.add_node(activation, &[&z], &x, vec![]);
            }
        }
    }

    /// Adds `action`: the index of the highest score, the first one among equal scores. The environment numbers its
    /// actions from `start` on.
    fn add_arg_max(&mut self, scores: &str, start: i32) {
        let attributes = vec![
            integer("axis", 1),
            integer("keepdims", 0),
            integer("select_last_index", 0),
        ];
        let index = if start == 0 { "action" } else { "action_index" };
        self.add_node("ArgMax", &[scores], index, attributes);
        if start != 0 {
            self.add_integer("action_start", start);
            self.add_node("Add", &["action_index", "action_start"], "action", vec![]);
        }
    }

    fn add_node(&mut self, operator: &str, inputs: &[&str], output: &str, attribute: Vec<Attribute>) {
        self.node.push(Node {
            input: inputs.iter().map(|input| (*input).to_owned()).collect(),
            output: vec![output.into()],
            name: format!("{operator}_{output}"),
            op_type: operator.into(),
            attribute,
        });
    }

    fn add_tensor(&mut self, name: &str, shape: &[usize], numbers: &[f32]) {
        self.initializer.push(Tensor {
            dims: shape.iter().map(|size| *size as i64).collect(),
            data_type: FLOAT,
            name: name.into(),
            raw_data: numbers.iter().flat_map(|number| number.to_le_bytes()).collect(),
        });
    }

    fn add_integer(&mut self, name: &str, number: i32) {
        self.initializer.push(Tensor {
            dims: Vec::new(),
            data_type: INT64,
            name: name.into(),
            raw_data: i64::from(number).to_le_bytes().into(),
        });
    }

    fn add_input(&mut self, name: &str, element: i32, shape: &[usize]) {
        self.input.push(value(name, element, shape));
    }

    fn add_output(&mut self, name: &str, element: i32, shape: &[usize]) {
        self.output.push(value(name, element, shape));
    }
}

/// An input or output: a batch of tensors of this shape.
fn value(name: &str, element: i32, shape: &[usize]) -> ValueInfo {
    let batch = Dimension {
        dim_param: Some(BATCH.into()),
        ..Dimension::default()
    };
    let sizes = shape.iter().map(|size| Dimension {
        dim_value: Some(*size as i64),
        ..Dimension::default()
    });
    let shape = Shape {
        dim: std::iter::once(batch).chain(sizes).collect(),
    };
    let tensor_type = TensorType {
        elem_type: element,
        shape: Some(shape),
    };
    ValueInfo {
        name: name.into(),
        r#type: Some(Type {
            tensor_type: Some(tensor_type),
        }),
    }
}

fn integer(name: &str, value: i64) -> Attribute {
    Attribute {
        name: name.into(),
        i: Some(value),
        r#type: INT,
    }
}

#[cfg(test)]
mod tests;
