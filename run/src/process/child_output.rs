//! What a child process writes on its standard error, read on a thread of its own: whatever that is, it costs bounded memory
//! and a bounded log, and does nothing to a terminal it is shown on.

use std::fmt::Write as _;
use std::io::{self, Read};
use std::sync::mpsc::{self, Receiver, Sender};
use std::time::{Duration, Instant};

/// Bytes of a line that are kept.
const LINE: usize = 4096;

/// Bytes a child may write at once, and each second for ever.
const BURST: f64 = 4.0 * 1024.0 * 1024.0;
const RATE: f64 = 256.0 * 1024.0;

/// How long the last words of a process that has ended are waited for. They are there at once, unless a child of its own
/// keeps the pipe open.
const LAST_WORDS: Duration = Duration::from_millis(200);

/// A child's output that is being read.
#[derive(Debug)]
pub struct ChildOutput {
    all_read: Receiver<()>,
}

impl ChildOutput {
    /// Hands each line of `from` to `take`.
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

    /// Waits until all that the child wrote is handed over, but not for long.
    pub fn wait(&self) {
        // Either answer will do.
        let _ = self.all_read.recv_timeout(LAST_WORDS);
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

/// Bytes that are becoming lines.
struct Lines {
    line: Vec<u8>,
    /// Bytes of the line that were not kept.
    cut: usize,
    /// Bytes that may be written now.
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
            self.tell_what_is_left_out(take);
            let mut text = harmless(&String::from_utf8_lossy(&self.line));
            if self.cut > 0 {
                text += &format!(" … ({} more bytes)", self.cut);
            }
            take(&text);
        }
        self.line.clear();
        self.cut = 0;
    }

    fn tell_what_is_left_out(&mut self, take: &mut impl FnMut(&str)) {
        if self.left_out > 0 {
            take(&format!("… ({} lines left out: too many at once)", self.left_out));
            self.left_out = 0;
        }
    }

    fn end(&mut self, take: &mut impl FnMut(&str)) {
        if !self.line.is_empty() {
            self.take_line(take);
        }
        self.tell_what_is_left_out(take);
    }
}

/// The text without characters that would move a terminal's cursor, change its colours or answer for its user.
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
    fn pieces_become_lines_and_the_last_needs_no_end() {
        assert_eq!(lines_of(&[b"a", b"b\nc\n\nd"]), ["ab", "c", "", "d"]);
        assert_eq!(lines_of(&[b"a\r\n"]), ["a"]);
    }

    #[test]
    fn a_line_without_an_end_is_cut_and_costs_no_memory() {
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
    fn a_flood_is_left_out_and_told_of() {
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
    fn what_would_command_a_terminal_is_shown_as_what_it_is() {
        assert_eq!(lines_of(&[b"\x1b[31mred\x07\ttab\n"]), ["\\u{1b}[31mred\\u{7}\ttab"]);
    }
}
