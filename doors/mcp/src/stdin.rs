//! Standard input with its longest texts cut off.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, ReadBuf};

use crate::locate::MAX_PHOTO_CHARS;

/// Messages, one a line, as they are read; of each text in them the first characters, one more than a photo may have.
///
/// The library drops a line beyond its limit, and the client waits for its answer for ever. So the photo is cut
/// instead, and the tool says that it is too long.
#[derive(Debug)]
pub struct ShortTexts<R> {
    input: R,
    max_chars: usize,
    place: Place,
}

/// Where in a message the next byte stands.
#[derive(Debug, Default)]
struct Place {
    is_in_text: bool,
    /// Characters of the text so far; an escape is one.
    n_chars: usize,
    is_cut: bool,
    escape: Escape,
}

#[derive(Clone, Copy, Debug, Default)]
enum Escape {
    #[default]
    None,
    /// Behind the backslash.
    Begun,
    /// So many hex digits follow.
    Digits(u8),
}

impl<R> ShortTexts<R> {
    pub fn of(input: R) -> Self {
        Self { input, max_chars: MAX_PHOTO_CHARS + 1, place: Place::default() }
    }
}

impl Place {
    /// Goes on by a byte. Returns whether it stays in the message, of whose texts `max_chars` do.
    fn keeps(&mut self, byte: u8, max_chars: usize) -> bool {
        match (self.is_in_text, byte) {
            // No text holds it: messages end here.
            (_, b'\n') => *self = Self::default(),
            (false, b'"') => *self = Self { is_in_text: true, ..Self::default() },
            (false, _) => {}
            (true, _) => return self.keeps_in_text(byte, max_chars),
        }
        true
    }

    fn keeps_in_text(&mut self, byte: u8, max_chars: usize) -> bool {
        let is_continued = byte & 0xC0 == 0x80;
        if matches!(self.escape, Escape::None) && !is_continued {
            if byte == b'"' {
                self.is_in_text = false;
                return true;
            }
            self.is_cut = self.n_chars >= max_chars;
            self.n_chars += 1;
        }
        self.escape = match (self.escape, byte) {
            (Escape::None, b'\\') => Escape::Begun,
            (Escape::Begun, b'u') => Escape::Digits(4),
            (Escape::Digits(n @ 2..), _) => Escape::Digits(n - 1),
            _ => Escape::None,
        };
        !self.is_cut
    }
}

impl<R: AsyncRead + Unpin> AsyncRead for ShortTexts<R> {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let Self { input, max_chars, place } = self.get_mut();
        let start = buffer.filled().len();
        loop {
            ready!(Pin::new(&mut *input).poll_read(context, buffer))?;
            let read = &mut buffer.filled_mut()[start..];
            let n_read = read.len();
            let mut n_kept = 0;
            for at in 0..n_read {
                if place.keeps(read[at], *max_chars) {
                    read[n_kept] = read[at];
                    n_kept += 1;
                }
            }
            buffer.set_filled(start + n_kept);
            // Nothing would be the end of the input, where nothing was read.
            if n_kept > 0 || n_read == 0 {
                return Poll::Ready(Ok(()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::task::Waker;

    use serde_json::Value;

    use super::*;

    /// Reads messages in pieces of some length, and cuts their texts to 50 characters.
    fn read(messages: &str, piece: usize) -> String {
        let mut input = ShortTexts { max_chars: 50, ..ShortTexts::of(messages.as_bytes()) };
        let (mut all, mut piece) = (Vec::new(), vec![0; piece]);
        loop {
            let mut buffer = ReadBuf::new(&mut piece);
            let read = Pin::new(&mut input).poll_read(&mut Context::from_waker(Waker::noop()), &mut buffer);
            assert!(matches!(read, Poll::Ready(Ok(()))), "{read:?}");
            if buffer.filled().is_empty() {
                return String::from_utf8(all).expect("text");
            }
            all.extend_from_slice(buffer.filled());
        }
    }

    #[test]
    fn long_texts_are_cut_and_the_rest_stays() {
        let short = r#"{"id":1,"a":["\"\\","\u00e9é",{}]}"#.to_owned() + "\n";
        for unit in ["A", "é", "\\n", "\\u002b", "\\\""] {
            let long = unit.repeat(300);
            let messages = format!("{{\"photo_base64\":\"{long}\",\"id\":7}}\n{short}");
            for piece in [1, 3, 1000] {
                assert_eq!(read(&short, piece), short);
                let found = read(&messages, piece);
                let (first, second) = found.split_once('\n').expect("two messages");
                let first: Value = serde_json::from_str(first).expect("JSON");
                let n_chars = first["photo_base64"].as_str().map(|text| text.chars().count());
                assert_eq!((n_chars, &first["id"]), (Some(50), &Value::from(7)), "{unit}");
                assert_eq!(second, short, "{unit}");
            }
        }
    }
}
