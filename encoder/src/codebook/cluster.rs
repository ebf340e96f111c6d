//! Clusters of points, as many as the error requires: each becomes a centroid.

use std::ops::Range;

use rayon::prelude::*;
use slag_math::matrix::{Panels, Rows};

/// Rounds of 2-means when a cluster is split; the halves hardly move after the third.
const SPLIT_ROUNDS: usize = 3;
/// Up to this many clusters are all split: each is still far too large.
const FEW_CLUSTERS: usize = 16;
/// One in this many clusters is split at a time, the worst first: almost the order of splitting one by one, with work
/// for threads.
const SPLIT_SHARE: usize = 8;

pub struct Clusters {
    /// `[n]`.
    pub codes: Vec<u32>,
    /// `[K][width]`: mean of each cluster's points.
    pub centres: Vec<f32>,
}

/// Points in the order of their centroids.
pub(super) struct Members {
    pub(super) order: Vec<u32>,
    /// `[K + 1]`: start of each centroid in `order`.
    pub(super) starts: Vec<u32>,
}

impl Members {
    pub(super) fn new(codes: &[u32], n_centroids: usize) -> Self {
        let mut starts = vec![0u32; n_centroids + 1];
        codes.iter().for_each(|centroid| starts[*centroid as usize + 1] += 1);
        (0..n_centroids).for_each(|centroid| starts[centroid + 1] += starts[centroid]);
        let mut next = starts.clone();
        let mut order = vec![0; codes.len()];
        for (point, centroid) in codes.iter().enumerate() {
            order[next[*centroid as usize] as usize] = point as u32;
            next[*centroid as usize] += 1;
        }
        Self { order, starts }
    }

    pub(super) fn places(&self, centroid: usize) -> Range<usize> {
        self.starts[centroid] as usize..self.starts[centroid + 1] as usize
    }
}

struct Cluster {
    /// Ascending.
    members: Vec<u32>,
    centre: Vec<f32>,
    /// Sum of squared distances of the members from the centre.
    squared_error: f64,
}

impl Clusters {
    pub(crate) fn drop_empty(&mut self, width: usize) {
        let mut numbers = vec![None; self.centres.len() / width];
        let mut kept = Vec::with_capacity(self.centres.len());
        for code in &mut self.codes {
            let centre = *code as usize;
            *code = *numbers[centre].get_or_insert_with(|| {
                kept.extend_from_slice(&self.centres[centre * width..][..width]);
                (kept.len() / width - 1) as u32
            });
        }
        self.centres = kept;
    }
}

/// Finds at most `max_clusters` clusters whose points have an RMS distance of at most `max_rms` from their centres.
/// The result depends on the points alone, not on threads.
pub fn clusters(points: Rows<'_>, max_rms: f32, max_clusters: usize) -> Clusters {
    let split = split(points, max_rms, max_clusters.max(1));
    let centres: Vec<f32> = split.into_iter().flat_map(|cluster| cluster.centre).collect();
    let mut codes = nearest(points, &centres);
    let members = Members::new(&codes, centres.len() / points.width);
    // Clusters that lost all points are left out.
    let kept: Vec<usize> =
        (0..members.starts.len() - 1).filter(|cluster| !members.places(*cluster).is_empty()).collect();
    codes.iter_mut().for_each(|code| *code = kept.partition_point(|kept| *kept < *code as usize) as u32);
    let centre = |cluster| mean(points, &members.order[members.places(cluster)]);
    let centres: Vec<Vec<f32>> = kept.into_par_iter().map(centre).collect();
    Clusters { codes, centres: centres.concat() }
}

pub fn nearest(points: Rows<'_>, centres: &[f32]) -> Vec<u32> {
    let width = points.width;
    // ||p - c||² = ||p||² - 2 (p·c - ||c||²/2); the first term is the same for all centres.
    let half_norms: Vec<f32> =
        centres.chunks_exact(width).map(|c| c.iter().map(|v| v * v).sum::<f32>() / 2.0).collect();
    Panels::new(width, half_norms.len(), |i, c| centres[c * width + i]).largest(points, &half_norms)
}

