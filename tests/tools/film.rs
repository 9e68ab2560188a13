//! Films of a policy.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use rustix::process::{Pid, Signal, kill_process};

use crate::support::{Workplace, error_line, output_of, until};

/// The files in a directory, except the files of these names.
fn others(directory: &Path, known: &[&str]) -> Vec<String> {
    let files = std::fs::read_dir(directory).unwrap();
    let names = files.map(|file| file.unwrap().file_name().into_string().unwrap());
    names.filter(|name| !known.contains(&name.as_str())).collect()
}

/// Writes a program called `ffmpeg` that copies its input to its last argument, or fails.
fn fake_ffmpeg(place: &Workplace, then: &str) -> String {
    let programs = place.path().join("programs");
    std::fs::create_dir_all(&programs).unwrap();
    let script = format!("#!/bin/sh\nfor last in \"$@\"; do :; done\n{then}\n");
    let program = programs.join("ffmpeg");
    std::fs::write(&program, script).unwrap();
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
    format!("{}:/usr/bin:/bin", programs.display())
}

#[test]
fn a_film_is_written_whole_or_refused_in_one_line() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "400", "--run", "run"]);
    let film = |arguments: &[&str]| place.output(&[&["film", "run"], arguments].concat());
    let output = film(&["--size", "64", "--episodes", "2"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stdout).ends_with("run/film.gif\n"));
    assert!(
        std::fs::read(place.path().join("run/film.gif"))
            .unwrap()
            .starts_with(b"GIF89a")
    );
    assert!(
        film(&["--size", "64", "--policy", "last"]).status.success(),
        "a film replaces a film"
    );

    std::fs::write(place.path().join("notes.gif"), "not a film").unwrap();
    for (arguments, part) in [
        (&["--out", "film.avi"][..], ".gif or .mp4"),
        (&["--out", "notes.gif"], "is not a film"),
        (&["--out", "nowhere/at/all.gif"], "cannot write nowhere/at/all.gif"),
        (&["--out", "run"], ".gif or .mp4"),
        (&["--fps", "0"], "0.1 to 1000"),
        (&["--episodes", "0"], "1..=50"),
    ] {
        let message = error_line(&film(arguments));
        assert!(message.contains(part), "{message}");
    }
    assert_eq!(std::fs::read(place.path().join("notes.gif")).unwrap(), b"not a film");
    std::fs::remove_file(place.path().join("run/checkpoints/best.policy")).unwrap();
    let message = error_line(&film(&[]));
    assert!(message.contains("best.policy"), "{message}");
    assert_eq!(others(place.path(), &["run", "notes.gif"]), [""; 0]);
}

#[test]
fn a_video_is_made_by_ffmpeg() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "400", "--run", "run"]);
    let film = |path: &str| {
        let arguments = ["film", "run", "--size", "64", "--out", "film.mp4"];
        output_of(place.shoal(&arguments).env("PATH", path))
    };
    let message = error_line(&film("/nowhere"));
    assert!(
        message.contains("ffmpeg, which is not in PATH") && message.contains(".gif"),
        "{message}"
    );
    let message = error_line(&film(&fake_ffmpeg(&place, "echo no such encoder >&2; exit 1")));
    assert!(message.contains("ffmpeg failed: no such encoder"), "{message}");
    assert_eq!(others(place.path(), &["run", "programs"]), [""; 0]);

    let output = film(&fake_ffmpeg(&place, "cat > \"$last\""));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // 200 steps and the last picture for 0.6 s, at 20 pictures a second.
    let frames = std::fs::metadata(place.path().join("film.mp4")).unwrap().len();
    assert_eq!(frames, (200 + 12) * 3 * 73 * 64);
}

#[test]
fn a_signal_ends_a_film_and_leaves_nothing() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "400", "--run", "run"]);
    // It never reads, so that the film cannot be finished before the signal.
    let path = fake_ffmpeg(&place, ": > started; exec sleep 60");
    let mut film = place.shoal(&["film", "run", "--size", "64", "--out", "film.mp4"]);
    let mut film = film.env("PATH", path).spawn().unwrap();
    until("ffmpeg has started", || place.path().join("started").exists());
    kill_process(Pid::from_child(&film), Signal::INT).unwrap();
    until("it has ended", || film.try_wait().unwrap().is_some());
    assert_eq!(film.wait().unwrap().code(), Some(130));
    assert_eq!(others(place.path(), &["run", "programs", "started"]), [""; 0]);
}
