//! Detection of damaged JPEG files, which decoders fill with grey or noise without an error.

use std::io::{self, BufRead};

/// Zeros in a row that coded data can only have where zeros end blocks: ten blocks of the least coefficients.
const MOST_ZEROS: usize = 256;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Damage {
    /// The end-of-image marker (ITU-T T.81, B.1.1).
    Cut,
    /// A piece of the coded data, which is zeros.
    Zeros,
}

/// Returns what is missing from a file. Segments are skipped by their lengths, so the end marker of an embedded
/// thumbnail does not count; coded data are searched.
pub(super) fn damage(mut file: impl BufRead) -> io::Result<Option<Damage>> {
    match find_end(&mut file) {
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(Some(Damage::Cut)),
        found => found,
    }
}

fn find_end(file: &mut impl BufRead) -> io::Result<Option<Damage>> {
    // Per coefficient table: whether its code of zeros ends a block, so that flat areas are zeros.
    let mut ends_block = [true; 16];
    let (mut is_sequential, mut may_be_zeros) = (false, true);
    loop {
        if skip_to_marker(file)? > MOST_ZEROS && !may_be_zeros {
            return Ok(Some(Damage::Zeros));
        }
        let mut code = [0xFF];
        while code == [0xFF] {
            file.read_exact(&mut code)?;
        }
        match code[0] {
            0xD9 => return Ok(None),
            // A stuffed byte 255, and markers without a segment.
            0x00 | 0x01 | 0xD0..=0xD8 => {}
            marker => {
                let mut len_bytes = [0; 2];
                file.read_exact(&mut len_bytes)?;
                let mut segment = vec![0; usize::from(u16::from_be_bytes(len_bytes)).saturating_sub(2)];
                file.read_exact(&mut segment)?;
                match marker {
                    0xC0 | 0xC1 => is_sequential = true,
                    0xC4 => read_tables(&segment, &mut ends_block),
                    0xDA => {
                        may_be_zeros = !is_sequential || tables_of_scan(&segment).all(|at| ends_block[at])
                    }
                    _ => {}
                }
            }
        }
    }
}

/// Skips past the next byte 255; returns the longest run of zeros before it.
fn skip_to_marker(file: &mut impl BufRead) -> io::Result<usize> {
    let (mut n, mut most) = (0, 0);
    loop {
        let bytes = file.fill_buf()?;
        if bytes.is_empty() {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let end = bytes.iter().position(|byte| *byte == 0xFF);
        for byte in &bytes[..end.unwrap_or(bytes.len())] {
            n = if *byte == 0 { n + 1 } else { 0 };
            most = most.max(n);
        }
        let n_read = end.map_or(bytes.len(), |end| end + 1);
        file.consume(n_read);
        if end.is_some() {
            return Ok(most);
        }
    }
}

/// Reads Huffman tables (B.2.4.2): the first symbol of each has the code of zeros.
fn read_tables(mut segment: &[u8], ends_block: &mut [bool; 16]) {
    while let Some((&[kind, ref lengths @ ..], symbols)) = segment.split_first_chunk::<17>() {
        let n = lengths.iter().map(|n| usize::from(*n)).sum::<usize>();
        let is_of_coefficients = kind >> 4 == 1;
        if let (true, Some(symbol)) = (is_of_coefficients, symbols.first()) {
            ends_block[usize::from(kind & 15)] = *symbol == 0;
        }
        segment = symbols.get(n..).unwrap_or_default();
    }
}

/// Returns the tables of coefficients of a scan (B.2.3).
fn tables_of_scan(segment: &[u8]) -> impl Iterator<Item = usize> {
    let n = segment.first().map_or(0, |n| usize::from(*n));
    segment.iter().skip(2).step_by(2).take(n).map(|tables| usize::from(tables & 15))
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
        assert_eq!(damage(&WHOLE[..]).expect("memory reads"), None);
        for len in 0..WHOLE.len() {
            assert_eq!(damage(&WHOLE[..len]).expect("memory reads"), Some(Damage::Cut), "cut after {len}");
        }
        // Cameras append data, which are harmless.
        let appended = [&WHOLE[..], &[0; 999]].concat();
        assert_eq!(damage(&appended[..]).expect("memory reads"), None);
    }

    /// A noisy photo with zeros in the middle; flat photos, whose coded data may be all zeros.
    #[test]
    fn zeros_in_the_middle_are_seen() {
        let mut random = slag_math::random::Random::new(1);
        let noise = image::RgbImage::from_fn(96, 96, |_, _| image::Rgb([random.bits() as u8; 3]));
        let written = |image: &image::RgbImage| {
            let mut bytes = std::io::Cursor::new(Vec::new());
            image.write_to(&mut bytes, image::ImageFormat::Jpeg).expect("written");
            bytes.into_inner()
        };
        let mut bytes = written(&noise);
        assert_eq!(damage(&bytes[..]).expect("memory reads"), None);
        let middle = bytes.len() / 2;
        bytes[middle..middle + 300].fill(0);
        assert_eq!(damage(&bytes[..]).expect("memory reads"), Some(Damage::Zeros));
        for level in [0, 127, 128, 255] {
            let flat = written(&image::RgbImage::from_pixel(512, 512, image::Rgb([level; 3])));
            assert_eq!(damage(&flat[..]).expect("memory reads"), None, "{level}");
        }
        // Where the code of zeros ends a block, and in other ways of coding.
        let scan = |frame: u8, symbol: u8| {
            let table = [[0xFF, 0xC4, 0, 20, 0x10, 1].as_slice(), &[0; 15], &[symbol]].concat();
            let head = [0xFF, 0xD8, 0xFF, frame, 0, 2];
            [&head[..], &table, &[0xFF, 0xDA, 0, 8, 1, 1, 0, 0, 63, 0], &[0; 300], &[0xFF, 0xD9]].concat()
        };
        let found = [(0xC0, 1), (0xC0, 0), (0xC2, 1)].map(|(frame, symbol)| damage(&scan(frame, symbol)[..]));
        assert_eq!(found.map(|found| found.expect("memory reads")), [Some(Damage::Zeros), None, None]);
    }
}