pub(super) fn mean(points: Rows<'_>, members: &[u32]) -> Vec<f32> {
    let mut sum = vec![0.0f64; points.width];
    for point in members {
        sum.iter_mut().zip(points.get(*point as usize)).for_each(|(s, v)| *s += f64::from(*v));
    }
    let n = members.len().max(1) as f64;
    sum.iter().map(|s| (s / n) as f32).collect()
}

impl Cluster {
    fn new(points: Rows<'_>, members: Vec<u32>) -> Self {
        let centre = mean(points, &members);
        let distance = |point: &u32| f64::from(squared_distance(points.get(*point as usize), &centre));
        let squared_error = members.iter().map(distance).sum();
        Self { members, centre, squared_error }
    }
}

/// Splits the clusters with the largest squared errors until their sum is within the budget.
fn split(points: Rows<'_>, max_rms: f32, max_clusters: usize) -> Vec<Cluster> {
    let n = points.len();
    let budget = f64::from(max_rms).powi(2) * n as f64;
    let mut done: Vec<Cluster> = Vec::new();
    let mut open = vec![Cluster::new(points, (0..n as u32).collect())];
    while !open.is_empty() {
        let n_clusters = done.len() + open.len();
        let error: f64 = done.iter().chain(&open).map(|cluster| cluster.squared_error).sum();
        if error <= budget || n_clusters >= max_clusters {
            break;
        }
        open.sort_by(|a, b| b.squared_error.total_cmp(&a.squared_error).then(a.members.cmp(&b.members)));
        let share = if open.len() < FEW_CLUSTERS { 1 } else { SPLIT_SHARE };
        let n_split = (open.len() / share).clamp(1, max_clusters - n_clusters);
        let rest = open.split_off(n_split);
        let halves: Vec<Result<[Cluster; 2], Cluster>> =
            open.into_par_iter().map(|cluster| split_in_two(points, cluster)).collect();
        open = rest;
        for result in halves {
            match result {
                Ok(pair) => open.extend(pair),
                Err(whole) => done.push(whole),
            }
        }
    }
    done.extend(open);
    done
}

/// Splits a cluster by 2-means, from the member farthest from the centre and the one farthest from that. Returns the
/// cluster itself if all members coincide.
fn split_in_two(points: Rows<'_>, cluster: Cluster) -> Result<[Cluster; 2], Cluster> {
    let farthest = |from: &[f32]| {
        let distance = |point: &u32| (squared_distance(points.get(*point as usize), from), *point);
        let farther = |a: (f32, u32), b: (f32, u32)| if b.0 > a.0 { b } else { a };
        let found = cluster.members.iter().map(distance).fold((-1.0, cluster.members[0]), farther);
        points.get(found.1 as usize)
    };
    let first = farthest(&cluster.centre);
    let second = farthest(first);
    let mut centres = [first.to_vec(), second.to_vec()];
    let mut halves = None;
    for _ in 0..SPLIT_ROUNDS {
        // |p - a|² <= |p - b|² where p·(a - b) >= (|a|² - |b|²) / 2: one product a point.
        let direction: Vec<f32> = centres[0].iter().zip(&centres[1]).map(|(a, b)| a - b).collect();
        let norm = |v: &[f32]| v.iter().map(|x| x * x).sum::<f32>();
        let border = (norm(&centres[0]) - norm(&centres[1])) / 2.0;
        let is_first = |point: &u32| slag_math::dot(points.get(*point as usize), &direction) >= border;
        let (a, b): (Vec<u32>, Vec<u32>) = cluster.members.iter().partition(|point| is_first(point));
        if a.is_empty() || b.is_empty() {
            break;
        }
        centres = [mean(points, &a), mean(points, &b)];
        halves = Some([a, b]);
    }
    match halves {
        Some(halves) => Ok(halves.map(|members| Cluster::new(points, members))),
        None => Err(cluster),
    }
}

pub(super) fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    let (a_blocks, a_rest) = a.as_chunks::<16>();
    let (b_blocks, b_rest) = b.as_chunks::<16>();
    for (x, y) in a_blocks.iter().zip(b_blocks) {
        for lane in 0..16 {
            let d = x[lane] - y[lane];
            lanes[lane] += d * d;
        }
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(x, y)| (x - y) * (x - y)).sum();
    lanes.iter().sum::<f32>() + rest
}
