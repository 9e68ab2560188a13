//! Pictures of environments, in films and in the report.

use crate::helpers::{OURS, SHORT, place, processes_of};
use crate::support::{Workplace, error_line};

/// Trains an environment of the tests for a moment.
fn trained(place: &Workplace, environment: &str, more: &[&str]) {
    let arguments = [&SHORT[..], &["--steps", "200"], more].concat();
    let (code, _, _) = place
        .start_in("run", &format!("{OURS}{environment}"), &arguments)
        .wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
}

/// The heights of the column in the pictures of a film of `Draws`, and how long each is seen.
fn columns(gif: &[u8]) -> Vec<(usize, u16)> {
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(gif).unwrap();
    let (width, height) = (usize::from(decoder.width()), usize::from(decoder.height()));
    assert_eq!((width, height), (60, 40));
    let mut canvas = vec![[0; 4]; width * height];
    let mut seen = Vec::new();
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        let [left, top, w] = [frame.left, frame.top, frame.width].map(usize::from);
        for (i, pixel) in frame
            .buffer
            .chunks_exact(4)
            .enumerate()
            .filter(|(_, pixel)| pixel[3] > 0)
        {
            canvas[(top + i / w) * width + left + i % w].copy_from_slice(pixel);
        }
        let red = canvas.iter().filter(|pixel| pixel[..3] == [200, 0, 0]).count();
        seen.push((red / 10, frame.delay));
    }
    seen
}

pub(crate) fn frames_are_filmed_and_played_in_the_report() {
    let place = place();
    let film = place.path().join("run/film.gif");
    trained(&place, "Draws-v0", &["--set", "environment.dies=once"]);
    let output = place.output(&["film", "run", "--episodes", "2"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stdout).ends_with("run/film.gif\n"));
    assert!(place.path().join("died").exists(), "a server was killed in an episode");
    let episode = [(6, 10), (12, 10), (18, 10), (24, 10), (30, 10), (36, 60)];
    let seen = columns(&std::fs::read(&film).unwrap());
    assert_eq!(
        seen,
        [episode, episode].concat(),
        "each state, five steps and the last one"
    );

    let output = place.output(&["film", "run", "--fps", "50", "--out", "fast.gif"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let seen = columns(&std::fs::read(place.path().join("fast.gif")).unwrap());
    assert_eq!(seen.iter().map(|(_, delay)| delay).sum::<u16>(), 5 * 2 + 60);

    let output = place.output(&["report", "run", "--out", "page.html"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    assert_eq!(
        page.matches("\"data:image/jpeg;base64,").count(),
        2 * 6,
        "two episodes of six states"
    );
    assert!(processes_of(&place, "shoal_gym").is_empty());
}

pub(crate) fn an_environment_without_frames_says_why() {
    let place = place();
    trained(&place, "Ends-v0", &[]);
    let message = error_line(&place.output(&["film", "run"]));
    assert!(
        message.contains("Ends-v0 cannot be filmed") && message.contains("render_mode"),
        "{message}"
    );
    assert!(!place.path().join("run/film.gif").exists() && !place.path().join("run/film.gif.new").exists());
    let output = place.output(&["report", "run", "--out", "page.html"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    assert!(page.contains("This environment cannot be shown:") && page.contains("\"why_not\":null"));

    // A server that dies in every film.
    let place = self::place();
    trained(&place, "Draws-v0", &["--set", "environment.dies=always"]);
    let message = error_line(&place.output(&["film", "run"]));
    assert!(message.contains("the episode was begun 5 times"), "{message}");
    assert!(!place.path().join("run/film.gif").exists() && !place.path().join("run/film.gif.new").exists());
}
