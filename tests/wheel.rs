//! The package of `python/` and the wheel with the program inside, which the `pyproject.toml` beside `Cargo.toml` makes.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

use std::path::Path;
use std::process::{Command, Output};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

fn manifest(path: &str) -> toml::Table {
    let text = std::fs::read_to_string(Path::new(ROOT).join(path)).unwrap();
    text.parse().unwrap()
}

#[test]
fn both_packages_are_the_same_but_for_the_program() {
    let [wheel, plain] = ["pyproject.toml", "python/pyproject.toml"].map(|path| manifest(path)["project"].clone());
    assert_eq!(plain["version"].as_str(), Some(env!("CARGO_PKG_VERSION")));
    assert_eq!(wheel["dynamic"].as_array().unwrap(), &["version".into()]);
    for key in ["name", "requires-python", "dependencies", "license"] {
        assert_eq!(wheel[key], plain[key], "{key}");
    }
}

fn succeed(command: &mut Command) -> Output {
    let output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {said}");
    output
}

/// It needs `maturin` and `python3` in `PATH`, and a network for pip.
#[test]
#[ignore = "it builds a wheel, which takes minutes"]
fn the_wheel_works_without_rust() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    let mut build = Command::new("maturin");
    build.args(["build", "--release", "--out"]).arg(here).current_dir(ROOT);
    succeed(&mut build);
    let wheels = std::fs::read_dir(here).unwrap().map(|entry| entry.unwrap().path());
    let [wheel] = &wheels.collect::<Vec<_>>()[..] else {
        panic!("one wheel")
    };
    succeed(Command::new("python3").args(["-m", "venv"]).arg(here.join("venv")));
    let bin = here.join("venv/bin");
    succeed(Command::new(bin.join("pip")).args(["install", "-q"]).arg(wheel));

    let path = format!("{}:/usr/bin:/bin", bin.display());
    let without_rust = |program: &str| {
        let mut command = Command::new(program);
        command.env("PATH", &path).env_remove("SHOAL").current_dir(here);
        command
    };
    let found = without_rust("sh")
        .args(["-c", "command -v cargo rustc"])
        .output()
        .unwrap();
    assert!(found.stdout.is_empty(), "there is Rust in {path}");
    let program = bin.join("shoal").display().to_string();
    let version = succeed(without_rust(&program).arg("--version")).stdout;
    assert_eq!(
        String::from_utf8(version).unwrap().trim(),
        concat!("shoal ", env!("CARGO_PKG_VERSION"))
    );
    succeed(without_rust(&program).args(["train", "pendulum", "--steps", "2000", "--quiet"]));
    let served = ["train", "gym:Pendulum-v1", "--steps", "300", "--actors", "1", "--quiet"];
    succeed(
        without_rust(&program)
            .args(served)
            .args(["--set", "evaluation.final_episodes=1"]),
    );
    // Another program in PATH does not replace the package's.
    std::fs::create_dir(here.join("other")).unwrap();
    std::os::unix::fs::symlink("/bin/false", here.join("other/shoal")).unwrap();
    let code = "import shoal; run = shoal.Run('runs/pendulum-1'); print(run.evaluations['return_mean'][-1], \
                run.status()['env_steps'], shoal.program.program())";
    let mut python = without_rust(bin.join("python3").to_str().unwrap());
    python.env("PATH", format!("{}/other:{path}", here.display()));
    let printed = String::from_utf8(succeed(python.args(["-c", code])).stdout).unwrap();
    let parts: Vec<&str> = printed.split_whitespace().collect();
    let program = Path::new(parts[2]).canonicalize().unwrap();
    assert_eq!((parts[1], program), ("2000", bin.join("shoal").canonicalize().unwrap()));
}
