//! Histogram bins over the range of scores.

/// Number of bins; a score at a given rank is located by counting before anything is sorted.
pub(super) const BINS: usize = 4096;

/// Returns the bin of a score. It never falls as the score rises.
pub(super) fn bin_of(score: f32) -> usize {
    // Few scores lie outside -1..1; they share the first and the last bin.
    ((score + 1.0) * (BINS as f32 / 2.0)).clamp(0.0, (BINS - 1) as f32) as usize
}

/// Returns a score that no score of a bin lies below.
pub(super) fn edge_of(bin: usize) -> f32 {
    // The first bin also holds all lower scores. Otherwise a little below the edge, because `bin_of` rounds.
    let edge = bin as f32 / (BINS as f32 / 2.0) - 1.0;
    if bin == 0 { f32::NEG_INFINITY } else { edge - 4.0 * f32::EPSILON }
}
