//! The exact squared Euclidean distance of each cell of a grid to the nearest source (Felzenszwalb and Huttenlocher,
//! "Distance Transforms of Sampled Functions", Theory of Computing 8, 2012): rows first, then lower envelopes of
//! parabolas along columns. The steps are separate so that callers can share rows between threads.

/// A row or grid without a source.
pub const FAR: u32 = u32::MAX;

/// Writes the squared distance of each cell of a row to the nearest source in it, in cells; [`FAR`] without a source.
pub fn along_row(is_source: impl ExactSizeIterator<Item = bool>, out: &mut [u32]) {
    assert!(is_source.len() == out.len() && out.len() <= usize::from(u16::MAX), "a row of another length");
    let mut since = FAR;
    for (out, is_source) in out.iter_mut().zip(is_source) {
        since = if is_source { 0 } else { since.saturating_add(1) };
        *out = since;
    }
    let mut since = FAR;
    for out in out.iter_mut().rev() {
        since = if *out == 0 { 0 } else { since.saturating_add(1) };
        let least = since.min(*out);
        *out = if least == FAR { FAR } else { least * least };
    }
}

/// Lower envelope of parabolas along a line.
#[derive(Debug, Default)]
pub struct Envelope {
    /// Place and height of each parabola, and from where on it is the lowest.
    parabolas: Vec<(f64, f64, f64)>,
}

impl Envelope {
    /// Writes the least `(p - q)^2 + heights[q]` over q to each place p; [`FAR`] heights are skipped.
    pub fn lowest(&mut self, heights: &[u32], out: &mut [u32]) {
        assert_eq!(heights.len(), out.len(), "a line of another length");
        self.parabolas.clear();
        for (place, height) in heights.iter().enumerate().filter(|(_, height)| **height != FAR) {
            let (q, f) = (place as f64, f64::from(*height));
            let mut begin = f64::NEG_INFINITY;
            while let Some((v, g, from)) = self.parabolas.last() {
                begin = ((f + q * q) - (g + v * v)) / (2.0 * (q - v));
                if begin > *from {
                    break;
                }
                self.parabolas.pop();
                begin = f64::NEG_INFINITY;
            }
            self.parabolas.push((q, f, begin));
        }
        let mut at = 0;
        for (place, out) in out.iter_mut().enumerate() {
            let p = place as f64;
            while self.parabolas.get(at + 1).is_some_and(|(_, _, from)| *from < p) {
                at += 1;
            }
            *out = self.parabolas.get(at).map_or(FAR, |(q, f, _)| ((p - q) * (p - q) + f) as u32);
        }
    }
}

/// Returns squared distances to the nearest source, in cells of a row-major grid; [`FAR`] without one.
pub fn squared_distances(is_source: &[bool], width: usize) -> Vec<u32> {
    let height = is_source.len().checked_div(width).unwrap_or(0);
    let mut rows = vec![0; is_source.len()];
    for (row, out) in is_source.chunks(width.max(1)).zip(rows.chunks_mut(width.max(1))) {
        along_row(row.iter().copied(), out);
    }
    let (mut envelope, mut column, mut lowest) = (Envelope::default(), vec![0; height], vec![0; height]);
    for x in 0..width {
        (0..height).for_each(|y| column[y] = rows[y * width + x]);
        envelope.lowest(&column, &mut lowest);
        (0..height).for_each(|y| rows[y * width + x] = lowest[y]);
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Oracle: every source compared with every cell.
    #[test]
    fn distances_are_those_of_brute_force() {
        let mut random = Random::new(8);
        for (width, height, share) in [
            (1, 1, 0.5),
            (1, 9, 0.2),
            (9, 1, 0.2),
            (17, 31, 0.02),
            (31, 17, 0.3),
            (20, 20, 0.004),
            (8, 8, 0.0),
            (0, 0, 0.0),
        ] {
            for _ in 0..20 {
                let is_source: Vec<bool> = (0..width * height).map(|_| random.unit() < share).collect();
                let sources: Vec<usize> = (0..is_source.len()).filter(|at| is_source[*at]).collect();
                let found = squared_distances(&is_source, width);
                for (at, found) in found.iter().enumerate() {
                    let squared = |of: &usize| {
                        let (dx, dy) = ((at % width).abs_diff(of % width), (at / width).abs_diff(of / width));
                        (dx * dx + dy * dy) as u32
                    };
                    assert_eq!(
                        *found,
                        sources.iter().map(squared).min().unwrap_or(FAR),
                        "{width} x {height}, {at}"
                    );
                }
            }
        }
    }
}
