//! Repeats gradient steps of PyTorch's autograd and Adam: from the `initial` networks, one step for each of `batches`.
//! After each step the losses and networks must be as in `expected`.

use nalgebra::DMatrix;
use serde::de::DeserializeOwned;
use serde_json::Value;
use shoal_common::algorithms::{AlgorithmSettings, LearnedShapes, Shape};
use shoal_common::config::{DdpgConfig, DqnConfig, SacConfig, Td3Config};
use shoal_common::network::NetworkLayout;
use shoal_common::space::{EnvironmentSpec, Space};
use shoal_common::transition::{RowLayout, Transition};
use shoal_learner::algorithms::algorithm::Losses;
use shoal_learner::algorithms::ddpg::Ddpg;
use shoal_learner::algorithms::dqn::Dqn;
use shoal_learner::algorithms::minibatch::Minibatch;
use shoal_learner::algorithms::minibatch_algorithm::MinibatchAlgorithm;
use shoal_learner::algorithms::sac::Sac;
use shoal_learner::algorithms::td3::Td3;

use super::{FLAGS, Failure, VALUES, close, read};

/// Compares the updates in `file` with the updates of its algorithm.
pub(super) fn check(file: &Value) -> Result<(), Failure> {
    let constants = serde_json::json!({"beta1": 0.9, "beta2": 0.999, "eps": 1e-8});
    if file["adam"] != constants {
        return Err(format!("Adam's constants are not the algorithm's: {}", file["adam"]));
    }
    let batches = Batches::read(file)?;
    match file.get("method").and_then(Value::as_str) {
        None => ddpg(file, &batches),
        Some("td3") => td3(file, &batches),
        Some("sac") => sac(file, &batches),
        Some("dqn") => dqn(file, &batches),
        Some(other) => Err(format!("unknown algorithm {other}")),
    }
}

fn ddpg(file: &Value, batches: &Batches) -> Result<(), Failure> {
    let settings = DdpgConfig {
        tau: number(file, "tau")?,
        actor_learning_rate: number(file, "actor_lr")?,
        critic_learning_rate: number(file, "critic_lr")?,
        hidden: number(file, "hidden")?,
        batch: batches.size(),
        ..DdpgConfig::default()
    };
    let mut ddpg = Ddpg::new(&batches.spec, &settings, 0).map_err(|e| e.to_string())?;
    let learned = settings.learned_shapes(&batches.spec);
    let networks = recorded(&[
        ("actor", "actor"),
        ("critic", "critic"),
        ("target_actor", "target actor"),
        ("target_critic", "target critic"),
    ]);
    repeat(file, batches, &mut ddpg, &learned, &networks, |ddpg, _, batch| {
        let Losses {
            critic_loss,
            actor_loss,
            ..
        } = ddpg.update(batch);
        Ok(vec![("critic_loss", critic_loss), ("actor_loss", actor_loss)])
    })
}

fn td3(file: &Value, batches: &Batches) -> Result<(), Failure> {
    let settings = Td3Config {
        tau: number(file, "tau")?,
        actor_learning_rate: number(file, "actor_lr")?,
        critic_learning_rate: number(file, "critic_lr")?,
        policy_delay: number(file, "policy_delay")?,
        target_noise: number(file, "target_noise")?,
        target_noise_clip: number(file, "target_noise_clip")?,
        hidden: number(file, "hidden")?,
        batch: batches.size(),
        ..Td3Config::default()
    };
    let mut td3 = Td3::new(&batches.spec, &settings, 0).map_err(|e| e.to_string())?;
    let learned = settings.learned_shapes(&batches.spec);
    let actors = [("actor", "actor"), ("target_actor", "target actor")];
    let networks = recorded(&[&actors[..], &TWIN_CRITICS].concat());
    repeat(file, batches, &mut td3, &learned, &networks, |td3, recorded, batch| {
        let losses = td3.update(batch, &columns(recorded, "target_noise")?);
        Ok(vec![
            ("critic_loss", losses.critic_loss),
            ("actor_loss", losses.actor_loss),
        ])
    })
}

fn sac(file: &Value, batches: &Batches) -> Result<(), Failure> {
    let action = batches.spec.action.width() as f64;
    let settings = SacConfig {
        tau: number(file, "tau")?,
        actor_learning_rate: number(file, "actor_lr")?,
        critic_learning_rate: number(file, "critic_lr")?,
        temperature_learning_rate: number(file, "temperature_lr")?,
        initial_temperature: number(file, "initial_temperature")?,
        target_entropy_per_element: number::<f64>(file, "target_entropy")? / action,
        hidden: number(file, "hidden")?,
        batch: batches.size(),
        ..SacConfig::default()
    };
    let (least, greatest) = shoal_common::network::LOG_STD_RANGE;
    let range: [f32; 2] = [number(file, "log_std_min")?, number(file, "log_std_max")?];
    if range != [least, greatest] {
        return Err(format!("log σ is clamped to {range:?}"));
    }
    let mut sac = Sac::new(&batches.spec, &settings, 0).map_err(|e| e.to_string())?;
    let learned = settings.learned_shapes(&batches.spec);
    let networks = recorded(&[&[("actor", "actor")][..], &TWIN_CRITICS].concat());
    repeat(file, batches, &mut sac, &learned, &networks, |sac, recorded, batch| {
        let (noise, next_noise) = (columns(recorded, "noise")?, columns(recorded, "next_noise")?);
        let losses = sac.update(batch, &noise, &next_noise);
        Ok(vec![
            ("critic_loss", losses.critic_loss),
            ("actor_loss", losses.actor_loss),
            ("temperature", sac.temperature()),
        ])
    })
}

