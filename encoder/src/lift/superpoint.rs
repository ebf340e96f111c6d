//! Superpoints: small pieces of surface of one appearance, by graph-based segmentation (Felzenszwalb and
//! Huttenlocher, "Efficient Graph-Based Image Segmentation", IJCV 59(2), 2004) of the Gaussians' nearest-neighbour
//! graph.
//!
//! An edge's length is the difference of its ends in colour, in the direction of their thinnest axes and, if known, in
//! their embeddings; distance only decides who is a neighbour. What stands on the ground has no edge to the ground nor
//! to other things: a cone of ten Gaussians would be joined to the road.

use rayon::prelude::*;
use slag_common::Gaussians;

use crate::ground::Standing;
use slag_math::dot;
use slag_math::graph_segmentation::Components;
use slag_math::nearest::{self, Neighbours};
use slag_math::union_find::{NOT_NUMBERED, Numbering};

/// Marks Gaussians that cannot be drawn.
pub(crate) const NO_SUPERPOINT: u32 = NOT_NUMBERED;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SuperpointSettings {
    /// Nearest neighbours that get an edge.
    pub(crate) n_neighbours: usize,
    /// Edge length from black to white, over the square root of 3.
    pub colour: f32,
    /// Edge length of a right angle between thinnest axes.
    pub normal: f32,
    /// Edge length of a right angle between sketches of embeddings.
    pub field: f32,
    /// Scale of observation k: an edge joins two components if it is at most each one's longest inner edge plus k over
    /// its size.
    pub scale: f32,
    /// Smaller components join their most similar neighbour.
    pub(crate) min_gaussians: u32,
}

impl Default for SuperpointSettings {
    /// Embeddings, where known, weigh more than colour and shape.
    fn default() -> Self {
        Self { n_neighbours: 8, colour: 0.3, normal: 0.3, field: 1.0, scale: 3.0, min_gaussians: 20 }
    }
}

impl SuperpointSettings {
    /// Larger superpoints of the same edges: about the sides of a thing, where the default ones are patches.
    pub fn coarse() -> Self {
        Self { scale: 20.0, min_gaussians: 60, ..Self::default() }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Superpoints {
    /// `[N]`: [`NO_SUPERPOINT`] for Gaussians that cannot be drawn.
    pub(crate) of_gaussian: Vec<u32>,
    /// Superpoints are numbered by their first Gaussians.
    pub n: usize,
}

/// Short vectors that differ as embeddings do, at any common scale; zeros where unknown.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sketches<'a> {
    pub width: usize,
    /// `[N][width]`.
    pub values: &'a [i8],
}

impl Sketches<'_> {
    /// 1 minus the cosine; 0 if one is unknown.
    fn difference(&self, a: usize, b: usize) -> f32 {
        let [a, b] = [a, b].map(|i| &self.values[i * self.width..][..self.width]);
        let product =
            |x: &[i8], y: &[i8]| -> i32 { x.iter().zip(y).map(|(x, y)| i32::from(*x) * i32::from(*y)).sum() };
        let (aa, bb) = (product(a, a), product(b, b));
        if aa == 0 || bb == 0 {
            return 0.0;
        }
        (1.0 - product(a, b) as f32 / (aa as f32 * bb as f32).sqrt()).max(0.0)
    }
}

const GAUSSIANS_PER_TASK: usize = 1 << 12;

/// Ascending by length, then by ends.
type Edge = (u32, u32, u32);

#[derive(Debug)]
pub struct Graph {
    n_gaussians: usize,
    /// Gaussians that can be drawn.
    usable: Vec<u32>,
    /// Ascending.
    edges: Vec<Edge>,
}

