use shoal_env_server::environment::SignalSource;
use shoal_env_server::frame::Image;
use shoal_run::testing::{run_with_policy, small};

use super::gif::tests::decoded;
use super::paint::Painter;
use super::writer::PAUSE;
use super::*;

fn filmed(environment: &str, episodes: u32) -> (Config, Vec<f32>, Vec<(Image, u16)>, Shown) {
    let parent = tempfile::tempdir().unwrap();
    let (config, parameters) = small(environment);
    let run = run_with_policy(parent.path(), "run", &config, Some(parameters.clone()));
    let out = parent.path().join("film.gif");
    let request = Request {
        parameters: &parameters,
        episodes,
        seed: 4,
        height: 140,
        steps_per_second: None,
    };
    let none = Interrupt::default();
    let shown = film(&run, &config, request, (&out, Format::Gif), &none, |_, _| ()).unwrap();
    let pictures = decoded(&std::fs::read(&out).unwrap());
    assert!(!out.with_extension("gif.new").exists());
    (config, parameters, pictures, shown)
}

/// The middle of the pixels that have this colour.
fn middle(image: &Image, colour: [u8; 3]) -> [f64; 2] {
    let of_colour = |i: &usize| image.rgb[3 * i..3 * i + 3] == colour;
    let places: Vec<usize> = (0..image.width * image.height).filter(of_colour).collect();
    let mean = |of: fn(usize, usize) -> usize| {
        let sum: usize = places.iter().map(|place| of(*place, image.width)).sum();
        sum as f64 / places.len() as f64 + 0.5
    };
    [mean(|place, width| place % width), mean(|place, width| place / width)]
}

#[test]
fn the_pendulums_bob_is_where_its_angle_says() {
    let (config, parameters, pictures, shown) = filmed("name = \"pendulum\"\ntime_limit = 40", 2);
    // The last picture of an episode shows its last state.
    assert_eq!(pictures.len(), 2 * 41);
    assert_eq!((pictures[0].0.width, pictures[0].0.height), (160, 140));
    assert!(pictures[..40].iter().all(|(_, delay)| *delay == 5), "real time");
    assert!((shown.seconds - 2.0 * (2.0 + PAUSE)).abs() < 1e-9);
    let mut rollout = Rollout::new(&config, &parameters).unwrap();
    for (number, pictures) in pictures.chunks(41).enumerate() {
        let trajectory = rollout.evaluation_episode(4, number as u64).unwrap();
        assert_eq!(shown.episodes[number], (trajectory.episode_return(), 40));
        let angles = trajectory.values(SignalSource::Angle { cos: 0, sin: 1 });
        assert_eq!(angles.len(), pictures.len());
        for (angle, (picture, _)) in angles.iter().zip(pictures) {
            // 50 pixels are 1 m; the joint is in the middle; angles grow counterclockwise from upright.
            let bob = [80.0 - 50.0 * angle.sin(), 70.0 - 50.0 * angle.cos()];
            let [x, y] = middle(picture, [0, 103, 163]);
            assert!((x - bob[0]).hypot(y - bob[1]) < 1.0, "bob at {bob:?}, seen at {x} {y}");
        }
    }
}

#[test]
fn a_long_film_is_thinned_out_and_lasts_as_long() {
    let (_, _, pictures, shown) = filmed("name = \"pendulum\"\ntime_limit = 2000", 1);
    assert!(
        (PICTURES_OF_GIF / 2..=PICTURES_OF_GIF + 1).contains(&pictures.len()),
        "{}",
        pictures.len()
    );
    assert!(
        (shown.seconds - (2000.0 * 0.05 + PAUSE)).abs() < 0.05,
        "{}",
        shown.seconds
    );
}

#[test]
fn every_builtin_environment_draws_itself_and_an_action_shows() {
    for name in shoal_env_server::environment::names() {
        let environment = shoal_env_server::environment::make(name, &toml::Table::new()).unwrap();
        let with = |action: &[f64]| {
            let drawing = environment.draw(action).unwrap();
            Painter::new(100).paint(&drawing).unwrap()
        };
        let acted = with(&vec![1.0; environment.spec().action.width()]);
        assert_ne!(with(&[]), acted, "{name}");
        let body = middle(&acted, [0, 103, 163]);
        assert!(body[0].is_finite(), "{name}: something moves");
        // A number of any kind does no harm.
        for number in [f64::NAN, f64::INFINITY, -1e300] {
            with(&vec![number; environment.spec().action.width()]);
        }
    }
}

#[test]
fn a_film_that_fails_leaves_no_file() {
    let parent = tempfile::tempdir().unwrap();
    let (config, parameters) = small("name = \"pendulum\"");
    let run = run_with_policy(parent.path(), "run", &config, Some(parameters.clone()));
    let out = parent.path().join("film.gif");
    let request = Request {
        parameters: &parameters[1..],
        episodes: 1,
        seed: 1,
        height: 100,
        steps_per_second: None,
    };
    let none = Interrupt::default();
    let film = |out: &Path| film(&run, &config, request, (out, Format::Gif), &none, |_, _| ());
    let error = film(&out).unwrap_err().to_string();
    assert!(error.contains("34 parameters"), "{error}");
    assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 1, "only the run");
}

#[test]
fn a_films_format_is_that_of_its_name() {
    assert_eq!(Format::of(Path::new("a/b.GIF")).unwrap(), Format::Gif);
    for name in ["film", "film.avi", "gif"] {
        let error = Format::of(Path::new(name)).unwrap_err().to_string();
        assert!(error.contains(".gif or .mp4"), "{error}");
    }
    assert!(Format::Gif.is(b"GIF89a...") && !Format::Gif.is(b"...."));
    assert!(Format::Mp4.is(b"\0\0\0\x20ftypisom") && !Format::Mp4.is(b"GIF89a"));
}
