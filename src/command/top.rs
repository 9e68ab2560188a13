//! `shoal top`: shows a run on the full terminal.

use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use ratatui::DefaultTerminal;
use ratatui::layout::Size;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use shoal_common::config::{Config, Mode};
use shoal_run::client::RunClient;
use shoal_run::signals::{Signals, exit_code};
use signal_hook::consts::SIGHUP;

use super::status::show_saved;
use crate::top::{Key, LauncherLink, Screen, draw, keys};

#[derive(Args, Clone, Debug)]
pub(crate) struct TopArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
}

/// The longest delay until a key, a signal or an event is handled.
const TICK: Duration = Duration::from_millis(200);

/// How long the main loop may take to end after a signal. A tick and the wait in `LauncherLink::close` take less.
const END_TIMEOUT: Duration = Duration::from_secs(3);

/// Shows the run until `q` or a signal, and then restores the terminal.
pub(crate) fn run(args: &TopArgs) -> anyhow::Result<ExitCode> {
    let client = RunClient::open(&args.run)?;
    if !(std::io::stdout().is_terminal() && std::io::stdin().is_terminal()) {
        bail!(
            "shoal top draws on a terminal, and this is not one; use `shoal status {} --watch`",
            args.run.display()
        );
    }
    if client.status()?.is_none() {
        return show_saved(&args.run, false, &client);
    }
    let signal = watched_signals()?;
    let here = args.run.display().to_string();
    let mut screen = Screen::new(here, task(&client.config), colours());
    let link = LauncherLink::new(client)?;
    let restore = RestoreOnDrop;
    let mut terminal = ratatui::try_init().context("cannot draw on this terminal")?;
    let shown = show(&mut terminal, &mut screen, &link, &signal);
    drop(restore);
    link.close();
    shown?;
    match signal.load(Ordering::Relaxed) {
        0 => Ok(ExitCode::SUCCESS),
        signal => Ok(exit_code(signal as i32)),
    }
}

/// Restores the terminal on drop. (After a panic, the hook of `try_init` restores it before the message is printed.)
struct RestoreOnDrop;

impl Drop for RestoreOnDrop {
    fn drop(&mut self) {
        // The terminal may be gone.
        let _ = ratatui::try_restore();
    }
}

fn show(
    terminal: &mut DefaultTerminal,
    screen: &mut Screen,
    link: &LauncherLink,
    signal: &AtomicUsize,
) -> anyhow::Result<()> {
    let mut changed = true;
    let mut size = Size::ZERO;
    while signal.load(Ordering::Relaxed) == 0 {
        let now = terminal.size().context("cannot ask for the size of this terminal")?;
        if changed || now != size {
            terminal
                .draw(|frame| draw(frame, screen))
                .context("cannot draw on this terminal")?;
        }
        (changed, size) = (false, now);
        match wait_for_input()? {
            Input::Nothing => {}
            Input::Something => {
                changed = true;
                if read_keys(screen, link)? {
                    return Ok(());
                }
            }
            Input::Gone => signal.store(SIGHUP as usize, Ordering::Relaxed),
        }
        for event in link.events()? {
            changed = true;
            screen.handle(event);
        }
    }
    Ok(())
}

/// The result of a wait for the keyboard.
enum Input {
    Nothing,
    Something,
    /// The terminal is gone.
    Gone,
}

/// Waits a tick for a key. Detects here that the terminal is gone, because a read would never return then.
fn wait_for_input() -> anyhow::Result<Input> {
    let stdin = std::io::stdin();
    let mut fds = [PollFd::new(&stdin, PollFlags::IN)];
    let tick = Timespec::try_from(TICK).context("cannot wait for the keyboard")?;
    match poll(&mut fds, Some(&tick)) {
        Err(Errno::INTR) => return Ok(Input::Nothing),
        polled => polled.context("cannot wait for the keyboard")?,
    };
    let events = fds[0].revents();
    Ok(
        if events.intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL) {
            Input::Gone
        } else if events.contains(PollFlags::IN) {
            Input::Something
        } else {
            Input::Nothing
        },
    )
}

/// Handles the keys that were pressed; returns whether one of them quits. There must be input.
fn read_keys(screen: &mut Screen, link: &LauncherLink) -> anyhow::Result<bool> {
    let mut bytes = [0; 256];
    let count = match rustix::io::read(std::io::stdin(), &mut bytes) {
        Err(Errno::INTR) => return Ok(false),
        Ok(0) => bail!("the keyboard is closed"),
        read => read.context("cannot read the keyboard")?,
    };
    for key in keys(&bytes[..count]) {
        match key {
            Key::Quit => return Ok(true),
            Key::Char(char) => {
                if let Some(request) = screen.press(char) {
                    link.request(request);
                }
            }
        }
    }
    Ok(false)
}

/// Starts a thread that watches for signals. Returns the number of the one that has arrived, 0 until then. The thread
/// ends the process if the main loop hangs after a signal.
fn watched_signals() -> anyhow::Result<Arc<AtomicUsize>> {
    let signal = Arc::new(AtomicUsize::new(0));
    let signals = Signals::register()?;
    let received = Arc::clone(&signal);
    let watch = move || {
        let number = loop {
            if let Some(number) = signals.wait(TICK) {
                break number;
            }
        };
        received.store(number as usize, Ordering::Relaxed);
        std::thread::sleep(END_TIMEOUT);
        let _ = ratatui::try_restore();
        std::process::exit(128 + number);
    };
    let watch = std::thread::Builder::new().name("signals".into()).spawn(watch);
    watch.context("cannot watch for signals")?;
    Ok(signal)
}

/// Whether to use colours: not if `NO_COLOR` is set and not empty (no-color.org).
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
