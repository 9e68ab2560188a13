//! The keys of a terminal in raw mode, from the bytes that it sends.
//!
//! crossterm's own events are not used: if a key arrives together with a change of the terminal's size, crossterm 0.29
//! leaves the key unread until the next one.

/// A key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Key {
    /// `q` or Ctrl-C.
    Quit,
    /// A character of ASCII; any other key counts as a space.
    Char(char),
}

const CONTROL_C: u8 = 3;
const ESCAPE: u8 = 0x1b;

/// The keys in `bytes`, which were read at once.
pub(crate) fn keys(bytes: &[u8]) -> Vec<Key> {
    let mut keys = Vec::new();
    let mut rest = bytes;
    while let Some((first, after)) = rest.split_first() {
        rest = after;
        keys.push(match *first {
            b'q' | CONTROL_C => Key::Quit,
            ESCAPE => {
                rest = after_sequence(after);
                Key::Char(' ')
            }
            b' '..=b'~' => Key::Char(char::from(*first)),
            // The bytes after the first one of a longer character.
            0x80..=0xbf => continue,
            _ => Key::Char(' '),
        });
    }
    keys
}

/// What follows the escape sequence of a key, such as an arrow, or a key with Alt. `bytes` begin after the escape.
fn after_sequence(bytes: &[u8]) -> &[u8] {
    match bytes.split_first() {
        // Parameters, and a letter or ~.
        Some((b'[', sequence)) => {
            let end = sequence.iter().position(|byte| (b'@'..=b'~').contains(byte));
            end.map_or(&[], |end| &sequence[end + 1..])
        }
        Some((b'O', sequence)) => sequence.get(1..).unwrap_or_default(),
        Some((&ESCAPE, _)) | None => bytes,
        Some((_, after)) => after,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_key_is_read_once() {
        let text = |bytes: &[u8]| -> String {
            let char = |key| match key {
                Key::Quit => 'Q',
                Key::Char(char) => char,
            };
            keys(bytes).into_iter().map(char).collect()
        };
        assert_eq!(text(b"s+q\x03?"), "s+QQ?");
        // An arrow, F1, Control-Delete, Alt-s.
        assert_eq!(text(b"\x1b[A+\x1bOP+\x1b[3;5~+\x1bs+"), " + + + +");
        // Return, ü, Escape and Alt-s.
        assert_eq!(text(b"\r+\xc3\xbc+\x1b\x1bs+"), " + +  +");
        assert_eq!(text(b"\x1b"), " ");
        assert_eq!(text(b"\x1b["), " ");
        assert_eq!(text(b"\x1bO"), " ");
        assert_eq!(text(b""), "");
    }
}
