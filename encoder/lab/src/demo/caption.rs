//! Captions on pictures, in a bitmap font.

use font8x8::{BASIC_FONTS, UnicodeFonts};
use image::{Rgb, RgbImage};

/// Edge of a glyph, in pixels of the font.
const GLYPH: u32 = 8;
/// Pixels of the picture per pixel of the font, along each axis.
const SCALE: u32 = 2;
/// Space around the text and between its lines, pixels of the picture.
const MARGIN_PX: u32 = 6;
/// Colour of the text.
const INK: Rgb<u8> = Rgb([20; 3]);

/// Writes a text on a light band across the top of a picture, in as many lines as it needs.
pub(super) fn write(picture: &mut RgbImage, text: &str) {
    let (width, height) = picture.dimensions();
    let n_columns = width.saturating_sub(2 * MARGIN_PX) / (GLYPH * SCALE);
    let lines = lines(text, n_columns.max(1) as usize);
    let pitch_px = GLYPH * SCALE + MARGIN_PX;
    let band_px = (lines.len() as u32 * pitch_px + MARGIN_PX).min(height);
    for pixel in picture.pixels_mut().take((width * band_px) as usize) {
        // A fifth of the picture shows through.
        pixel.0 = pixel.0.map(|c| 255 - (255 - c) / 5);
    }
    for (row, line) in lines.iter().enumerate() {
        for (column, character) in line.chars().enumerate() {
            let left = MARGIN_PX + column as u32 * GLYPH * SCALE;
            glyph(picture, character, left, MARGIN_PX + row as u32 * pitch_px);
        }
    }
}

/// Draws a character; one that the font lacks becomes a question mark. Pixels outside the picture are dropped.
fn glyph(picture: &mut RgbImage, character: char, left: u32, top: u32) {
    let rows = BASIC_FONTS.get(character).or_else(|| BASIC_FONTS.get('?')).unwrap_or_default();
    for (y, x) in (0..GLYPH * SCALE).flat_map(|y| (0..GLYPH * SCALE).map(move |x| (y, x))) {
        // The lowest bit of a row is its leftmost pixel.
        let is_set = rows[(y / SCALE) as usize] >> (x / SCALE) & 1 == 1;
        if let (true, Some(pixel)) = (is_set, picture.get_pixel_mut_checked(left + x, top + y)) {
            *pixel = INK;
        }
    }
}

/// Breaks a text between words into lines of at most `n_columns` characters; a longer word has a line of its own.
fn lines(text: &str, n_columns: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= n_columns => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_break_between_words() {
        assert_eq!(lines("something to move things with", 19), ["something to move", "things with"]);
        assert_eq!(lines("a refrigerator", 4), ["a", "refrigerator"]);
        assert_eq!(lines("", 4), [""; 0]);
    }

    /// By hand: the font's slash, its upper end at the right; the picture below the band is unchanged.
    #[test]
    fn captions_are_legible() {
        let slash =
            [".....##.", "....##..", "...##...", "..##....", ".##.....", "##......", "#.......", "........"];
        let mut picture = RgbImage::from_pixel(320, 240, Rgb([100; 3]));
        write(&mut picture, "a /");
        for (y, row) in slash.iter().enumerate() {
            for (x, cell) in row.chars().enumerate() {
                let (left, top) = (MARGIN_PX + 2 * GLYPH * SCALE, MARGIN_PX);
                let found = picture.get_pixel(left + x as u32 * SCALE, top + y as u32 * SCALE);
                assert_eq!(*found == INK, cell == '#', "column {x}, row {y}");
            }
        }
        assert_eq!((picture.get_pixel(319, 27).0, picture.get_pixel(319, 28).0), ([224; 3], [100; 3]));
        // A picture smaller than its caption.
        write(&mut RgbImage::new(7, 5), "where is the refrigerator");
    }
}
