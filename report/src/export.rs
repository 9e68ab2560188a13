//! Export of policies for other programs, independent of the file format.

mod onnx;
mod tensors;

use std::collections::BTreeMap;

use shoal_common::config::Config;
use shoal_common::network::{ActionRange, Activation, NetworkLayout, OBSERVATION_CLIP};
use shoal_common::policy::{PolicyLayout, combine_heads};
use shoal_common::policy_file::PolicyFile;
use shoal_common::space::Space;
use shoal_run::evaluation::final_evaluation::FinalPolicyResult;
use shoal_run::evaluation::rollout::policy_layout;

/// A policy in a form that needs no part of Shoal to run.
#[derive(Clone, Debug)]
pub struct PortablePolicy {
    body: PolicyFunction,
    starts: SpaceStarts,
    /// Describes the policy and its origin; the file contains it as key-value pairs. Lists are written as JSON.
    metadata: BTreeMap<String, String>,
}

/// The computation from an observation to the outputs.
#[derive(Clone, Debug)]
enum PolicyFunction {
    /// μ of DDPG and TD3, or the mean of SAC's π: the network, tanh, and the scaling to the range of the actions.
    Actions {
        network: ExportedNetwork,
        range: ActionRange,
    },
    /// REINFORCE's π: the network, and softmax.
    Probabilities { network: ExportedNetwork },
    /// DQN's action-values: the network.
    Values { network: ExportedNetwork },
    /// Action-values Q(s, a), state by state.
    Table {
        states: usize,
        actions: usize,
        values: Vec<f32>,
    },
}

/// The environment's own numbers of the first observation and the first action of discrete spaces; 0 for a box.
#[derive(Clone, Copy, Debug)]
struct SpaceStarts {
    observation: i32,
    action: i32,
}

/// A sequence of layers, with the activation between them.
#[derive(Clone, Debug)]
struct ExportedNetwork {
    /// The mean and the factor of each observed number, if they are normalised first.
    normalisation: Option<(Vec<f32>, Vec<f32>)>,
    activation: Activation,
    layers: Vec<Dense>,
}

/// A layer in the form of PyTorch's `Linear`: y = W x + b.
#[derive(Clone, Debug)]
struct Dense {
    inputs: usize,
    /// W, outputs × inputs, in row-major order.
    weights: Vec<f32>,
    biases: Vec<f32>,
}

impl PortablePolicy {
    /// The policy in `file`, from a run with configuration `config`. `which` is its name in the run: "best" or "last".
    pub fn new(config: &Config, file: &PolicyFile, which: &str) -> anyhow::Result<Self> {
        let body = match policy_layout(config)? {
            PolicyLayout::Deterministic(network) => PolicyFunction::Actions {
                network: ExportedNetwork::new(&network, &file.parameters),
                range: ActionRange::new(&config.spec.action)?,
            },
            PolicyLayout::Gaussian(network) => {
                let range = ActionRange::new(&config.spec.action)?;
                PolicyFunction::Actions {
                    network: ExportedNetwork::new(&network, &file.parameters).with_first_outputs(range.width()),
                    range,
                }
            }
            PolicyLayout::Softmax(network) => PolicyFunction::Probabilities {
                network: ExportedNetwork::new(&network, &file.parameters),
            },
            PolicyLayout::ActionValues(network) => PolicyFunction::Values {
                network: ExportedNetwork::new(&network, &file.parameters),
            },
            PolicyLayout::Dueling(network) => PolicyFunction::Values {
                network: ExportedNetwork::new(&network, &file.parameters).with_combined_heads(),
            },
            PolicyLayout::Table { states, actions } => PolicyFunction::Table {
                states,
                actions,
                values: file.parameters.clone(),
            },
        };
        let metadata = metadata(config, file, which, &body)?;
        let starts = SpaceStarts {
            observation: config.spec.observation.start(),
            action: config.spec.action.start(),
        };
        Ok(Self { body, starts, metadata })
    }

    /// Adds the policy's result in its run's final evaluation to the metadata.
    pub fn evaluated(mut self, seed: u64, evaluated: &FinalPolicyResult) -> anyhow::Result<Self> {
        let entries = [
            ("return", serde_json::to_string(&evaluated.return_mean)?),
            ("std", serde_json::to_string(&evaluated.return_std)?),
            ("interval", serde_json::to_string(&evaluated.interval)?),
            ("episodes", evaluated.episodes.to_string()),
            ("seed", seed.to_string()),
        ];
        let entries = entries.map(|(name, value)| (format!("final_evaluation_{name}"), value));
        self.metadata.extend(entries);
        Ok(self)
    }

    /// The bytes of an ONNX model.
    pub fn to_onnx(&self) -> Vec<u8> {
        onnx::model(self)
    }

    /// The bytes of a safetensors file.
    pub fn to_safetensors(&self) -> anyhow::Result<Vec<u8>> {
        tensors::file(self)
    }
}

