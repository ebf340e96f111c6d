//! Makes a map from features of a scene's photos.

use std::cmp::Reverse;

use glam::{DAffine3, DVec2, DVec3};
use slag_common::Intrinsics;
use slag_common::landmarks::Landmark;

use crate::map::{Code, distance, middle};
use crate::pose::Pinhole;

/// Neighbours in which a view's points are searched: the views of the nearest places.
const N_NEIGHBOURS: usize = 24;
/// Largest distance between a projected point and a feature of another view that shows it, pixels.
const SAME_FEATURE_PX: f64 = 3.0;
/// Largest difference of the codes of one point in two views, bits.
const SAME_FEATURE_BITS: u32 = 36;

/// A feature of a mapping photo whose depth is known.
#[derive(Clone, Copy, Debug)]
pub struct Observation {
    /// Pixels of an ideal pinhole.
    pub at: DVec2,
    pub point_in_world: DVec3,
    pub code: Code,
}

#[derive(Clone, Debug)]
pub struct MappingView {
    /// Its number, see [`Landmark::view`].
    pub view: u16,
    pub intrinsics: Intrinsics,
    pub camera_from_world: DAffine3,
    pub observations: Vec<Observation>,
}

/// Bytes that [`build`] takes per observation, besides itself: chosen and hidden flags, rank, bin.
pub const WORKING_BYTES_PER_OBSERVATION: usize = 2 + size_of::<u32>() + size_of::<Binned>();

/// Returns at most `limit` landmarks, in turn from each view, those in most of its neighbours first, each point once.
pub fn build(views: &[MappingView], limit: usize) -> Vec<Landmark> {
    let finders: Vec<Finder<'_>> = views.iter().map(Finder::new).collect();
    let middles: Vec<DVec3> = views
        .iter()
        .map(|view| middle(view.observations.iter().map(|o| o.point_in_world).collect()))
        .collect();
    let mut chosen: Vec<Vec<bool>> = views.iter().map(|view| vec![false; view.observations.len()]).collect();
    let mut hidden = chosen.clone();
    let neighbours = |at: usize| {
        let mut others: Vec<usize> = (0..views.len()).filter(|other| *other != at).collect();
        let apart = |other: &usize| middles[at].distance_squared(middles[*other]);
        others.sort_by(|a, b| apart(a).total_cmp(&apart(b)).then(a.cmp(b)));
        others.truncate(N_NEIGHBOURS);
        others
    };
    let neighbours: Vec<Vec<usize>> = (0..views.len()).map(neighbours).collect();
    // (view, observation) of the same point in other views. Recomputed for chosen points, because storing all
    // would take ten times the memory of the observations.
    let seen = |at: usize, index: usize| {
        let (of, finders) = (&views[at].observations[index], &finders);
        neighbours[at].iter().filter_map(move |other| Some((*other, finders[*other].find(of)?)))
    };
    // Per view: observations, those that most others show first.
    let ranked: Vec<Vec<u32>> = (0..views.len())
        .map(|at| {
            let mut ranked: Vec<u32> = (0..views[at].observations.len() as u32).collect();
            ranked.sort_by_cached_key(|index| (Reverse(seen(at, *index as usize).count()), *index));
            ranked
        })
        .collect();
    let mut next = vec![0; views.len()];
    let mut landmarks = Vec::new();
    // One of each view in turn, until there are enough or none is left.
    loop {
        let before = landmarks.len();
        for (at, view) in views.iter().enumerate() {
            if landmarks.len() == limit {
                return landmarks;
            }
            while let Some(index) = ranked[at].get(next[at]).map(|index| *index as usize) {
                next[at] += 1;
                if hidden[at][index] || chosen[at][index] {
                    continue;
                }
                chosen[at][index] = true;
                seen(at, index).for_each(|(other, index)| hidden[other][index] = true);
                let Observation { point_in_world, code, .. } = view.observations[index];
                landmarks.push(Landmark { position_in_world: point_in_world, code, view: view.view });
                break;
            }
        }
        if landmarks.len() == before {
            return landmarks;
        }
    }
}

struct Finder<'a> {
    view: &'a MappingView,
    camera: Pinhole,
    /// Ascending.
    bins: Vec<Binned>,
}

type Binned = ([i32; 2], u32);

/// Returns the bin of a pixel. Points near the camera's plane project millions of pixels away, where no feature is.
fn bin(at: DVec2) -> [i32; 2] {
    at.to_array().map(|at| (at / SAME_FEATURE_PX).floor().clamp(-1e9, 1e9) as i32)
}

impl<'a> Finder<'a> {
    fn new(view: &'a MappingView) -> Self {
        let binned = |(of, index): (&Observation, u32)| (bin(of.at), index);
        let mut bins: Vec<Binned> = view.observations.iter().zip(0..).map(binned).collect();
        bins.sort_unstable();
        Self { view, camera: Pinhole::new(&view.intrinsics), bins }
    }

    /// Returns the view's feature of the same point as an observation of another view.
    fn find(&self, of: &Observation) -> Option<usize> {
        let at = self.camera.pixel(self.view.camera_from_world.transform_point3(of.point_in_world))?;
        let [x, y] = bin(at);
        let column = |x: i32| {
            let first = self.bins.partition_point(|(bin, _)| *bin < [x, y - 1]);
            self.bins[first..].iter().take_while(move |(bin, _)| *bin <= [x, y + 1])
        };
        let near = (x - 1..=x + 1).flat_map(column).map(|(_, index)| *index as usize);
        let near = near.filter(|index| self.view.observations[*index].at.distance(at) < SAME_FEATURE_PX);
        let alike = near.map(|index| (distance(of.code, self.view.observations[index].code), index));
        alike.min().filter(|(bits, _)| *bits <= SAME_FEATURE_BITS).map(|(_, index)| index)
    }
}
