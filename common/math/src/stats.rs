//! Quantiles.

use std::cmp::Ordering;

/// Position of a quantile among `n` sorted values, from 0; `share` as in [`quantile`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rank {
    /// `ceil(n share) - 1`: the least value at or above this share of the values. Used by reports.
    Nearest,
    /// `floor(n share)`: this share of the values precedes it. The median of an even number is the upper of two.
    After,
    /// `floor((n - 1) share)`: this share of the way from the first to the last.
    Between,
}

impl Rank {
    fn place(self, n: usize, per_mille: usize) -> usize {
        let place = match self {
            Self::Nearest => (n * per_mille).div_ceil(1000).saturating_sub(1),
            Self::After => n * per_mille / 1000,
            Self::Between => n.saturating_sub(1) * per_mille / 1000,
        };
        place.min(n.saturating_sub(1))
    }
}

/// Numbers with a total order; floats as in IEEE 754, so NaN is beyond the infinities.
pub trait Ordered: Copy {
    fn order(&self, other: &Self) -> Ordering;
}

impl Ordered for f32 {
    fn order(&self, other: &Self) -> Ordering {
        self.total_cmp(other)
    }
}

impl Ordered for f64 {
    fn order(&self, other: &Self) -> Ordering {
        self.total_cmp(other)
    }
}

impl Ordered for u64 {
    fn order(&self, other: &Self) -> Ordering {
        self.cmp(other)
    }
}

/// Returns a quantile of values, which it reorders; `None` without any. `per_mille`: its share in thousandths, at
/// most 1000; an integer, because a rounded share could select a neighbour.
pub fn quantile<T: Ordered>(values: &mut [T], per_mille: usize, rank: Rank) -> Option<T> {
    let place = rank.place(values.len(), per_mille);
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(place, T::order).1)
}

/// Returns the median of values, which it reorders; of an even number, the upper of two.
pub fn median<T: Ordered>(values: &mut [T]) -> Option<T> {
    quantile(values, 500, Rank::After)
}

/// Returns least and largest value without the lowest and highest `trimmed` share (at most 0.5), if any are left. It
/// reorders the values.
pub fn trimmed_range<T: Ordered>(values: &mut [T], trimmed: f64) -> Option<(T, T)> {
    let cut = (trimmed * values.len().checked_sub(1)? as f64) as usize;
    let (_, low, above) = values.select_nth_unstable_by(cut, T::order);
    let low = *low;
    // Position of the upper end among the values above the lower one.
    let place = above.len().checked_sub(1 + cut);
    Some((low, place.map_or(low, |place| *above.select_nth_unstable_by(place, T::order).1)))
}

#[cfg(test)]
mod tests;
