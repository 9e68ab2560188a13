//! A pseudo-terminal with a program, and tests of the program's output on it.

use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::OpenOptionsExt;
use std::process::{Child, Command};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rustix::fs::OFlags;
use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{LocalModes, Winsize, tcgetattr, tcsetwinsize};

use crate::support::{QUICK, Workplace, until};

/// A terminal with a program. Dropping it kills the program.
pub(crate) struct Terminal {
    child: Child,
    master: File,
    /// Kept open, so that the terminal's settings can be read after the program has ended.
    slave: File,
    before: LocalModes,
    seen: Arc<Mutex<Seen>>,
}

struct Seen {
    screen: vt100::Parser,
    bytes: Vec<u8>,
}

impl Terminal {
    /// Starts the program with these arguments on a new terminal of 80 × 24.
    pub(crate) fn start(place: &Workplace, arguments: &[&str], no_colour: bool) -> Self {
        let (master, slave) = open();
        let seen = Arc::new(Mutex::new(Seen {
            screen: vt100::Parser::new(24, 80, 0),
            bytes: Vec::new(),
        }));
        let mut command = on(&slave, place, arguments);
        if no_colour {
            command.env("NO_COLOR", "1");
        }
        let terminal = Self {
            before: tcgetattr(&slave).unwrap().local_modes,
            slave,
            master,
            seen,
            child: command.spawn().unwrap(),
        };
        let (seen, mut from) = (Arc::clone(&terminal.seen), terminal.master.try_clone().unwrap());
        std::thread::spawn(move || {
            let mut bytes = [0; 4096];
            while let Ok(count) = from.read(&mut bytes) {
                if count == 0 {
                    return;
                }
                let mut seen = seen.lock().unwrap();
                seen.screen.process(&bytes[..count]);
                seen.bytes.extend(&bytes[..count]);
            }
        });
        terminal
    }

    pub(crate) fn resize(&self, rows: u16, columns: u16) {
        self.seen.lock().unwrap().screen.screen_mut().set_size(rows, columns);
        tcsetwinsize(&self.slave, window(rows, columns)).unwrap();
    }

    pub(crate) fn press(&mut self, keys: &str) {
        self.master.write_all(keys.as_bytes()).unwrap();
    }

    /// The current contents of the terminal.
    pub(crate) fn text(&self) -> String {
        self.seen.lock().unwrap().screen.screen().contents()
    }

    /// Waits until the terminal shows `text`.
    pub(crate) fn shows(&self, text: &str) {
        until(&format!("the terminal shows {text:?}"), || self.text().contains(text));
    }