fn dqn(file: &Value, batches: &Batches) -> Result<(), Failure> {
    let settings = DqnConfig {
        learning_rate: number(file, "lr")?,
        target_every: number(file, "target_every")?,
        double: number(file, "double")?,
        huber_delta: number(file, "huber_delta")?,
        hidden: number(file, "hidden")?,
        batch: batches.size(),
        ..DqnConfig::default()
    };
    let mut dqn = Dqn::new(&batches.spec, &settings, 0).map_err(|e| e.to_string())?;
    let learned = settings.learned_shapes(&batches.spec);
    let networks = recorded(&[("q", "action-values"), ("target_q", "target action-values")]);
    repeat(file, batches, &mut dqn, &learned, &networks, |dqn, _, batch| {
        Ok(vec![("loss", dqn.update(batch).critic_loss)])
    })
}

/// Names of networks in a file, and of their arrays in the algorithm's state.
const TWIN_CRITICS: [(&str, &str); 4] = [
    ("critic1", "critic 1"),
    ("critic2", "critic 2"),
    ("target_critic1", "target critic 1"),
    ("target_critic2", "target critic 2"),
];

/// A network in a file, its array in the algorithm's state, and the name of the learned network of the same shape.
struct Recorded {
    name: &'static str,
    array: &'static str,
    shape_of: &'static str,
}

fn recorded(networks: &[(&'static str, &'static str)]) -> Vec<Recorded> {
    networks
        .iter()
        .map(|&(name, array)| Recorded {
            name,
            array,
            shape_of: array.strip_prefix("target ").unwrap_or(array),
        })
        .collect()
}

/// Starts `algorithm` from the initial networks and takes a step for each batch. `update` takes one and returns the
/// losses, which are compared with the file's losses of the same name.
fn repeat<A: MinibatchAlgorithm>(
    file: &Value,
    batches: &Batches,
    algorithm: &mut A,
    learned: &LearnedShapes,
    networks: &[Recorded],
    mut update: impl FnMut(&mut A, &Value, &Minibatch) -> Result<Vec<(&'static str, f32)>, Failure>,
) -> Result<(), Failure> {
    for (network, numbers) in parameters(&file["initial"], learned, networks)? {
        let mut state = algorithm.state_mut(0);
        let array = state.iter_mut().find(|(name, _)| *name == network.array);
        let (_, array) = array.ok_or_else(|| format!("the algorithm has no {}", network.array))?;
        array.copy_from_slice(&numbers);
    }
    for (i, (recorded, batch, expected)) in batches.iter().enumerate() {
        let losses = update(algorithm, recorded, batch).map_err(|e| format!("batch {i}: {e}"))?;
        let mut compared = 0;
        for (name, ours) in losses.into_iter().filter(|(name, _)| expected.get(name).is_some()) {
            close(&[ours.into()], &[number(expected, name)?]).map_err(|e| format!("update {i}: {name} {e}"))?;
            compared += 1;
        }
        if compared == 0 {
            return Err(format!("update {i}: no loss is recorded"));
        }
        let state = algorithm.state();
        for (network, numbers) in parameters(expected, learned, networks)? {
            let (_, ours) = state
                .iter()
                .find(|(name, _)| *name == network.array)
                .ok_or("an array is gone")?;
            for (at, (a, b)) in ours.iter().zip(&numbers).enumerate() {
                close(&[f64::from(*a)], &[f64::from(*b)])
                    .map_err(|e| format!("update {i}: {}, parameter {at} {e}", network.name))?;
            }
        }
    }
    Ok(())
}

/// Every network's parameters in the algorithm's order.
fn parameters<'a>(
    recorded: &Value,
    learned: &LearnedShapes,
    networks: &'a [Recorded],
) -> Result<Vec<(&'a Recorded, Vec<f32>)>, Failure> {
    let of = |network: &'a Recorded| {
        let shape = learned.iter().find(|(name, _)| *name == network.shape_of);
        let Some((_, Shape::Network(layout))) = shape else {
            return Err(format!("the algorithm has no network {}", network.shape_of));
        };
        let numbers = flat(&recorded[network.name], &layout).map_err(|e| format!("{}: {e}", network.name))?;
        Ok((network, numbers))
    };
    networks.iter().map(of).collect()
}

