//! The nearest neighbours of all points of a set, by a k-d tree (Bentley, "Multidimensional Binary Search Trees
//! Used for Associative Searching", CACM 18(9), 1975).

use rayon::prelude::*;

/// Fills rows of points with too few neighbours.
pub const NO_POINT: u32 = u32::MAX;

/// Ranges of at most this many points are searched linearly.
const LEAF_POINTS: usize = 12;
/// Smaller ranges are sorted by one thread.
const PARALLEL_POINTS: usize = 1 << 12;
const POINTS_PER_TASK: usize = 1 << 10;

/// Bytes per point of the search: tree, and neighbours in tree order and in the given order.
pub fn working_bytes_per_point(n_neighbours: usize) -> usize {
    size_of::<Item>() + size_of::<u8>() + size_of::<u32>() * (2 * n_neighbours + 1)
}

#[derive(Clone, Debug, PartialEq)]
pub struct Neighbours {
    n_neighbours: usize,
    /// `[n][n_neighbours]`.
    rows: Vec<u32>,
}

impl Neighbours {
    /// Finds the `n_neighbours` nearest others of each point; ties go to the lower number, so the result does not
    /// depend on threads or on the tree. Coordinates must be finite.
    pub fn new(points: &[[f64; 3]], n_neighbours: usize) -> Self {
        let mut items: Vec<Item> = points.iter().copied().zip(0..).collect();
        let mut axes = vec![0; items.len()];
        sort(&mut items, &mut axes);
        let tree = Tree { items: &items, axes: &axes };
        let mut in_tree_order = vec![NO_POINT; points.len() * n_neighbours];
        if n_neighbours > 0 {
            let rows = in_tree_order.par_chunks_mut(n_neighbours * POINTS_PER_TASK);
            rows.zip(items.par_chunks(POINTS_PER_TASK)).for_each(|(rows, items)| {
                let mut nearest = Vec::with_capacity(n_neighbours + 1);
                for (row, item) in rows.chunks_exact_mut(n_neighbours).zip(items) {
                    nearest.clear();
                    tree.search(0, tree.items.len(), item, n_neighbours, &mut nearest);
                    row.iter_mut().zip(&nearest).for_each(|(out, (_, number))| *out = *number);
                }
            });
        }
        let mut place = vec![0; points.len()];
        items.iter().zip(0..).for_each(|((_, number), at)| place[*number as usize] = at);
        drop(items);
        let mut rows = vec![NO_POINT; in_tree_order.len()];
        rows.par_chunks_mut(n_neighbours.max(1)).zip(&place).for_each(|(row, at): (&mut [u32], &u32)| {
            row.copy_from_slice(&in_tree_order[*at as usize * n_neighbours..][..n_neighbours]);
        });
        Self { n_neighbours, rows }
    }

    /// Returns the neighbours of a point, nearest first.
    pub fn of(&self, point: u32) -> &[u32] {
        let row = &self.rows[point as usize * self.n_neighbours..][..self.n_neighbours];
        &row[..row.iter().position(|other| *other == NO_POINT).unwrap_or(row.len())]
    }
}

type Item = ([f64; 3], u32);

struct Tree<'a> {
    items: &'a [Item],
    /// The split axis of each range, at its middle.
    axes: &'a [u8],
}

/// Orders points so that the middle of each range splits the others along the longest side of the range's box.
fn sort(items: &mut [Item], axes: &mut [u8]) {
    if items.len() <= LEAF_POINTS {
        return;
    }
    let (mut low, mut high) = (items[0].0, items[0].0);
    for (point, _) in &*items {
        for axis in 0..3 {
            low[axis] = low[axis].min(point[axis]);
            high[axis] = high[axis].max(point[axis]);
        }
    }
    let side = |axis: &usize| high[*axis] - low[*axis];
    let axis = (0..3).max_by(|a, b| side(a).total_cmp(&side(b))).unwrap_or(0);
    let middle = items.len() / 2;
    // 0 and -0 are equal.
    let along = |item: &Item| item.0[axis] + 0.0;
    items.select_nth_unstable_by(middle, |a, b| along(a).total_cmp(&along(b)).then(a.1.cmp(&b.1)));
    axes[middle] = axis as u8;
    let is_parallel = items.len() >= PARALLEL_POINTS;
    let (below, above) = items.split_at_mut(middle);
    let (axes_below, axes_above) = axes.split_at_mut(middle);
    let (above, axes_above) = (&mut above[1..], &mut axes_above[1..]);
    if is_parallel {
        rayon::join(|| sort(below, axes_below), || sort(above, axes_above));
    } else {
        sort(below, axes_below);
        sort(above, axes_above);
    }
}

impl Tree<'_> {
    /// Adds points of a range that are nearer than the farthest of `nearest`: (squared distance, number), ascending.
    fn search(&self, from: usize, to: usize, item: &Item, n: usize, nearest: &mut Vec<(f64, u32)>) {
        if to - from <= LEAF_POINTS {
            self.items[from..to].iter().for_each(|other| consider(item, other, n, nearest));
            return;
        }
        let middle = from + (to - from) / 2;
        let axis = usize::from(self.axes[middle]);
        let beyond = item.0[axis] - self.items[middle].0[axis];
        let (below, above) = ((from, middle), (middle + 1, to));
        let (near, far) = if beyond > 0.0 { (above, below) } else { (below, above) };
        self.search(near.0, near.1, item, n, nearest);
        consider(item, &self.items[middle], n, nearest);
        // Rounding is monotone: no point beyond the plane has a smaller squared distance than the plane. One at
        // the same distance may have a lower number.
        let reaches = |last: &(f64, u32)| {
            // An export may have a million points at one place; they are found by ascending number.
            let is_later = beyond == 0.0 && last.0 == 0.0 && last.1 < self.items[middle].1;
            beyond * beyond <= last.0 && !is_later
        };
        if nearest.len() < n || nearest.last().is_some_and(reaches) {
            self.search(far.0, far.1, item, n, nearest);
        }
    }
}

/// Adds a point, unless it is `item` itself, if it is among the `n` nearest so far.
#[inline]
fn consider((here, own): &Item, (point, number): &Item, n: usize, nearest: &mut Vec<(f64, u32)>) {
    let [x, y, z] = [0, 1, 2].map(|axis| point[axis] - here[axis]);
    let found = (x * x + y * y + z * z, *number);
    let is_nearer = nearest.len() < n || nearest.last().is_some_and(|last| found < *last);
    if is_nearer && number != own {
        nearest.truncate(n - 1);
        let at = nearest.partition_point(|other| *other < found);
        nearest.insert(at, found);
    }
}

#[cfg(test)]
mod tests;
