//! Reads a child process's standard error on a thread. Any output takes bounded memory and bounded space in the log,
//! and is harmless to a terminal that shows it.

use std::fmt::Write as _;
use std::io::{self, Read};
use std::sync::mpsc::{self, Receiver, Sender};
use std::time::{Duration, Instant};

/// Bytes kept of a line.
const LINE: usize = 4096;

/// Bytes that a child may write in a burst, and bytes per second that it may write permanently.
const BURST: f64 = 4.0 * 1024.0 * 1024.0;
const RATE: f64 = 256.0 * 1024.0;

/// How long to wait for the last output of a process that has ended. It arrives at once unless another process keeps
/// the pipe open.
const LAST_OUTPUT: Duration = Duration::from_millis(200);

/// The thread that reads a child's output.
#[derive(Debug)]
pub struct ChildOutput {
    all_read: Receiver<()>,
}

impl ChildOutput {
    /// Starts to pass each line of `from` to `take`.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn read(
        name: &str,
        from: impl Read + Send + 'static,
        take: impl FnMut(&str) + Send + 'static,
    ) -> io::Result<Self> {
        let (sender, all_read) = mpsc::channel();
        std::thread::Builder::new()
            .name(name.into())
            .spawn(move || forward(from, take, &sender))?;
        Ok(Self { all_read })
    }

    /// Waits briefly until all output has been passed on.
    pub fn wait(&self) {
        // A timeout and the thread's end are both fine.
        let _ = self.all_read.recv_timeout(LAST_OUTPUT);
    }
}

fn forward(mut from: impl Read, mut take: impl FnMut(&str), _all_read: &Sender<()>) {
    let mut lines = Lines::default();
    let mut bytes = [0; 8192];
    loop {
        match from.read(&mut bytes) {
            Ok(0) => break,
            Ok(read) => lines.add(&bytes[..read], Instant::now(), &mut take),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(_) => break,
        }
    }
    lines.end(&mut take);
}

/// Splits bytes into lines and applies the limits.
struct Lines {
    line: Vec<u8>,
    /// Bytes dropped from the current line.
    cut: usize,
    /// Bytes that the child may write now.
    allowance: f64,
    counted: Option<Instant>,
    left_out: u64,
}

impl Default for Lines {
    fn default() -> Self {
        Self {
            line: Vec::new(),
            cut: 0,
            allowance: BURST,
            counted: None,
            left_out: 0,
        }
    }
}

impl Lines {
    fn add(&mut self, bytes: &[u8], now: Instant, take: &mut impl FnMut(&str)) {
        let since = self.counted.replace(now).map_or(Duration::ZERO, |then| now - then);
        self.allowance = BURST.min(self.allowance + RATE * since.as_secs_f64());
        let mut pieces = bytes.split(|byte| *byte == b'\n').peekable();
        while let Some(piece) = pieces.next() {
            let kept = piece.len().min(LINE.saturating_sub(self.line.len()));
            self.line.extend_from_slice(&piece[..kept]);
            self.cut += piece.len() - kept;
            if pieces.peek().is_some() {
                self.take_line(take);
            }
        }
    }

    fn take_line(&mut self, take: &mut impl FnMut(&str)) {
        let length = self.line.len() as f64;
        if self.allowance < length {
            self.left_out += 1;
        } else {
            self.allowance -= length;
            self.report_left_out(take);
            let mut text = harmless(&String::from_utf8_lossy(&self.line));
            if self.cut > 0 {
                text += &format!(" … ({} more bytes)", self.cut);
            }
            take(&text);
        }
        self.line.clear();
        self.cut = 0;
    }

    fn report_left_out(&mut self, take: &mut impl FnMut(&str)) {
        if self.left_out > 0 {
            take(&format!("… ({} lines left out: too many at once)", self.left_out));
            self.left_out = 0;
        }
    }

    fn end(&mut self, take: &mut impl FnMut(&str)) {
        if !self.line.is_empty() {
            self.take_line(take);
        }
        self.report_left_out(take);
    }
}

/// The text with control characters escaped. Otherwise they could move a terminal's cursor, change its colours or send
/// input in the user's name.
pub fn harmless(text: &str) -> String {
    let mut harmless = String::with_capacity(text.len());
    for character in text.trim_end_matches('\r').chars() {
        if character.is_control() && character != '\t' {
            // Writing into a string does not fail.
            let _ = write!(harmless, "{}", character.escape_default());
        } else {
            harmless.push(character);
        }
    }
    harmless
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines_of(pieces: &[&[u8]]) -> Vec<String> {
        let (mut lines, mut taken) = (Lines::default(), Vec::new());
        let now = Instant::now();
        let mut take = |line: &str| taken.push(line.to_owned());
        for piece in pieces {
            lines.add(piece, now, &mut take);
        }
        lines.end(&mut take);
        taken
    }

    #[test]
    fn pieces_are_joined_to_lines_and_the_last_needs_no_newline() {
        assert_eq!(lines_of(&[b"a", b"b\nc\n\nd"]), ["ab", "c", "", "d"]);
        assert_eq!(lines_of(&[b"a\r\n"]), ["a"]);
    }

    #[test]
    fn an_endless_line_is_cut_and_takes_bounded_memory() {
        let mut lines = Lines::default();
        let (now, mut taken) = (Instant::now(), Vec::new());
        let mut take = |line: &str| taken.push(line.to_owned());
        for _ in 0..1000 {
            lines.add(&[b'x'; 8192], now, &mut take);
            assert!(lines.line.capacity() <= 2 * LINE);
        }
        lines.end(&mut take);
        assert_eq!(taken.len(), 1);
        assert!(
            taken[0].ends_with(&format!("({} more bytes)", 8_192_000 - LINE)),
            "{}",
            taken[0]
        );
    }

    #[test]
    fn a_flood_is_cut_and_later_lines_are_kept() {
        let (mut lines, mut taken) = (Lines::default(), 0);
        let (now, mut last) = (Instant::now(), String::new());
        let line = [[b'x'; 99].as_slice(), b"\n"].concat();
        for _ in 0..1_000_000 {
            lines.add(&line, now, &mut |_: &str| taken += 1);
        }
        assert!(taken < 50_000, "{taken}");
        lines.add(b"later\n", now + Duration::from_secs(1), &mut |line: &str| {
            taken += 1;
            last = line.to_owned();
        });
        assert_eq!(last, "later");
    }

    #[test]
    fn control_characters_are_escaped() {
        assert_eq!(lines_of(&[b"\x1b[31mred\x07\ttab\n"]), ["\\u{1b}[31mred\\u{7}\ttab"]);
    }
}