    /// Everything that was written to the terminal so far.
    pub(crate) fn written(&self) -> String {
        String::from_utf8_lossy(&self.seen.lock().unwrap().bytes).into_owned()
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    pub(crate) fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Waits for the program's end, checks that the terminal's settings are restored, and returns the exit code.
    pub(crate) fn end(&mut self) -> Option<i32> {
        until("the program on the terminal has ended", || !self.is_running());
        let now = tcgetattr(&self.slave).unwrap().local_modes;
        assert_eq!(now, self.before, "lines are edited and echoed as before");
        let seen = Arc::clone(&self.seen);
        until("the alternate screen is closed", || {
            !seen.lock().unwrap().screen.screen().alternate_screen()
        });
        self.child.wait().unwrap().code()
    }
}

/// Opens a terminal of 80 × 24 and returns its two ends.
fn open() -> (File, File) {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname(&master, Vec::new()).unwrap();
    let name = std::ffi::OsStr::from_bytes(name.as_bytes());
    let slave = OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags(OFlags::NOCTTY.bits() as i32)
        .open(name)
        .unwrap();
    tcsetwinsize(&slave, window(24, 80)).unwrap();
    let master = File::from(master);
    (master, slave)
}

/// The command that runs the program with these arguments on a terminal.
fn on(slave: &File, place: &Workplace, arguments: &[&str]) -> Command {
    // A new session, so that this terminal is the controlling one.
    let mut command = Command::new("setsid");
    command
        .args(["--ctty", env!("CARGO_BIN_EXE_shoal")])
        .args(arguments)
        .current_dir(place.path())
        .env("TERM", "xterm-256color")
        .env_remove("NO_COLOR")
        .stdin(slave.try_clone().unwrap())
        .stdout(slave.try_clone().unwrap())
        .stderr(slave.try_clone().unwrap());
    command
}

fn window(rows: u16, columns: u16) -> Winsize {
    Winsize {
        ws_row: rows,
        ws_col: columns,
        ws_xpixel: 0,
        ws_ypixel: 0,
    }
}

#[allow(clippy::print_stderr, reason = "a failed test explains itself")]
impl Drop for Terminal {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("the terminal:\n{}", self.text());
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

const SHORT: [&str; 4] = ["train", "pendulum", "--steps", "600"];

/// Whether an escape sequence sets a colour, of the text or its background.
fn has_colour(written: &str) -> bool {
    let sequences = written.split("\x1b[").skip(1);
    let settings = sequences.filter_map(|rest| rest.split_once('m').map(|(numbers, _)| numbers));
    settings
        .filter(|numbers| numbers.bytes().all(|byte| byte.is_ascii_digit() || byte == b';'))
        .flat_map(|numbers| numbers.split(';'))
        .filter_map(|number| number.parse::<u32>().ok())
        .any(|number| matches!(number, 30..=38 | 40..=48 | 90..=107))
}

#[test]
fn the_live_line_has_colours_unless_no_color_is_set() {
    let place = Workplace::new();
    let written = |no_colour| {
        let mut terminal = Terminal::start(&place, &[&SHORT[..], &QUICK[..]].concat(), no_colour);
        assert_eq!(terminal.end(), Some(0));
        terminal.shows("figures: shoal plot");
        terminal.written()
    };
    let coloured = written(false);
    assert!(coloured.contains("updates") && has_colour(&coloured), "{coloured}");
    let plain = written(true);
    assert!(plain.contains("updates") && !has_colour(&plain), "{plain}");
}

#[test]
fn no_color_also_applies_to_help_and_errors() {
    let place = Workplace::new();
    for arguments in [
        &["--help"][..],
        &["train", "--nonsense"],
        &["train", "pendulums"],
        &["reproduce", "nothing"],
    ] {
        let mut terminal = Terminal::start(&place, arguments, true);
        terminal.end();
        until("something is printed", || !terminal.text().trim().is_empty());
        assert!(!has_colour(&terminal.written()), "{}", terminal.written());
    }
}

#[test]
fn without_a_terminal_there_is_a_line_for_each_evaluation_instead_of_the_live_line() {
    let place = Workplace::new();
    let said = |more: &[&str]| {
        let output = place.output(
            &[
                &SHORT[..],
                &QUICK[..],
                &["--lockstep", "--set", "evaluation.every=200"],
                more,
            ]
            .concat(),
        );
        assert!(output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    let lines = said(&[]);
    let evaluated: Vec<&str> = lines.lines().filter(|line| line.contains("of 600, return ")).collect();
    assert!(
        evaluated.len() == 4 && evaluated.iter().all(|line| line.starts_with("pendulum-1: step ")),
        "{lines}"
    );
    assert!(
        evaluated[0].starts_with("pendulum-1: step 0 of 600, return -"),
        "{lines}"
    );
    assert_eq!(said(&["--quiet"]), "");

    let output = place.output(&[&SHORT[..], &QUICK[..]].concat());
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(
        output.status.success() && message.contains("figures: shoal plot"),
        "{message}"
    );
    assert!(!message.contains(['\x1b', '\r']), "{message}");
}

#[test]
fn top_ends_when_its_terminal_goes_away() {
    let place = Workplace::new();
    let running = place.start("run", &["--steps", "100000000", "--actors", "1"]);
    let (mut master, slave) = open();
    let mut top = on(&slave, &place, &["top", "run"]).spawn().unwrap();
    drop(slave);
    let (sender, receiver) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let (mut seen, mut bytes) = (Vec::new(), [0; 4096]);
        while !String::from_utf8_lossy(&seen).contains("learner") {
            let count = master.read(&mut bytes).unwrap();
            seen.extend(&bytes[..count]);
        }
        let _ = sender.send(master);
    });
    drop(
        receiver
            .recv_timeout(Duration::from_secs(120))
            .expect("top shows the learner"),
    );
    until("top has ended", || top.try_wait().unwrap().is_some());
    running.wait_for_learning();
}
