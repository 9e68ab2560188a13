//! Runs with other than two hidden layers: training, resuming, evaluation and export.

use rten::{Model, Value};
use safetensors::SafeTensors;

use crate::support::{QUICK, Workplace, error_line, json};

#[test]
fn networks_of_one_and_three_hidden_layers_can_be_trained_resumed_evaluated_and_exported() {
    let cases: [(&str, &str, &[usize]); 3] = [
        ("[32]", "relu", &[32]),
        ("[16,16,16]", "relu", &[16; 3]),
        ("[12,14,16]", "tanh", &[12, 14, 16]),
    ];
    for (hidden, activation, units) in cases {
        let place = Workplace::new();
        let [hidden, activation_key] = [format!("ddpg.hidden={hidden}"), format!("ddpg.activation={activation}")];
        let settings = ["--set", &hidden, "--set", &activation_key];
        let train = [
            "train",
            "pendulum",
            "--lockstep",
            "--run",
            "run",
            "--steps",
            "1024",
            "--json",
        ];
        let output = place.output(&[&train[..], &QUICK, &settings].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let before = json(&output)["weights_sha256"].clone();
        let output = place.output(&["resume", "run", "--steps", "2048", "--json"]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let after = json(&output);
        assert_eq!(after["env_steps"], 2048);
        assert_ne!(after["weights_sha256"], before, "learning has continued");
        // Both lengths are whole rounds, so an uninterrupted run ends with the same bits.
        let whole = [
            "train",
            "pendulum",
            "--lockstep",
            "--run",
            "whole",
            "--steps",
            "2048",
            "--json",
        ];
        let whole = place.output(&[&whole[..], &QUICK, &settings].concat());
        assert_eq!(json(&whole)["weights_sha256"], after["weights_sha256"]);

        let evaluated = place.output(&["eval", "run", "--policy", "last", "--episodes", "2", "--json"]);
        assert!(
            evaluated.status.success(),
            "{}",
            String::from_utf8_lossy(&evaluated.stderr)
        );

        for format in ["onnx", "safetensors"] {
            let output = place.output(&["export", "run", "--policy", "last", "--format", format]);
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        }
        let read = |name: &str| std::fs::read(place.path().join("run").join(name)).unwrap();
        let bytes = read("last.safetensors");
        let (tensors, about) = (
            SafeTensors::deserialize(&bytes).unwrap(),
            SafeTensors::read_metadata(&bytes).unwrap().1,
        );
        assert_eq!(about.metadata().as_ref().unwrap()["hidden_activation"], activation);
        let sizes = [&[3], units, &[1]].concat();
        assert_eq!(tensors.len(), 2 * (sizes.len() - 1));
        for (layer, pair) in sizes.windows(2).enumerate() {
            let weights = tensors.tensor(&format!("layers.{layer}.weight")).unwrap();
            assert_eq!(weights.shape(), [pair[1], pair[0]]);
        }

        // An independent ONNX runtime computes the same as the tensors.
        let model = Model::load(read("last.onnx")).unwrap();
        let [input, output] = ["observation", "action"].map(|name| model.node_id(name).unwrap());
        let s = vec![0.6_f32, -0.8, 1.5];
        let observation = Value::from_shape([1, 3], s.clone()).unwrap();
        let mut outputs = model.run(vec![(input, observation.into())], &[output], None).unwrap();
        let (_, action) = outputs.remove(0).into_shape_vec::<f32, 2>().unwrap();
        let expected = 2.0 * output_of_tensors(&tensors, units.len(), activation, s).tanh();
        assert!(
            (action[0] - expected).abs() < 1e-5,
            "{hidden}: {action:?} for {expected}"
        );
    }
}

/// The network's output before its output activation, computed from the tensors.
fn output_of_tensors(tensors: &SafeTensors<'_>, last: usize, activation: &str, s: Vec<f32>) -> f32 {
    let numbers = |name: String| -> Vec<f32> {
        let tensor = tensors.tensor(&name).unwrap();
        let bytes = tensor.data().as_chunks::<4>().0.iter();
        bytes.map(|bytes| f32::from_le_bytes(*bytes)).collect()
    };
    let x = (0..=last).fold(s, |x, layer| {
        let [weights, biases] = ["weight", "bias"].map(|what| numbers(format!("layers.{layer}.{what}")));
        let rows = weights.chunks_exact(x.len()).zip(&biases);
        let z = rows.map(|(row, bias)| row.iter().zip(&x).map(|(w, x)| w * x).sum::<f32>() + bias);
        z.map(|z| match activation {
            _ if layer == last => z,
            "relu" => z.max(0.0),
            _ => z.tanh(),
        })
        .collect()
    });
    x[0]
}

#[test]
fn a_run_can_be_resumed_only_with_its_own_networks() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "300", "--run", "run"]);
    let path = place.path().join("run/config.toml");
    let config = std::fs::read_to_string(&path).unwrap();
    for (written, other) in [
        ("hidden = [24, 16]", "hidden = [24, 16, 16]"),
        ("hidden = [24, 16]", "hidden = [24]"),
        ("activation = \"relu\"", "activation = \"tanh\""),
    ] {
        let changed = config.replace(written, other);
        assert_ne!(changed, config, "{written}");
        std::fs::write(&path, changed).unwrap();
        let message = error_line(&place.output(&["resume", "run", "--steps", "400"]));
        let (key, value) = other.split_once(" = ").unwrap();
        let refused = format!("ddpg.{key} = {}: cannot change", value.trim_matches('"'));
        assert!(
            message.contains(&refused) && message.contains("config.toml, line "),
            "{other}: {message}"
        );
    }
    // A configuration of a version without this key.
    std::fs::write(&path, config.replace("activation = \"relu\"\n", "")).unwrap();
    let output = place.output(&["resume", "run", "--steps", "400"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
