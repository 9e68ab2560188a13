//! `shoal top`: a run on the whole terminal, until somebody leaves.

use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use shoal_common::config::{Config, Mode};
use shoal_run::remote::Remote;
use shoal_run::signals::{Signals, exit_code};
use signal_hook::consts::SIGHUP;

use super::status::rest;
use crate::top::{Link, Screen, draw};

#[derive(Args, Clone, Debug)]
pub(crate) struct TopArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
}

/// How long a key, a signal or news may lie unread.
const LOOK: Duration = Duration::from_millis(200);

/// How long the picture's loop may take to end after a signal: a look, and what `Link::close` waits for.
const TO_THE_END: Duration = Duration::from_secs(3);

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
        signal => Ok(exit_code(signal as i32)),
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
        match awaited()? {
            Input::Nothing => {}
            Input::Something => {
                changed = true;
                if read_keys(screen, link)? {
                    return Ok(());
                }
            }
            Input::Gone => signal.store(SIGHUP as usize, Ordering::Relaxed),
        }
        for news in link.heard()? {
            changed = true;
            screen.hear(news);
        }
    }
    Ok(())
}

/// What a wait for the keyboard came to.
enum Input {
    Nothing,
    Something,
    /// There is no terminal any more.
    Gone,
}

/// Waits a moment for a key. A terminal that has gone is told here, because who reads on never comes back from it.
fn awaited() -> anyhow::Result<Input> {
    let stdin = std::io::stdin();
    let mut fds = [PollFd::new(&stdin, PollFlags::IN)];
    let moment = Timespec::try_from(LOOK).context("cannot wait for the keyboard")?;
    match poll(&mut fds, Some(&moment)) {
        // A signal: the window may have another size.
        Err(Errno::INTR) => return Ok(Input::Something),
        told => told.context("cannot wait for the keyboard")?,
    };
    let told = fds[0].revents();
    Ok(if told.intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL) {
        Input::Gone
    } else if told.contains(PollFlags::IN) {
        Input::Something
    } else {
        Input::Nothing
    })
}

/// Takes in the keys that were pressed; whether one of them leaves.
fn read_keys(screen: &mut Screen, link: &Link) -> anyhow::Result<bool> {
    while event::poll(Duration::ZERO).context("cannot read the keyboard")? {
        let Event::Key(key) = event::read().context("cannot read the keyboard")? else {
            continue;
        };
        if leaves(&key) {
            return Ok(true);
        }
        // Any key closes what lies over the picture.
        let pressed = key.code.as_char().filter(|_| key.kind == KeyEventKind::Press);
        if let Some(order) = screen.press(pressed.unwrap_or(' ')) {
            link.order(order);
        }
    }
    Ok(false)
}

/// Ctrl-C comes as a key here.
fn leaves(key: &KeyEvent) -> bool {
    let control = key.modifiers.contains(KeyModifiers::CONTROL);
    matches!(key.code, KeyCode::Char('q')) || (control && matches!(key.code, KeyCode::Char('c')))
}

/// The number of the signal that has come; 0 before one has. Should the picture's loop hang, the process ends all the same.
fn watched_signals() -> anyhow::Result<Arc<AtomicUsize>> {
    let signal = Arc::new(AtomicUsize::new(0));
    let signals = Signals::register()?;
    let received = Arc::clone(&signal);
    let watch = move || {
        let number = loop {
            if let Some(number) = signals.wait(LOOK) {
                break number;
            }
        };
        received.store(number as usize, Ordering::Relaxed);
        std::thread::sleep(TO_THE_END);
        let _ = ratatui::try_restore();
        std::process::exit(128 + number);
    };
    let watch = std::thread::Builder::new().name("signals".into()).spawn(watch);
    watch.context("cannot watch for signals")?;
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
