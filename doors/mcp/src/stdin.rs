//! Standard input with overlong texts truncated.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, ReadBuf};

use crate::locate::{MAX_MESSAGE_BYTES, MAX_PHOTO_CHARS};

/// Bytes read at a time.
const PIECE_BYTES: usize = 8 << 10;
/// Characters of a text that are never cut: member names and the message's id are texts, too.
const SHORT_CHARS: usize = 1000;
/// Size of a message beyond which its texts are cut to [`SHORT_CHARS`]; the rest is for everything else.
const MAX_TEXT_BYTES: usize = MAX_MESSAGE_BYTES / 8 * 7;

/// Reads messages, one a line, keeping the first characters of each text, one more than a photo may have.
///
/// The library drops a line beyond its limit, and the client would wait for ever. So the photo is cut instead, and
/// the tool reports that it is too long. Escapes of ASCII characters are decoded: at six bytes per character, a valid
/// photo could exceed the limit without the tool noticing.
#[derive(Debug)]
pub struct ShortTexts<R> {
    input: R,
    max_chars: usize,
    max_bytes: usize,
    place: Place,
    /// Kept input, and the number of its bytes already given.
    kept: Vec<u8>,
    n_given: usize,
}

/// Parser state at the next byte.
#[derive(Debug, Default)]
struct Place {
    is_in_text: bool,
    /// Characters of the text so far; an escape is one, or half of one beyond U+FFFF.
    n_chars: usize,
    /// Kept bytes of the message.
    n_bytes: usize,
    is_cut: bool,
    escape: Vec<u8>,
}

impl<R> ShortTexts<R> {
    pub fn of(input: R) -> Self {
        Self {
            input,
            max_chars: MAX_PHOTO_CHARS + 1,
            max_bytes: MAX_TEXT_BYTES,
            place: Place::default(),
            kept: Vec::new(),
            n_given: 0,
        }
    }

    fn go_on_by(&mut self, byte: u8) {
        let place = &mut self.place;
        match (place.is_in_text, byte) {
            // Texts cannot contain it: messages end here.
            (_, b'\n') => {
                *place = Place::default();
                self.kept.push(byte);
            }
            (true, _) if !place.escape.is_empty() => {
                place.escape.push(byte);
                if place.escape.len() == if place.escape[1] == b'u' { 6 } else { 2 } {
                    let escape = std::mem::take(&mut place.escape);
                    let kept = plain(&escape).map_or(escape.clone(), |byte| vec![byte]);
                    // The second half of a surrogate pair.
                    self.keep(&kept, matches!(*escape, [_, _, b'd' | b'D', b'c'..=b'f' | b'C'..=b'F', ..]));
                }
            }
            (true, b'\\') => place.escape.push(byte),
            (true, byte) if byte != b'"' => self.keep(&[byte], byte & 0xC0 == 0x80),
            (_, byte) => {
                if byte == b'"' {
                    (place.is_in_text, place.n_chars, place.is_cut) = (!place.is_in_text, 0, false);
                }
                place.n_bytes += 1;
                self.kept.push(byte);
            }
        }
    }

    /// Keeps a character of a text, or its continuation, unless the text is cut there.
    fn keep(&mut self, bytes: &[u8], continues: bool) {
        let place = &mut self.place;
        if !continues {
            let is_full = place.n_bytes >= self.max_bytes && place.n_chars >= SHORT_CHARS;
            place.is_cut = place.n_chars >= self.max_chars || is_full;
            place.n_chars += 1;
        }
        if !place.is_cut {
            place.n_bytes += bytes.len();
            self.kept.extend_from_slice(bytes);
        }
    }
}

/// Returns the ASCII character of an escape, if it needs none.
fn plain(escape: &[u8]) -> Option<u8> {
    let byte = match escape {
        b"\\/" => b'/',
        [_, b'u', b'0', b'0', digits @ ..] => u8::from_str_radix(str::from_utf8(digits).ok()?, 16).ok()?,
        _ => return None,
    };
    (matches!(byte, b' '..=b'~') && !matches!(byte, b'"' | b'\\')).then_some(byte)
}

impl<R: AsyncRead + Unpin> AsyncRead for ShortTexts<R> {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        // Returning nothing would signal the end of input.
        while this.n_given == this.kept.len() {
            let mut piece = [0; PIECE_BYTES];
            let mut piece = ReadBuf::new(&mut piece);
            ready!(Pin::new(&mut this.input).poll_read(context, &mut piece))?;
            if piece.filled().is_empty() && this.place.n_bytes == 0 {
                return Poll::Ready(Ok(()));
            }
            this.kept.clear();
            this.n_given = 0;
            if piece.filled().is_empty() {
                // The library drops a last line without its end.
                this.go_on_by(b'\n');
            }
            for byte in piece.filled() {
                this.go_on_by(*byte);
            }
        }
        let rest = &this.kept[this.n_given..];
        let n = rest.len().min(buffer.remaining());
        buffer.put_slice(&rest[..n]);
        this.n_given += n;
        Poll::Ready(Ok(()))
    }
}

#[cfg(test)]
mod tests {
    use std::task::Waker;

    use serde_json::Value;

    use super::*;

    /// Reads messages in pieces of some length, and cuts their texts to some characters, and beyond some bytes.
    fn read(messages: &str, piece: usize, max_chars: usize, max_bytes: usize) -> String {
        let mut input = ShortTexts { max_chars, max_bytes, ..ShortTexts::of(messages.as_bytes()) };
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
        for unit in ["A", "é", "\\n", "\\u002b", "\\\"", "😀", "\\ud83d\\ude00"] {
            let long = unit.repeat(300);
            let messages = format!("{{\"photo_base64\":\"{long}\",\"id\":7}}\n{short}");
            for piece in [1, 3, 1000] {
                assert_eq!(read(&short, piece, 50, 9999), short);
                let found = read(&messages, piece, 50, 9999);
                let (first, second) = found.split_once('\n').expect("two messages");
                let first: Value = serde_json::from_str(first).expect("JSON");
                let n_chars = first["photo_base64"].as_str().map(|text| text.chars().count());
                assert_eq!((n_chars, &first["id"]), (Some(50), &Value::from(7)), "{unit}");
                assert_eq!(second, short, "{unit}");
            }
        }
    }

    /// `printf` and pipes leave the end of the last line out.
    #[test]
    fn the_last_line_ends() {
        for (input, expected) in [("{}\n{}", "{}\n{}\n"), ("{}\n", "{}\n"), ("", "")] {
            assert_eq!(read(input, 2, 50, 9999), expected);
        }
    }

    /// With any content, a message stays below the library's limit and is answered: its id is whole.
    #[test]
    fn messages_stay_within_their_limit() {
        let photo_chars = |unit: &str, n_texts: usize| {
            let long = format!("\"photo_base64\":\"{}\",", unit.repeat(8009)).repeat(n_texts);
            let found = read(&format!("{{{long}\"id\":\"seven\"}}\n"), 1000, 8001, 14_000);
            assert!(found.len() < 16_000, "{unit}: {} bytes", found.len());
            let message: Value = serde_json::from_str(&found).expect("JSON");
            assert_eq!(message["id"], "seven", "{unit}");
            message["photo_base64"].as_str().map(|text| text.chars().count())
        };
        assert_eq!((photo_chars("\\u0041", 1), photo_chars("\\/", 1)), (Some(8001), Some(8001)));
        assert!(photo_chars("😀", 1) > Some(3000) && photo_chars("\\u00e9", 1) > Some(2000));
        assert_eq!(photo_chars("A", 3), Some(SHORT_CHARS));
    }
}