/// A recorded network's parameters in the algorithm's order. The recorded weights are lists of rows, one per output.
fn flat(network: &Value, layout: &NetworkLayout) -> Result<Vec<f32>, Failure> {
    let mut parameters = Vec::with_capacity(layout.parameters());
    for (layer, (inputs, outputs)) in layout.layer_sizes().enumerate() {
        let [w, b] = ["w", "b"].map(|what| format!("{what}{}", layer + 1));
        let weights: Vec<Vec<f32>> = number(network, &w)?;
        let biases: Vec<f32> = number(network, &b)?;
        if weights.len() != outputs || biases.len() != outputs || weights.iter().any(|row| row.len() != inputs) {
            return Err(format!("{w} and {b} are not {outputs} × {inputs}"));
        }
        parameters.extend((0..inputs).flat_map(|column| weights.iter().map(move |row| row[column])));
        parameters.extend(biases);
    }
    Ok(parameters)
}

/// A list of rows, one for each sample, as a matrix with a column for each sample.
fn columns(recorded: &Value, key: &str) -> Result<DMatrix<f32>, Failure> {
    let rows: Vec<Vec<f32>> = number(recorded, key)?;
    let width = rows.first().map_or(0, Vec::len);
    if rows.iter().any(|row| row.len() != width) {
        return Err(format!("{key}: the rows have different lengths"));
    }
    Ok(DMatrix::from_iterator(width, rows.len(), rows.into_iter().flatten()))
}

/// Reads the element `key` of a file.
fn number<T: DeserializeOwned>(file: &Value, key: &str) -> Result<T, Failure> {
    read(file, key, serde_json::from_value)
}

/// The environment and the minibatches of a file, with the results that are expected after each.
struct Batches {
    spec: EnvironmentSpec,
    recorded: Vec<Value>,
    batches: Vec<Minibatch>,
    expected: Vec<Value>,
}

impl Batches {
    fn read(file: &Value) -> Result<Self, Failure> {
        let (observation, action): (usize, usize) = (number(file, "obs_dim")?, number(file, "act_dim")?);
        let is_discrete = file.get("action_low").is_none();
        let spec = EnvironmentSpec {
            observation: Space::boxed(&vec![(f32::NEG_INFINITY, f32::INFINITY); observation]),
            action: if is_discrete {
                Space::discrete(action as u32)
            } else {
                Space::Box {
                    low: number(file, "action_low")?,
                    high: number(file, "action_high")?,
                }
            },
            time_limit: 1,
            state_width: 0,
        };
        let layout = RowLayout::new(observation, spec.action.width());
        let gamma = number(file, "gamma")?;
        let recorded = read(file, "batches", VALUES)?;
        let read_batch = |batch| minibatch(batch, layout, is_discrete, gamma);
        let batches: Vec<_> = recorded.iter().map(read_batch).collect::<Result<_, _>>()?;
        let expected = read(file, "expected", VALUES)?;
        if batches.is_empty() || expected.len() != batches.len() {
            return Err(format!(
                "{} batches, {} expected results",
                batches.len(),
                expected.len()
            ));
        }
        Ok(Self {
            spec,
            recorded,
            batches,
            expected,
        })
    }

    /// Transitions in a minibatch.
    fn size(&self) -> usize {
        self.batches[0].size()
    }

    /// Each minibatch as recorded, as a minibatch, and the results after it.
    fn iter(&self) -> impl Iterator<Item = (&Value, &Minibatch, &Value)> {
        let both = self.recorded.iter().zip(&self.batches).zip(&self.expected);
        both.map(|((recorded, batch), expected)| (recorded, batch, expected))
    }
}

fn minibatch(batch: &Value, layout: RowLayout, is_discrete: bool, gamma: f32) -> Result<Minibatch, Failure> {
    let [s, s_next]: [Vec<Vec<f32>>; 2] = [number(batch, "s")?, number(batch, "s2")?];
    let a: Vec<Vec<f32>> = if is_discrete {
        let actions: Vec<f32> = number(batch, "a")?;
        actions.into_iter().map(|action| vec![action]).collect()
    } else {
        number(batch, "a")?
    };
    let r: Vec<f32> = number(batch, "r")?;
    let terminated = read(batch, "terminated", FLAGS)?;
    let fits = |rows: &[Vec<f32>], width| rows.len() == r.len() && rows.iter().all(|row| row.len() == width);
    let (observation, action) = (layout.observation_width(), layout.action_width());
    if !(fits(&s, observation) && fits(&a, action) && fits(&s_next, observation)) || terminated.len() != r.len() {
        return Err(format!(
            "a batch does not hold {} transitions of {observation} observed and {action} action numbers",
            r.len()
        ));
    }
    let mut minibatch = Minibatch::new(layout, r.len());
    for i in 0..r.len() {
        let (last, discount) = (terminated[i], if terminated[i] { 0.0 } else { gamma });
        minibatch.set(
            i,
            &Transition {
                s: &s[i],
                a: &a[i],
                r: r[i],
                discount,
                s_next: &s_next[i],
                last,
            },
        );
    }
    Ok(minibatch)
}
