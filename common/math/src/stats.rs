//! Quantiles.

use std::cmp::Ordering;

/// Place of a quantile among `n` sorted values, counted from 0. `share` is that of [`quantile`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rank {
    /// `ceil(n share) - 1`: the least value that is at or above this share of the values. Reports use it.
    Nearest,
    /// `floor(n share)`: this share of the values comes before. The median of an even number is the upper of two.
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

/// Numbers with a total order: floats as of IEEE 754, so that a NaN is beyond the infinities.
pub trait Ordered: Copy {
    /// Compares two numbers.
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

/// Returns a quantile of values, which it reorders; `None` without any. `per_mille`: its share in thousandths, at most
/// 1000. Shares are integers, because a rounded share could fall on the neighbouring place.
pub fn quantile<T: Ordered>(values: &mut [T], per_mille: usize, rank: Rank) -> Option<T> {
    let place = rank.place(values.len(), per_mille);
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(place, T::order).1)
}

/// Returns the median of values, which it reorders: of an even number, the upper of two.
pub fn median<T: Ordered>(values: &mut [T]) -> Option<T> {
    quantile(values, 500, Rank::After)
}

/// Returns the least and largest of the values that remain without the lowest and highest `trimmed` share, at most a half;
/// `None` without any. It reorders the values.
pub fn trimmed_range<T: Ordered>(values: &mut [T], trimmed: f64) -> Option<(T, T)> {
    let cut = (trimmed * values.len().checked_sub(1)? as f64) as usize;
    let (_, low, above) = values.select_nth_unstable_by(cut, T::order);
    let low = *low;
    // Place of the upper end among the values above the lower one.
    let place = above.len().checked_sub(1 + cut);
    Some((low, place.map_or(low, |place| *above.select_nth_unstable_by(place, T::order).1)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Ten values in any order: 0, 10, .., 90.
    fn tens() -> [f64; 10] {
        [70.0, 0.0, 30.0, 90.0, 10.0, 60.0, 20.0, 80.0, 50.0, 40.0]
    }

    /// By hand, for 10 values.
    #[test]
    fn each_rank_has_its_place() {
        let expected = [
            (0, [0.0, 0.0, 0.0]),
            (100, [0.0, 10.0, 0.0]),
            (500, [40.0, 50.0, 40.0]),
            (900, [80.0, 90.0, 80.0]),
            (990, [90.0, 90.0, 80.0]),
            (1000, [90.0, 90.0, 90.0]),
        ];
        for (per_mille, expected) in expected {
            let at = |rank| quantile(&mut tens(), per_mille, rank).expect("has values");
            assert_eq!([Rank::Nearest, Rank::After, Rank::Between].map(at), expected, "{per_mille}");
        }
        assert_eq!((median(&mut tens()), median(&mut tens()[..9])), (Some(50.0), Some(50.0)));
        assert_eq!((median::<f32>(&mut []), median(&mut [7u64])), (None, Some(7)));
        assert_eq!(median(&mut [f32::NAN, 1.0, -0.0]), Some(1.0));
    }

    /// Oracle: the sorted values.
    #[test]
    fn quantiles_are_places_of_the_sorted_values() {
        let mut random = Random::new(3);
        for n in [1usize, 2, 3, 50, 51, 1000, 1001] {
            let values: Vec<f32> = (0..n).map(|_| (random.bits() % 40) as f32 - 20.0).collect();
            let mut sorted = values.clone();
            sorted.sort_by(f32::total_cmp);
            let found = |per_mille, rank| quantile(&mut values.clone(), per_mille, rank).expect("has values");
            assert_eq!(found(999, Rank::After), sorted[((n as f64 * 0.999) as usize).min(n - 1)], "{n}");
            assert_eq!(found(980, Rank::Between), sorted[(n - 1) * 49 / 50], "{n}");
            assert_eq!(found(990, Rank::Nearest), sorted[(n as f64 * 0.99).ceil() as usize - 1], "{n}");
            let cut = (n - 1) / 50;
            assert_eq!(
                trimmed_range(&mut values.clone(), 0.02),
                Some((sorted[cut], sorted[n - 1 - cut])),
                "{n}"
            );
        }
    }

    /// By hand.
    #[test]
    fn a_trimmed_range_leaves_out_both_ends() {
        assert_eq!(trimmed_range(&mut tens(), 0.0), Some((0.0, 90.0)));
        assert_eq!(trimmed_range(&mut tens(), 0.25), Some((20.0, 70.0)));
        assert_eq!(trimmed_range(&mut tens()[..3], 0.5), Some((30.0, 30.0)), "of 0, 30 and 70");
        assert_eq!(trimmed_range::<f64>(&mut [], 0.1), None);
    }
}
