//! `shoal top`: a run on the whole terminal, until somebody leaves.

use std::io::IsTerminal;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, bail};
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use shoal_common::config::{Config, Mode};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use super::status::rest;
use crate::cli::TopArgs;
use crate::remote::Remote;
use crate::top::{Link, Screen, draw};

/// How long a key, a signal or news may lie unread.
const LOOK: Duration = Duration::from_millis(200);

/// Shows the run until `q` or a signal; the terminal is then as it was.
pub(crate) fn run(args: &TopArgs) -> anyhow::Result<ExitCode> {
    let remote = Remote::open(&args.run)?;
    if !(std::io::stdout().is_terminal() && std::io::stdin().is_terminal()) {
        bail!(
            "shoal top draws on a terminal, and this is none; `shoal status {} --watch` writes lines",
            args.run.display()
        );
    }
    if remote.status()?.is_none() {
        return rest(&args.run, false, &remote);
    }
    let signal = watched_signals()?;
    let here = args.run.display().to_string();
    let mut screen = Screen::new(here, task(&remote.config), colours());
    let link = Link::new(remote)?;
    let restored = Restored;
    let mut terminal = ratatui::try_init().context("cannot draw on this terminal")?;
    let shown = show(&mut terminal, &mut screen, &link, &signal);
    drop(restored);
    link.close();
    shown?;
    match signal.load(Ordering::Relaxed) {
        0 => Ok(ExitCode::SUCCESS),
        // As a shell reports a process that the signal ended.
        signal => Ok(ExitCode::from(128 + signal as u8)),
    }
}

/// Gives the terminal back when dropped. (A panic does so before it says anything: `try_init` sees to that.)
struct Restored;

impl Drop for Restored {
    fn drop(&mut self) {
        // There may be no terminal any more.
        let _ = ratatui::try_restore();
    }
}

fn show(terminal: &mut DefaultTerminal, screen: &mut Screen, link: &Link, signal: &AtomicUsize) -> anyhow::Result<()> {
    let mut changed = true;
    while signal.load(Ordering::Relaxed) == 0 {
        if changed {
            terminal
                .draw(|frame| draw(frame, screen))
                .context("cannot draw on this terminal")?;
        }
        changed = false;
        if event::poll(LOOK).context("cannot read the keyboard")? {
            changed = true;
            match event::read().context("cannot read the keyboard")? {
                Event::Key(key) if leaves(&key) => return Ok(()),
                Event::Key(KeyEvent {
                    code: KeyCode::Char(key),
                    kind: KeyEventKind::Press,
                    ..
                }) => {
                    if let Some(order) = screen.press(key) {
                        link.order(order);
                    }
                }
                Event::Key(_) => {
                    // Any key closes what lies over the picture.
                    let _ = screen.press('n');
                }
                _ => {}
            }
        }
        for news in link.heard()? {
            changed = true;
            screen.hear(news);
        }
    }
    Ok(())
}

/// Ctrl-C comes as a key here.
fn leaves(key: &KeyEvent) -> bool {
    let control = key.modifiers.contains(KeyModifiers::CONTROL);
    matches!(key.code, KeyCode::Char('q')) || (control && matches!(key.code, KeyCode::Char('c')))
}

/// The number of the signal that has come; 0 before one has.
fn watched_signals() -> anyhow::Result<Arc<AtomicUsize>> {
    let signal = Arc::new(AtomicUsize::new(0));
    for number in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register_usize(number, Arc::clone(&signal), number as usize)
            .context("cannot watch for signals")?;
    }
    Ok(signal)
}

/// Whether colours are welcome (no-color.org: any value of the variable but none says no).
fn colours() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

fn task(config: &Config) -> String {
    let mode = match config.run.mode {
        Mode::Free => "free",
        Mode::Lockstep => "lockstep",
    };
    format!("{}, {}, {mode}", config.environment.name, config.algorithm.name())
}
