//! The starts of rows of different lengths that lie one after another.

/// Returns whether values ascend from 0 to `end`, as the starts of `starts.len() - 1` rows do.
pub(super) fn are_valid(starts: &[u64], end: usize) -> bool {
    starts.first() == Some(&0) && starts.is_sorted() && starts.last() == Some(&(end as u64))
}
