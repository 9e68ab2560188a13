//! Export of a policy for other programs.

use rten::{Model, Value};

use crate::support::{Workplace, error_line};

#[test]
fn a_policy_is_exported_in_both_formats_and_runs_in_other_software() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "400", "--run", "run"]);
    let printed = |arguments: &[&str]| {
        let output = place.output(&[&["export", "run"], arguments].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    assert_eq!(printed(&["--format", "onnx", "--policy", "last"]), "run/last.onnx\n");
    let model = Model::load(std::fs::read(place.path().join("run/last.onnx")).unwrap()).unwrap();
    let [input, output] = ["observation", "action"].map(|name| model.node_id(name).unwrap());
    for batch in [1_usize, 5] {
        let observations = Value::from_shape([batch, 3], vec![0.5; 3 * batch]).unwrap();
        let mut actions = model.run(vec![(input, observations.into())], &[output], None).unwrap();
        let (shape, actions) = actions.remove(0).into_shape_vec::<f32, 2>().unwrap();
        assert_eq!(shape, [batch, 1]);
        assert!(
            actions.iter().all(|torque| (-2.0..=2.0).contains(torque)),
            "{actions:?}"
        );
    }

    assert_eq!(
        printed(&["--format", "safetensors", "--out", "policy.safetensors"]),
        "policy.safetensors\n"
    );
    let bytes = std::fs::read(place.path().join("policy.safetensors")).unwrap();
    let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    assert_eq!(tensors.tensor("layers.0.weight").unwrap().shape(), [24, 3]);
    assert_eq!(tensors.tensor("layers.2.weight").unwrap().shape(), [1, 16]);
    assert_eq!(tensors.tensor("layers.2.bias").unwrap().shape(), [1]);

    // An exported policy may be replaced, and nothing else.
    printed(&["--format", "onnx", "--policy", "last"]);
    printed(&["--format", "safetensors", "--out", "policy.safetensors"]);
    for (format, out) in [
        ("onnx", "run/config.toml"),
        ("onnx", "policy.safetensors"),
        ("safetensors", "run/last.onnx"),
        ("safetensors", "run/replay.bin"),
    ] {
        let before = std::fs::read(place.path().join(out)).unwrap();
        let message = error_line(&place.output(&["export", "run", "--format", format, "--out", out]));
        assert!(message.contains("is not an exported policy"), "{message}");
        assert!(std::fs::read(place.path().join(out)).unwrap() == before, "{out}");
    }
}

#[test]
fn an_impossible_export_is_refused_in_one_line() {
    let place = Workplace::new();
    let message = error_line(&place.output(&["export", "nowhere", "--format", "onnx"]));
    assert!(message.contains("nowhere is not a run directory"), "{message}");
    place.train(&["pendulum", "--steps", "300", "--run", "run"]);
    let message = error_line(&place.output(&["export", "run", "--format", "onnx", "--out", "missing/policy.onnx"]));
    assert!(
        message.contains("missing/policy.onnx") && message.contains("--out"),
        "{message}"
    );
    std::fs::remove_file(place.path().join("run/checkpoints/best.policy")).unwrap();
    let message = error_line(&place.output(&["export", "run", "--format", "safetensors"]));
    assert!(
        message.contains("best.policy") && message.contains("no policy here"),
        "{message}"
    );
    assert_eq!(
        place.output(&["export", "run"]).status.code(),
        Some(2),
        "--format is required"
    );
}
