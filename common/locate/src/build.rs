//! Makes a map from the features of the photos of a scene.

use std::collections::BTreeMap;

use glam::{DAffine3, DVec2, DVec3};
use slag_common::Intrinsics;
use slag_common::landmarks::Landmark;

use crate::map::{Code, distance, middle};
use crate::pose::Pinhole;

/// Views that a view's points are looked for in: those that look at places nearest to its own.
const N_NEIGHBOURS: usize = 24;
/// Distance between a point and a feature of another view that shows it, pixels.
const SAME_FEATURE_PX: f64 = 3.0;
/// Bits in which the codes of one point may differ in two views.
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

/// An observation of a view, and the observations of other views that show the same point: view, observation.
type Ranked = (usize, Vec<(usize, usize)>);

/// Returns at most `limit` landmarks: of each view, its share of the points that most of its neighbours show, too.
/// A point that several views show is taken once.
pub fn build(views: &[MappingView], limit: usize) -> Vec<Landmark> {
    let finders: Vec<Finder<'_>> = views.iter().map(Finder::new).collect();
    let middles: Vec<DVec3> = views
        .iter()
        .map(|view| middle(view.observations.iter().map(|o| o.point_in_world).collect()))
        .collect();
    let mut chosen: Vec<Vec<bool>> = views.iter().map(|view| vec![false; view.observations.len()]).collect();
    let mut hidden = chosen.clone();
    // By view: observations with the others that show the same point, those with most first.
    let ranked: Vec<Vec<Ranked>> = (0..views.len())
        .map(|at| {
            let mut others: Vec<usize> = (0..views.len()).filter(|other| *other != at).collect();
            let apart = |other: &usize| middles[at].distance_squared(middles[*other]);
            others.sort_by(|a, b| apart(a).total_cmp(&apart(b)).then(a.cmp(b)));
            others.truncate(N_NEIGHBOURS);
            let seen = |observation: &Observation| {
                let of_view = |other: &usize| Some((*other, finders[*other].find(observation)?));
                others.iter().filter_map(of_view).collect::<Vec<_>>()
            };
            let mut ranked: Vec<_> = views[at].observations.iter().map(seen).enumerate().collect();
            ranked.sort_by_key(|(index, seen)| (std::cmp::Reverse(seen.len()), *index));
            ranked
        })
        .collect();
    let mut next = vec![0; views.len()];
    let mut landmarks = Vec::new();
    // In turn, one of each view, until there are enough or no more.
    loop {
        let before = landmarks.len();
        for (at, view) in views.iter().enumerate() {
            if landmarks.len() == limit {
                return landmarks;
            }
            while let Some((index, seen)) = ranked[at].get(next[at]) {
                next[at] += 1;
                if hidden[at][*index] || chosen[at][*index] {
                    continue;
                }
                chosen[at][*index] = true;
                seen.iter().for_each(|(other, index)| hidden[*other][*index] = true);
                let Observation { point_in_world, code, .. } = view.observations[*index];
                landmarks.push(Landmark { position_in_world: point_in_world, code, view: view.view });
                break;
            }
        }
        if landmarks.len() == before {
            return landmarks;
        }
    }
}

/// Finds the feature of a view at a place.
struct Finder<'a> {
    view: &'a MappingView,
    camera: Pinhole,
    bins: BTreeMap<(i64, i64), Vec<usize>>,
}

fn bin(at: DVec2) -> (i64, i64) {
    ((at.x / SAME_FEATURE_PX).floor() as i64, (at.y / SAME_FEATURE_PX).floor() as i64)
}

impl<'a> Finder<'a> {
    fn new(view: &'a MappingView) -> Self {
        let mut bins: BTreeMap<(i64, i64), Vec<usize>> = BTreeMap::new();
        for (index, observation) in view.observations.iter().enumerate() {
            bins.entry(bin(observation.at)).or_default().push(index);
        }
        Self { view, camera: Pinhole::new(&view.intrinsics), bins }
    }

    /// Returns the view's feature that shows the point of another view's.
    fn find(&self, of: &Observation) -> Option<usize> {
        let at = self.camera.pixel(self.view.camera_from_world.transform_point3(of.point_in_world))?;
        let (x, y) = bin(at);
        let around = (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).map(move |y| (x, y)));
        let near = around.filter_map(|bin| self.bins.get(&bin)).flatten().copied();
        let near = near.filter(|index| self.view.observations[*index].at.distance(at) < SAME_FEATURE_PX);
        let alike = near.map(|index| (distance(of.code, self.view.observations[index].code), index));
        alike.min().filter(|(bits, _)| *bits <= SAME_FEATURE_BITS).map(|(_, index)| index)
    }
}
