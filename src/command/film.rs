//! `shoal film`: plays a run's policy and writes what is seen into a GIF or a video.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use shoal_common::run_dir::RunDir;
use shoal_report::film::{Format, Request, Shown, film};
use shoal_run::evaluation::SavedPolicy;
use shoal_run::numbers::{parse_count, thousands};
use shoal_run::signals::{Signals, describe, exit_code};

use super::output_file::check_replaceable;

#[derive(Args, Clone, Debug)]
pub(crate) struct FilmArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Which policy to play.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) policy: SavedPolicy,
    /// Number of episodes. They start in the same states as in `eval`.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=50))]
    pub(crate) episodes: u32,
    /// Seed of the start states [default: the run's seed].
    #[arg(long, value_parser = parse_count)]
    pub(crate) seed: Option<u64>,
    /// The file to write; its name ends in .gif or, for a video made by the program ffmpeg, in .mp4 [default: film.gif
    /// in the run directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Height in pixels. Frames of Gymnasium environments are not enlarged.
    #[arg(long, value_name = "PIXELS", default_value_t = 320, value_parser = clap::value_parser!(u32).range(32..=2048))]
    pub(crate) size: u32,
    /// Steps shown in a second [default: as many as the environment's time says].
    #[arg(long, value_name = "STEPS", value_parser = parse_steps_per_second)]
    pub(crate) fps: Option<f64>,
}

/// The default name of the film.
const NAME: &str = "film.gif";

/// Steps in a second, from 0.1 to 1,000.
fn parse_steps_per_second(text: &str) -> Result<f64, String> {
    let fps = text.parse().ok().filter(|fps| (0.1..=1_000.0).contains(fps));
    fps.ok_or_else(|| "give a number from 0.1 to 1000".into())
}

/// Plays the episodes, writes the film and prints its path. A signal ends it in order.
pub(crate) fn run(args: &FilmArgs) -> anyhow::Result<ExitCode> {
    let run = RunDir::open(&args.run)?;
    let config = run.config()?;
    let policy = args.policy.read(&run, &config)?;
    let out = args.out.clone().unwrap_or_else(|| run.path().join(NAME));
    let format = Format::of(&out)?;
    check_replaceable(&out, "a film", |start| format.is(start))?;
    let request = Request {
        parameters: &policy.parameters,
        episodes: args.episodes,
        seed: args.seed.unwrap_or(config.run.seed),
        height: args.size,
        steps_per_second: args.fps,
    };
    let bar = ProgressBar::new_spinner();
    if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}") {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(200));
    let progress = |episode: u32, steps: usize| {
        let steps = thousands(steps as u64);
        bar.set_message(format!(
            "filming episode {} of {}: step {steps}",
            episode + 1,
            args.episodes
        ));
    };
    let signals = Signals::register()?;
    let interrupt = signals.interrupt();
    let filmed = film(&run, &config, request, (&out, format), &interrupt, progress);
    bar.finish_and_clear();
    if let (Err(_), Some(signal)) = (&filmed, interrupt.signal()) {
        let signal_name = describe(signal);
        writeln!(
            std::io::stderr(),
            "the film was ended by {signal_name}; nothing of it is kept"
        )?;
        return Ok(exit_code(signal));
    }
    let shown = filmed?;
    writeln!(std::io::stderr().lock(), "{}", in_words(&shown))?;
    writeln!(std::io::stdout().lock(), "{}", out.display())?;
    Ok(ExitCode::SUCCESS)
}

/// The film in a line.
fn in_words(shown: &Shown) -> String {
    let episode = |(episode_return, steps): &(f64, usize)| format!("return {episode_return:.2} in {steps} steps");
    let episodes: Vec<String> = shown.episodes.iter().map(episode).collect();
    format!("a film of {:.1} s: {}", shown.seconds, episodes.join("; "))
}
