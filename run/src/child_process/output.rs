//! Reads a child process's standard error on a thread. The output of another program takes bounded memory, and its rate
//! in the log is limited. Control characters are escaped, so that a terminal can show the output safely.

use std::fmt::Write as _;
use std::io::{self, Read};
use std::sync::mpsc::{self, Receiver, Sender};
use std::time::{Duration, Instant};

/// Bytes kept of a line of another program, and of a line of Shoal itself, which never writes longer ones.
const LINE: usize = 4096;
const OWN_LINE: usize = 1024 * 1024;

/// Bytes that another program may write in a burst, and bytes per second that it may write for a long time.
const BURST: f64 = 4.0 * 1024.0 * 1024.0;
const RATE: f64 = 256.0 * 1024.0;

/// How long to wait for the last output of a process that has ended. It arrives at once unless another process keeps
/// the pipe open.
const LAST_OUTPUT_TIMEOUT: Duration = Duration::from_millis(500);

/// Whose output it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutputSource {
    /// Shoal itself: there is no limit.
    Shoal,
    /// Another program, such as the server of an environment.
    Program,
}

/// A line of output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Line<'a> {
    /// A line for the log.
    Kept(&'a str),
    /// A line beyond the rate. It is not for the log, unless it turns out to be one of the last before the program
    /// failed.
    OverLimit(&'a str),
    /// The number of lines beyond the rate since the last kept line.
    Omitted(u64),
}

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
        source: OutputSource,
        take: impl FnMut(Line<'_>) + Send + 'static,
    ) -> io::Result<Self> {
        let (sender, all_read) = mpsc::channel();
        std::thread::Builder::new()
            .name(name.into())
            .spawn(move || forward(from, Lines::new(source), take, &sender))?;
        Ok(Self { all_read })
    }

    /// Waits briefly until all output has been passed on.
    pub fn wait(&self) {
        // A timeout and the thread's end are both fine.
        let _ = self.all_read.recv_timeout(LAST_OUTPUT_TIMEOUT);
    }
}

fn forward(mut from: impl Read, mut lines: Lines, mut take: impl FnMut(Line<'_>), _all_read: &Sender<()>) {
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
    source: OutputSource,
    line: Vec<u8>,
    /// Bytes dropped from the current line.
    cut: usize,
    /// Bytes that the child may write now.
    allowance: f64,
    allowance_updated_at: Option<Instant>,
    left_out: u64,
}

impl Lines {
    fn new(source: OutputSource) -> Self {
        Self {
            source,
            line: Vec::new(),
            cut: 0,
            allowance: BURST,
            allowance_updated_at: None,
            left_out: 0,
        }
    }

    fn add(&mut self, bytes: &[u8], now: Instant, take: &mut impl FnMut(Line<'_>)) {
        let longest = match self.source {
            OutputSource::Shoal => OWN_LINE,
            OutputSource::Program => LINE,
        };
        let since = self
            .allowance_updated_at
            .replace(now)
            .map_or(Duration::ZERO, |then| now - then);
        self.allowance = BURST.min(self.allowance + RATE * since.as_secs_f64());
        let mut pieces = bytes.split(|byte| *byte == b'\n').peekable();
        while let Some(piece) = pieces.next() {
            let kept = piece.len().min(longest.saturating_sub(self.line.len()));
            self.line.extend_from_slice(&piece[..kept]);
            self.cut += piece.len() - kept;
            if pieces.peek().is_some() {
                self.take_line(take);
            }
        }
    }

    fn take_line(&mut self, take: &mut impl FnMut(Line<'_>)) {
        let length = self.line.len() as f64;
        let mut text = escape_control_characters(&String::from_utf8_lossy(&self.line));
        if self.cut > 0 {
            text += &format!(" … ({} more bytes)", self.cut);
        }
        if self.source == OutputSource::Program && self.allowance < length {
            self.left_out += 1;
            take(Line::OverLimit(&text));
        } else {
            self.allowance -= length;
            self.report_left_out(take);
            take(Line::Kept(&text));
        }
        self.line.clear();
        self.cut = 0;
    }

    fn report_left_out(&mut self, take: &mut impl FnMut(Line<'_>)) {
        if self.left_out > 0 {
            take(Line::Omitted(self.left_out));
            self.left_out = 0;
        }
    }

    fn end(&mut self, take: &mut impl FnMut(Line<'_>)) {
        if !self.line.is_empty() {
            self.take_line(take);
        }
        self.report_left_out(take);
    }
}

/// The text with control characters escaped. Otherwise they could move a terminal's cursor, change its colours or send
/// input in the user's name.
pub fn escape_control_characters(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.trim_end_matches('\r').chars() {
        if character.is_control() && character != '\t' {
            // Writing into a string does not fail.
            let _ = write!(escaped, "{}", character.escape_default());
        } else {
            escaped.push(character);
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(line: Line<'_>) -> String {
        let Line::Kept(text) = line else {
            panic!("{line:?} was not kept");
        };
        text.to_owned()
    }

    fn lines_of(pieces: &[&[u8]]) -> Vec<String> {
        let (mut lines, mut taken) = (Lines::new(OutputSource::Program), Vec::new());
        let now = Instant::now();
        let mut take = |line: Line<'_>| taken.push(kept(line));
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
        let mut lines = Lines::new(OutputSource::Program);
        let (now, mut taken) = (Instant::now(), Vec::new());
        let mut take = |line: Line<'_>| taken.push(kept(line));
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
        let flood = |source: OutputSource| {
            let mut lines = Lines::new(source);
            let (now, mut taken, mut last, mut left_out) = (Instant::now(), 0, String::new(), 0);
            let mut take = |line: Line<'_>| match line {
                Line::Kept(text) => {
                    taken += 1;
                    last = text.to_owned();
                }
                Line::OverLimit(text) => last = text.to_owned(),
                Line::Omitted(count) => left_out += count,
            };
            for i in 0..200_000 {
                lines.add(format!("{i:099}\n").as_bytes(), now, &mut take);
            }
            lines.add(b"why it ends\n", now, &mut take);
            lines.add(b"later\n", now + Duration::from_secs(1), &mut take);
            lines.end(&mut take);
            (taken, last, left_out)
        };
        let (taken, last, left_out) = flood(OutputSource::Program);
        assert!(taken < 50_000 && taken + left_out == 200_002, "{taken} {left_out}");
        assert_eq!(last, "later");
        assert_eq!(
            flood(OutputSource::Shoal),
            (200_002, "later".into(), 0),
            "its own lines are all kept"
        );
    }

    #[test]
    fn the_last_line_of_a_flood_is_passed_on() {
        let (mut lines, mut last) = (Lines::new(OutputSource::Program), String::new());
        let mut take = |line: Line<'_>| {
            if let Line::OverLimit(text) = line {
                last = text.to_owned();
            }
        };
        let now = Instant::now();
        lines.add(&b"noise\n".repeat(1_000_000), now, &mut take);
        lines.add(b"why it ends", now, &mut take);
        lines.end(&mut take);
        assert_eq!(last, "why it ends");
    }

    #[test]
    fn control_characters_are_escaped() {
        assert_eq!(lines_of(&[b"\x1b[31mred\x07\ttab\n"]), ["\\u{1b}[31mred\\u{7}\ttab"]);
    }
}