impl ExportedNetwork {
    fn new(layout: &NetworkLayout, parameters: &[f32]) -> Self {
        let layers = layout.layers(parameters).zip(layout.layer_sizes());
        let dense = layers.map(|(layer, (inputs, outputs))| Dense {
            inputs,
            // `NetworkLayout` stores weights in column-major order.
            weights: (0..outputs * inputs)
                .map(|i| layer.weights[(i % inputs) * outputs + i / inputs])
                .collect(),
            biases: layer.biases.to_vec(),
        });
        let normalisation = layout.normalisation(parameters);
        Self {
            normalisation: normalisation.map(|(mean, factor)| (mean.to_vec(), factor.to_vec())),
            activation: layout.hidden().activation,
            layers: dense.collect(),
        }
    }

    /// The network with the first `count` of its outputs.
    fn with_first_outputs(mut self, count: usize) -> Self {
        if let Some(last) = self.layers.last_mut() {
            last.weights.truncate(count * last.inputs);
            last.biases.truncate(count);
        }
        self
    }

    /// A dueling network as a plain one. Action-values are linear in its outputs, so the last layer can compute them.
    fn with_combined_heads(mut self) -> Self {
        if let Some(last) = self.layers.last_mut() {
            // Each input's weights, and the biases, are a column of one number for each output.
            let columns = (0..=last.inputs).map(|input| {
                let mut heads: Vec<f32> = match last.weights.get(input..) {
                    Some(weights) if input < last.inputs => weights.iter().step_by(last.inputs).copied().collect(),
                    _ => last.biases.clone(),
                };
                combine_heads(&mut heads);
                heads
            });
            let columns: Vec<Vec<f32>> = columns.collect();
            let (biases, weights) = columns.split_last().map_or((&[][..], &[][..]), |(b, w)| (&b[1..], w));
            last.weights = (1..=biases.len())
                .flat_map(|output| weights.iter().map(move |column| column[output]))
                .collect();
            last.biases = biases.to_vec();
        }
        self
    }
}

fn metadata(
    config: &Config,
    file: &PolicyFile,
    which: &str,
    body: &PolicyFunction,
) -> anyhow::Result<BTreeMap<String, String>> {
    let mut metadata = BTreeMap::from([
        ("environment".to_owned(), config.environment.name.clone()),
        ("algorithm".to_owned(), config.algorithm.name().to_owned()),
        ("policy".to_owned(), which.to_owned()),
        ("policy_version".to_owned(), file.version.to_string()),
        ("environment_steps".to_owned(), file.env_steps.to_string()),
    ]);
    let mut insert = |key: &str, value: String| {
        metadata.insert(key.to_owned(), value);
    };
    if file.episodes > 0 {
        insert("evaluation_return", file.return_mean.to_string());
    }
    for (name, space) in [
        ("observation_start", &config.spec.observation),
        ("action_start", &config.spec.action),
    ] {
        if let Space::Discrete { start, .. } = space {
            insert(name, start.to_string());
        }
    }
    if let PolicyFunction::Actions { network, .. }
    | PolicyFunction::Probabilities { network }
    | PolicyFunction::Values { network } = body
    {
        let activation = match network.activation {
            Activation::Relu => "relu",
            Activation::Tanh => "tanh",
        };
        insert("hidden_activation", activation.into());
        if network.normalisation.is_some() {
            insert("observation_clip", OBSERVATION_CLIP.to_string());
        }
    }
    match body {
        PolicyFunction::Actions { .. } => {
            insert(
                "output_activation",
                "tanh, then scaled to action_low .. action_high".into(),
            );
            if let Space::Box { low, high } = &config.spec.action {
                insert("action_low", serde_json::to_string(low)?);
                insert("action_high", serde_json::to_string(high)?);
            }
        }
        PolicyFunction::Probabilities { .. } => insert("output_activation", "softmax".into()),
        PolicyFunction::Values { .. } => insert("output_activation", "none: the outputs are action values".into()),
        PolicyFunction::Table { .. } => insert("contents", "action values, a row for each state".into()),
    }
    Ok(metadata)
}

#[cfg(test)]
mod tests {
    use shoal_common::network::Hidden;

    use super::*;

    #[test]
    fn weights_are_exported_in_row_major_order() {
        let layout = NetworkLayout::new(3, Hidden::relu([2, 1]), 1);
        let parameters: Vec<f32> = (0..layout.parameters()).map(|i| i as f32).collect();
        let first = &ExportedNetwork::new(&layout, &parameters).layers[0];
        assert_eq!(first.weights, [0.0, 2.0, 4.0, 1.0, 3.0, 5.0]);
        assert_eq!(first.biases, [6.0, 7.0]);
    }
}

#[cfg(test)]
mod tests_support {
    //! Configurations of every algorithm and of some variants, with policies that are not special cases.

