//! A policy as an ONNX model. It takes any number of observations at once: the first dimension is named, not fixed.

mod message;

use message::{
    Attribute, Dimension, FLOAT, Graph, INT, INT64, Metadata, Model, Node, Operators, Shape, Tensor, TensorType, Type,
    ValueInfo,
};
use prost::Message;

use super::{Activation, Body, Network, Portable};

/// Of the file's form and of the operators: old enough for every runtime, and new enough for `ArgMax` to say which of
/// equals it takes.
const FORM: i64 = 8;
const OPERATORS: i64 = 13;

/// The name of the first dimension.
const BATCH: &str = "batch";

/// The bytes of the model.
///
/// - DDPG: `observation` (batch × n) to `action` (batch × m, in the environment's units).
/// - REINFORCE: `observation` to `logits`, `probabilities` (batch × actions) and `action` (batch: the likeliest).
/// - Tables: `state` (batch, 64-bit) to `action_values` (batch × actions) and `action` (batch: the best).
///
/// Discrete states and actions are counted as the environment counts them, from its spaces' starts on.
pub(super) fn model(policy: &Portable) -> Vec<u8> {
    let mut graph = Graph {
        name: "policy".into(),
        ..Graph::default()
    };
    match &policy.body {
        Body::Actions { network, range } => {
            let elements = 0..range.width();
            let half = range.half().to_vec();
            let centre: Vec<f32> = elements.map(|element| range.action(element, 0.0)).collect();
            let outputs = half.len();
            graph.takes("observation", FLOAT, &[network.layers[0].inputs]);
            graph.network(network, "z");
            graph.does("Tanh", &["z"], "tanh", vec![]);
            graph.holds("action_half_width", &[outputs], &half);
            graph.does("Mul", &["tanh", "action_half_width"], "scaled", vec![]);
            graph.holds("action_centre", &[outputs], &centre);
            graph.does("Add", &["scaled", "action_centre"], "unclipped", vec![]);
            // Rounding may lead out of the bounds.
            graph.holds("action_low", &[outputs], range.low());
            graph.does("Max", &["unclipped", "action_low"], "bounded_below", vec![]);
            graph.holds("action_high", &[outputs], range.high());
            graph.does("Min", &["bounded_below", "action_high"], "action", vec![]);
            graph.gives("action", FLOAT, &[outputs]);
        }
        Body::Probabilities { network } => {
            graph.takes("observation", FLOAT, &[network.layers[0].inputs]);
            graph.network(network, "logits");
            graph.does("Softmax", &["logits"], "probabilities", vec![integer("axis", 1)]);
            graph.first_of_the_highest("logits", policy.starts.action);
            let actions = network.layers.last().map_or(0, |last| last.biases.len());
            graph.gives("logits", FLOAT, &[actions]);
            graph.gives("probabilities", FLOAT, &[actions]);
            graph.gives("action", INT64, &[]);
        }
        Body::Table {
            states,
            actions,
            values,
        } => {
            graph.takes("state", INT64, &[]);
            graph.holds("table", &[*states, *actions], values);
            let mut row = "state";
            if policy.starts.observation != 0 {
                graph.holds_integer("observation_start", policy.starts.observation);
                graph.does("Sub", &["state", "observation_start"], "row", vec![]);
                row = "row";
            }
            graph.does("Gather", &["table", row], "action_values", vec![integer("axis", 0)]);
            graph.first_of_the_highest("action_values", policy.starts.action);
            graph.gives("action_values", FLOAT, &[*actions]);
            graph.gives("action", INT64, &[]);
        }
    }
    let about = policy.about.iter().map(|(key, value)| Metadata {
        key: key.clone(),
        value: value.clone(),
    });
    Model {
        ir_version: FORM,
        producer_name: "shoal".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        graph: Some(graph),
        opset_import: vec![Operators { version: OPERATORS }],
        metadata_props: about.collect(),
    }
    .encode_to_vec()
}

impl Graph {
    /// The layers, with the activation between them; the last one's output is named `output`.
    fn network(&mut self, network: &Network, output: &str) {
        let Network { activation, layers } = network;
        let activation = match activation {
            Activation::Relu => "Relu",
            Activation::Tanh => "Tanh",
        };
        let mut x = "observation".to_owned();
        for (number, layer) in layers.iter().enumerate() {
            let [weight, bias] = ["weight", "bias"].map(|what| format!("layers.{number}.{what}"));
            self.holds(&weight, &[layer.biases.len(), layer.inputs], &layer.weights);
            self.holds(&bias, &[layer.biases.len()], &layer.biases);
            let last = number + 1 == layers.len();
            let z: String = if last { output.into() } else { format!("z{number}") };
            self.does("Gemm", &[&x, &weight, &bias], &z, vec![integer("transB", 1)]);
            if !last {
                x = format!("h{number}");
                self.does(activation, &[&z], &x, vec![]);
            }
        }
    }

    /// The index of the highest, the first of equals, as `action`, which the environment counts from `start`.
    fn first_of_the_highest(&mut self, scores: &str, start: i32) {
        let attributes = vec![
            integer("axis", 1),
            integer("keepdims", 0),
            integer("select_last_index", 0),
        ];
        let index = if start == 0 { "action" } else { "action_index" };
        self.does("ArgMax", &[scores], index, attributes);
        if start != 0 {
            self.holds_integer("action_start", start);
            self.does("Add", &["action_index", "action_start"], "action", vec![]);
        }
    }

    fn does(&mut self, operator: &str, inputs: &[&str], output: &str, attribute: Vec<Attribute>) {
        self.node.push(Node {
            input: inputs.iter().map(|input| (*input).to_owned()).collect(),
            output: vec![output.into()],
            name: format!("{operator}_{output}"),
            op_type: operator.into(),
            attribute,
        });
    }

    fn holds(&mut self, name: &str, shape: &[usize], numbers: &[f32]) {
        self.initializer.push(Tensor {
            dims: shape.iter().map(|size| *size as i64).collect(),
            data_type: FLOAT,
            name: name.into(),
            raw_data: numbers.iter().flat_map(|number| number.to_le_bytes()).collect(),
        });
    }

    fn holds_integer(&mut self, name: &str, number: i32) {
        self.initializer.push(Tensor {
            dims: Vec::new(),
            data_type: INT64,
            name: name.into(),
            raw_data: i64::from(number).to_le_bytes().into(),
        });
    }

    fn takes(&mut self, name: &str, element: i32, shape: &[usize]) {
        self.input.push(value(name, element, shape));
    }

    fn gives(&mut self, name: &str, element: i32, shape: &[usize]) {
        self.output.push(value(name, element, shape));
    }
}

/// A batch of tensors of this shape.
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
