//! Detection of truncated JPEG files, which decoders fill with grey without an error.

use std::io::{self, BufRead, Read};

/// Returns whether the file contains its end-of-image marker (ITU-T T.81, B.1.1).
///
/// Segments are skipped by their lengths, so the marker of an embedded thumbnail does not count; coded data are
/// searched.
pub(super) fn is_whole(mut file: impl BufRead) -> io::Result<bool> {
    match find_end(&mut file) {
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
        result => result.map(|()| true),
    }
}

fn find_end(file: &mut impl BufRead) -> io::Result<()> {
    loop {
        file.skip_until(0xFF)?;
        let mut code = [0xFF];
        while code == [0xFF] {
            file.read_exact(&mut code)?;
        }
        match code[0] {
            0xD9 => return Ok(()),
            // A stuffed byte 255, and markers without a segment.
            0x00 | 0x01 | 0xD0..=0xD8 => {}
            _ => {
                let mut len_bytes = [0; 2];
                file.read_exact(&mut len_bytes)?;
                let rest_bytes = u64::from(u16::from_be_bytes(len_bytes)).saturating_sub(2);
                io::copy(&mut file.by_ref().take(rest_bytes), &mut io::sink())?;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Start marker, a segment with the end marker of a thumbnail, a scan header, coded data with a stuffed byte
    /// 255 and a restart marker, end marker.
    const WHOLE: [u8; 25] = [
        0xFF, 0xD8, 0xFF, 0xE1, 0, 6, 0xFF, 0xD8, 0xFF, 0xD9, 0xFF, 0xDA, 0, 3, 9, 7, 0xFF, 0, 8, 0xFF, 0xD3,
        5, 0xFF, 0xFF, 0xD9,
    ];

    #[test]
    fn a_cut_anywhere_is_seen() {
        assert!(is_whole(&WHOLE[..]).expect("memory reads"));
        for len in 0..WHOLE.len() {
            assert!(!is_whole(&WHOLE[..len]).expect("memory reads"), "cut after {len}");
        }
        // Data that cameras append are harmless.
        let appended = [&WHOLE[..], &[0; 9]].concat();
        assert!(is_whole(&appended[..]).expect("memory reads"));
    }
}