    use shoal_env_server::environment::make;
    use shoal_run::plan::{RunOverrides, algorithm, resolve};

    use super::*;

    /// Configurations for each kind of policy, each with a policy for it.
    pub(super) fn policies() -> Vec<(Config, PolicyFile)> {
        let tasks = [
            "[environment]\nname = \"pendulum\"\n[ddpg]\nhidden = [40, 30]\n",
            "[environment]\nname = \"point-mass\"\nreward = \"r3\"\n[ddpg]\nhidden = [7, 5]\n",
            "[environment]\nname = \"pendulum\"\n[ddpg]\nhidden = [40]\n",
            "[environment]\nname = \"point-mass\"\n[ddpg]\nhidden = [7]\nactivation = \"tanh\"\n",
            "[environment]\nname = \"pendulum\"\n[ddpg]\nhidden = [9, 8, 7]\n",
            "[environment]\nname = \"point-mass\"\n[ddpg]\nhidden = [9, 8, 7]\nactivation = \"tanh\"\n",
            "mode = \"lockstep\"\n[environment]\nname = \"cart-pole\"\n[actors]\nchunk_steps = 200\n\
             [reinforce]\nhidden = [6, 5, 4]\nactivation = \"tanh\"\n[replay]\nwarmup = 0\n",
            "[environment]\nname = \"point-mass\"\n[sac]\nhidden = [9]\n[observation]\nnormalise = true\n",
            "[environment]\nname = \"pendulum\"\n[ddpg]\nhidden = [9]\n[observation]\nnormalise = true\n",
            "[environment]\nname = \"cart-pole\"\n[dqn]\nhidden = [9]\nactivation = \"tanh\"\ndueling = true\n",
        ];
        let variants = tasks.map(|task| of_text(&format!("[run]\nid = \"1a\"\n{task}")));
        let defaults = algorithm::names().map(with_defaults);
        variants.into_iter().chain(defaults).map(with_policy).collect()
    }

    /// An algorithm with its defaults, but a small network, for the first of these tasks that it can control.
    fn with_defaults(algorithm: &str) -> Config {
        let resolved = |task: &str, set: Vec<String>| {
            let overrides = RunOverrides {
                algorithm: Some(algorithm.into()),
                set,
                ..RunOverrides::default()
            };
            resolve(task, &overrides).ok()
        };
        let hidden = format!("{algorithm}.hidden=[9, 8]");
        let mut tasks = ["pendulum", "cart-pole", "frozen-lake"].into_iter();
        // A table has no such key.
        let found = tasks.find_map(|task| resolved(task, vec![hidden.clone()]).or_else(|| resolved(task, Vec::new())));
        let (_, config) = found.unwrap();
        config
    }

    fn of_text(text: &str) -> Config {
        let mut table: toml::Table = text.parse().unwrap();
        let name = table["environment"]["name"].as_str().unwrap().to_owned();
        let mut parameters = table["environment"].as_table().unwrap().clone();
        parameters.remove("name");
        let spec = make(&name, &parameters).unwrap().spec();
        table.insert("spec".into(), toml::Value::try_from(spec).unwrap());
        Config::from_table(table, "test").unwrap()
    }

    fn with_policy(config: Config) -> (Config, PolicyFile) {
        let layout = policy_layout(&config).unwrap();
        let policy = PolicyFile {
            fingerprint: layout.fingerprint(),
            version: 7,
            env_steps: 1_000,
            return_mean: -150.5,
            return_std: 90.0,
            episodes: 10,
            parameters: numbers(layout.parameters(), 1),
        };
        (config, policy)
    }

    /// A task whose environment numbers its observations from 1 and its actions from 5, and a policy for it.
    pub(super) fn with_starts() -> (Config, PolicyFile) {
        let (mut config, policy) = with_policy(with_defaults("q-learning"));
        for (space, first) in [(&mut config.spec.observation, 1), (&mut config.spec.action, 5)] {
            if let Space::Discrete { start, .. } = space {
                *start = first;
            }
        }
        (config, policy)
    }

    /// A task whose environment numbers its observations from 5, and a policy network for it.
    pub(super) fn with_observed_indices() -> (Config, PolicyFile) {
        let mut config = with_defaults("ddpg");
        config.spec.observation = Space::Discrete { n: 16, start: 5 };
        with_policy(config)
    }

    /// `count` observations of the environment, concatenated.
    pub(super) fn some_observations(config: &Config, count: usize) -> Vec<f32> {
        match config.spec.observation {
            Space::Discrete { n, .. } => (0..count).map(|i| (i * 5 % n as usize) as f32).collect(),
            Space::Box { .. } => numbers(count * config.spec.observation.width(), 2),
        }
    }

    fn numbers(count: usize, salt: usize) -> Vec<f32> {
        (0..count)
            .map(|i| ((i * 7919 + salt * 104_729) % 2003) as f32 / 1001.5 - 1.0)
            .collect()
    }
}