impl Graph {
    pub fn new(
        scene: &Gaussians,
        standing: &Standing,
        sketches: Option<Sketches<'_>>,
        settings: &SuperpointSettings,
    ) -> Self {
        let usable: Vec<u32> =
            (0..scene.len() as u32).into_par_iter().filter(|i| scene.is_usable(*i as usize)).collect();
        let means: Vec<[f64; 3]> =
            usable.par_iter().map(|i| scene.means_in_world[*i as usize].to_array()).collect();
        let neighbours = Neighbours::new(&means, settings.n_neighbours);
        drop(means);
        let looks: Vec<Look> = usable.par_iter().map(|i| Look::of(scene, *i as usize)).collect();
        let things: Vec<u32> =
            usable.par_iter().map(|i| standing.at(scene.means_in_world[*i as usize])).collect();
        let edge = |i: u32, j: u32| -> Edge {
            let (i, j) = (i.min(j) as usize, i.max(j) as usize);
            let (a, b) = (usable[i], usable[j]);
            let mut length = looks[i].difference(&looks[j], settings);
            if let Some(sketches) = sketches {
                length += settings.field * sketches.difference(a as usize, b as usize);
            }
            // Bits of non-negative lengths have the same order.
            (length.to_bits(), a, b)
        };
        let edges_of = |chunk: &[u32], first: usize| {
            let mut edges = Vec::with_capacity(chunk.len() * settings.n_neighbours);
            for i in (first as u32..).take(chunk.len()) {
                // Mutual neighbours have one edge.
                let is_new = |j: &&u32| i < **j || !neighbours.of(**j).contains(&i);
                let is_of_thing = |j: &&u32| things[i as usize] == things[**j as usize];
                let new = neighbours.of(i).iter().filter(is_new).filter(is_of_thing);
                edges.extend(new.map(|j| edge(i, *j)));
            }
            edges
        };
        let chunks = usable.par_chunks(GAUSSIANS_PER_TASK).enumerate();
        let chunks: Vec<Vec<Edge>> =
            chunks.map(|(at, chunk)| edges_of(chunk, at * GAUSSIANS_PER_TASK)).collect();
        let mut edges: Vec<Edge> = slag_raster::concat(&chunks);
        drop(chunks);
        edges.par_sort_unstable();
        Self { n_gaussians: scene.len(), usable, edges }
    }

    /// `settings`: scale and smallest size.
    pub(crate) fn superpoints(&self, settings: &SuperpointSettings) -> Superpoints {
        let mut components = Components::new(self.n_gaussians, settings.scale);
        let edge = |(length, a, b): &Edge| (*a, *b, f32::from_bits(*length));
        components.join_all_similar(&self.edges, edge);
        components.join_all_small(&self.edges, edge, settings.min_gaussians);
        let Numbering { of_item, sizes } = components.number(self.usable.iter().copied());
        Superpoints { of_gaussian: of_item, n: sizes.len() }
    }
}

impl Superpoints {
    pub fn sizes(&self) -> Vec<u32> {
        let mut sizes = vec![0; self.n];
        let known = self.of_gaussian.iter().filter(|superpoint| **superpoint != NO_SUPERPOINT);
        known.for_each(|superpoint| sizes[*superpoint as usize] += 1);
        sizes
    }

    /// Uses colour and shape. The result does not depend on threads.
    pub fn new(scene: &Gaussians, standing: &Standing, settings: &SuperpointSettings) -> Self {
        Graph::new(scene, standing, None, settings).superpoints(settings)
    }

    /// Bytes to partition `n_gaussians` at `n_scales` at once: neighbours during the search, then with edges and joins.
    pub(crate) fn working_bytes(n_gaussians: usize, n_scales: usize) -> u64 {
        let n = SuperpointSettings::default().n_neighbours;
        let searched = size_of::<[f64; 3]>() + nearest::working_bytes_per_point(n);
        let of_one = size_of::<Look>() + (1 + 5 * n_scales) * size_of::<u32>();
        let joined = n * (size_of::<u32>() + size_of::<Edge>()) + of_one;
        n_gaussians as u64 * (size_of::<u32>() + searched.max(joined)) as u64
    }
}

/// What a Gaussian's edges compare, except embeddings.
#[derive(Clone, Copy)]
struct Look {
    colour: [f32; 3],
    normal: [f32; 3],
}

impl Look {
    fn of(scene: &Gaussians, i: usize) -> Self {
        Self { colour: scene.rgb_dc(i), normal: thinnest_axis(scene.rotations_wxyz[i], scene.scales[i]) }
    }

    fn difference(&self, other: &Self, settings: &SuperpointSettings) -> f32 {
        let colour = [0, 1, 2].map(|c| self.colour[c] - other.colour[c]);
        let straight = dot(&self.normal, &other.normal).abs();
        settings.colour * dot(&colour, &colour).sqrt() + settings.normal * (1.0 - straight).max(0.0)
    }
}

/// Thinnest axis in the world: the normal of a Gaussian on a surface.
fn thinnest_axis([w, x, y, z]: [f32; 4], scales: [f32; 3]) -> [f32; 3] {
    let thinnest = (0..3).min_by(|a, b| scales[*a].total_cmp(&scales[*b])).unwrap_or(0);
    match thinnest {
        0 => [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)],
        1 => [2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)],
        _ => [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)],
    }
}

#[cfg(test)]
mod tests;
