//! Distribution of items over buckets, and parallel concatenation.

use bytemuck::Zeroable;
use rayon::prelude::*;

/// Items grouped in buckets, in one contiguous array.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Buckets<T> {
    /// Bucket `b` is `items[starts[b]..starts[b + 1]]`.
    starts: Vec<usize>,
    items: Vec<T>,
}

/// Returns the start of each bucket, and the end of the last. `spans`: the buckets `first..=last` of each item.
fn starts_of(n_buckets: usize, spans: impl Iterator<Item = (u32, u32)>) -> Vec<usize> {
    // Items that begin and end at each bucket; all spans together may exceed 2^32.
    let (mut begin, mut end) = (vec![0_usize; n_buckets + 1], vec![0_usize; n_buckets + 1]);
    for (first, last) in spans {
        begin[first as usize] += 1;
        end[last as usize + 1] += 1;
    }
    let (mut n_in_bucket, mut n_before) = (0, 0);
    let starts = begin.iter().zip(&end).map(|(begin, end)| {
        let start = n_before;
        n_in_bucket = n_in_bucket + begin - end;
        n_before += n_in_bucket;
        start
    });
    starts.collect()
}

impl<T: Copy + Zeroable> Buckets<T> {
    /// Copies each item to its buckets `first..=last`, in order.
    pub fn new(n_buckets: usize, spanned: &[(T, (u32, u32))]) -> Self {
        let starts = starts_of(n_buckets, spanned.iter().map(|(_, span)| *span));
        let mut items = bytemuck::zeroed_vec(starts[n_buckets]);
        let mut next = starts.clone();
        for &(item, (first, last)) in spanned {
            for at in &mut next[first as usize..=last as usize] {
                items[*at] = item;
                *at += 1;
            }
        }
        Self { starts, items }
    }
}

impl<T> Buckets<T> {
    pub fn of(&self, bucket: usize) -> &[T] {
        &self.items[self.starts[bucket]..self.starts[bucket + 1]]
    }

    pub fn iter(&self) -> impl Iterator<Item = &[T]> {
        self.starts.windows(2).map(|ends| &self.items[ends[0]..ends[1]])
    }

    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut [T]> {
        let mut rest = self.items.as_mut_slice();
        self.starts.windows(2).map(move |ends| {
            let (bucket, after) = std::mem::take(&mut rest).split_at_mut(ends[1] - ends[0]);
            rest = after;
            bucket
        })
    }

    pub fn n_items(&self) -> usize {
        self.items.len()
    }

    pub fn map<U>(self, f: impl FnMut(T) -> U) -> Buckets<U> {
        Buckets { starts: self.starts, items: self.items.into_iter().map(f).collect() }
    }
}

/// Concatenates with all threads, to spread page faults over them.
pub fn concat<T: Copy + Zeroable + Send + Sync>(parts: &[Vec<T>]) -> Vec<T> {
    let mut joined: Vec<T> = bytemuck::zeroed_vec(parts.iter().map(Vec::len).sum());
    let mut rest = joined.as_mut_slice();
    let mut places = Vec::with_capacity(parts.len());
    for part in parts {
        let (place, after) = rest.split_at_mut(part.len());
        places.push((place, part));
        rest = after;
    }
    places.into_par_iter().for_each(|(place, part)| place.copy_from_slice(part));
    joined
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand; then more than 2^32 entries, without the items.
    #[test]
    fn buckets_start_where_those_before_end() {
        let spans = [(0, 1), (1, 3), (3, 3)];
        assert_eq!(starts_of(5, spans.into_iter()), [0, 1, 3, 4, 6, 6]);
        let wide = std::iter::repeat_n((0, (1 << 16) - 1), 70_000);
        let starts = starts_of(1 << 16, wide);
        assert!(starts.iter().enumerate().all(|(bucket, start)| *start == bucket * 70_000));
        assert!(starts[1 << 16] > u32::MAX as usize);
    }
}
