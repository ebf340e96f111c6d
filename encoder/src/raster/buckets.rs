//! Distribution of items over buckets, and parallel concatenation.

use bytemuck::Zeroable;
use rayon::prelude::*;

/// Items grouped in buckets, in one contiguous array.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Buckets<T> {
    /// Bucket `b` contains `items[starts[b]..starts[b + 1]]`; the length is the number of buckets plus one.
    starts: Vec<u32>,
    items: Vec<T>,
}

impl<T: Copy + Zeroable> Buckets<T> {
    /// Copies each item to its buckets `first..=last`, in order. The copies must be fewer than 2^32.
    pub fn new(n_buckets: usize, spanned: &[(T, (u32, u32))]) -> Self {
        let mut starts = vec![0_u32; n_buckets + 1];
        for &(_, (first, last)) in spanned {
            for start in &mut starts[first as usize + 1..=last as usize + 1] {
                *start += 1;
            }
        }
        let mut n_items = 0;
        for start in &mut starts {
            n_items += *start;
            *start = n_items;
        }
        let mut items = bytemuck::zeroed_vec(n_items as usize);
        let mut next = starts.clone();
        for &(item, (first, last)) in spanned {
            for at in &mut next[first as usize..=last as usize] {
                items[*at as usize] = item;
                *at += 1;
            }
        }
        Self { starts, items }
    }
}

impl<T> Buckets<T> {
    /// Returns the items of a bucket.
    pub fn of(&self, bucket: usize) -> &[T] {
        &self.items[self.starts[bucket] as usize..self.starts[bucket + 1] as usize]
    }

    /// Iterates over the items of each bucket.
    pub fn iter(&self) -> impl Iterator<Item = &[T]> {
        self.starts.windows(2).map(|ends| &self.items[ends[0] as usize..ends[1] as usize])
    }

    /// Iterates over the items of each bucket, mutably.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut [T]> {
        let mut rest = self.items.as_mut_slice();
        self.starts.windows(2).map(move |ends| {
            let (bucket, after) = std::mem::take(&mut rest).split_at_mut((ends[1] - ends[0]) as usize);
            rest = after;
            bucket
        })
    }

    /// Returns the total number of items in all buckets.
    pub fn n_items(&self) -> usize {
        self.items.len()
    }

    /// Converts each item.
    pub fn map<U>(self, f: impl FnMut(T) -> U) -> Buckets<U> {
        Buckets { starts: self.starts, items: self.items.into_iter().map(f).collect() }
    }
}

/// Concatenates parts. All threads copy, so that page faults are spread over them.
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
