//! The things on board, and the area that they lie in.

use std::cmp::Reverse;

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;
use slag_common::frames::{Aabb, Geographic};

use super::answers::Evidence;
use super::cluster::{Grouping, cluster};
use super::engine::{Engine, QueryError};
use super::extent::Extent;
use super::frame::{FRAME, UNITS, unit};
use super::objects::{self, FoundObject};
use super::oriented::OrientedBox;
use super::scene::{Scene, alignment, default_voxel};
use crate::score::{Budget, Region, Run, ScoreError};
use crate::store::Snapshot;

/// The form of an object's id.
pub const OBJECT_ID: &str = "^o[0-9a-f]{16}$";

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ObjectFilter {
    /// Only those with larger ids.
    pub after: Option<u64>,
    /// Only those with their position within this distance of a point.
    pub ball: Option<(DVec3, f64)>,
    /// Least length of the longest edge of the box.
    pub min_size: f64,
}

/// An object on board.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "Object")]
pub struct ObjectOnBoard {
    /// Its id: `o` and 16 hex digits.
    pub id: String,
    /// Frame of every position.
    #[schemars(extend("enum" = [FRAME]))]
    pub frame: &'static str,
    /// Generation that they belong to.
    pub generation: u64,
    /// Mean of its Gaussians inside the box.
    #[schemars(with = "[f64; 3]")]
    pub position_in_world: DVec3,
    /// The same on the earth, if the scene is geo-referenced.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geographic: Option<Geographic>,
    /// Smallest corner of its box.
    #[schemars(with = "[f64; 3]")]
    pub box_min_in_world: DVec3,
    /// Largest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_max_in_world: DVec3,
    /// Its box along axes of its own; of the part on board.
    pub oriented_box: OrientedBox,
    /// Its Gaussians on board.
    pub n_gaussians: u64,
    /// Its Gaussians in the whole scene.
    pub n_gaussians_in_scene: u64,
    /// The photo that shows it best.
    pub evidence: Evidence,
}

/// A page of the objects on board.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct ObjectPage {
    /// Name of the scene.
    pub scene: String,
    /// Its generation.
    pub generation: u64,
    /// Frame of every position: the scene's world frame.
    #[schemars(extend("enum" = [FRAME]))]
    pub frame: &'static str,
    /// Unit of every position and length: `m`, or `world` if the scene is not metric.
    #[schemars(extend("enum" = UNITS))]
    pub unit: &'static str,
    /// Objects that pass the filter, over all pages.
    pub n_objects: usize,
    /// `after` of the next page; null if there is none.
    pub next_after: Option<String>,
    /// The objects, by id.
    pub objects: Vec<ObjectOnBoard>,
}

/// Reads an object's id as answers name it.
pub fn object_id(text: &str) -> Option<u64> {
    let digits = text.strip_prefix('o')?;
    let is_hex = digits.len() == 16 && digits.bytes().all(|b| b.is_ascii_hexdigit());
    is_hex.then(|| u64::from_str_radix(digits, 16).ok())?
}

impl Engine {
    /// Returns the objects of a generation that pass a filter, by id, at most `limit`.
    pub fn objects(
        &self,
        snapshot: &Snapshot,
        filter: &ObjectFilter,
        limit: usize,
        budget: &Budget,
    ) -> Result<ObjectPage, QueryError> {
        budget.take(limit.min(snapshot.objects.len()) * size_of::<ObjectOnBoard>());
        let page = self.on_scene(snapshot, budget, |_, scene| page(scene, filter, limit, budget));
        budget.check().map_err(ScoreError::from)?;
        Ok(page)
    }

    pub fn object(
        &self,
        snapshot: &Snapshot,
        id: u64,
        budget: &Budget,
    ) -> Result<Option<ObjectOnBoard>, QueryError> {
        let found = self.on_scene(snapshot, budget, |_, scene| {
            let object = number_of(scene, id)?;
            take_points(scene, object, budget).then(|| describe(scene, object))
        });
        budget.check().map_err(ScoreError::from)?;
        Ok(found)
    }

    /// Returns the positions of Gaussians of an object on board, evenly spread over their order, at most `limit`:
    /// those of its largest cluster, inside the cluster's box. Objects have stray Gaussians, too, some nearly as
    /// many as their own.
    pub(crate) fn object_points(
        &self,
        snapshot: &Snapshot,
        id: u64,
        limit: usize,
        budget: &Budget,
    ) -> Vec<DVec3> {
        self.on_scene(snapshot, budget, |_, scene| {
            let Some(object) = number_of(scene, id) else { return Vec::new() };
            if !take_points(scene, object, budget) {
                return Vec::new();
            }
            let points: Vec<DVec3> = largest_cluster(scene, object);
            let step = points.len().div_ceil(limit.max(1)).max(1);
            points.into_iter().step_by(step).collect()
        })
    }
}

/// Takes the memory that the positions of an object's Gaussians need; returns whether the work may go on.
fn take_points(scene: &Scene<'_>, object: usize, budget: &Budget) -> bool {
    let n_gaussians = objects::count_in(scene, object, &Region::default());
    budget.take(n_gaussians as usize * size_of::<DVec3>())
}

pub(super) fn largest_cluster(scene: &Scene<'_>, object: usize) -> Vec<DVec3> {
    let runs = objects::members(scene, object, &Region::default(), 1.0);
    let grouping = Grouping {
        voxel: default_voxel(scene.manifest),
        min_count: 1,
        threshold: 1.0,
        alignment: alignment(scene.manifest),
        with_members: true,
    };
    let clusters = cluster(scene.shards, &runs, &grouping, &Budget::default()).clusters;
    let Some(largest) = clusters.into_iter().max_by_key(|of| (of.n_gaussians, Reverse(of.first))) else {
        return Vec::new();
    };
    let point = |run: &Run, index: u32| scene.shards[run.shard as usize].position_in_world(index as usize);
    let all = largest.members.iter().flat_map(|run| (run.start..run.end).map(move |index| point(run, index)));
    all.filter(|point| largest.extent.box_in_world.contains(*point)).collect()
}

/// Returns the number of an object in the index.
fn number_of(scene: &Scene<'_>, id: u64) -> Option<usize> {
    // Objects are in order of their ids.
    let (mut low, mut high) = (0, scene.index.len());
    while low < high {
        let middle = low.midpoint(high);
        if objects::record(scene, middle).id < id { low = middle + 1 } else { high = middle }
    }
    (low < scene.index.len() && objects::record(scene, low).id == id).then_some(low)
}

fn page(scene: &Scene<'_>, filter: &ObjectFilter, limit: usize, budget: &Budget) -> ObjectPage {
    let passes = |object: &usize| {
        let record = objects::record(scene, *object);
        filter.ball.is_none_or(|(centre, radius)| record.position().distance(centre) <= radius)
            && record.bounds().size().max_element() >= filter.min_size
    };
    let all: Vec<usize> = (0..scene.index.len()).filter(passes).collect();
    let is_after = |object: &usize| filter.after.is_none_or(|id| objects::record(scene, *object).id > id);
    let mut rest = all.iter().copied().filter(is_after);
    // Positions are needed for one at a time.
    let described = |at: usize| {
        let used_bytes = budget.used_bytes();
        let described = take_points(scene, at, budget).then(|| describe(scene, at));
        budget.give_back_to(used_bytes, 0);
        described
    };
    let objects: Vec<ObjectOnBoard> = rest.by_ref().take(limit).map_while(described).collect();
    let next_after = rest.next().and_then(|_| objects.last()).map(|last| last.id.clone());
    let manifest = scene.manifest;
    ObjectPage {
        scene: manifest.scene.clone(),
        generation: manifest.generation,
        frame: FRAME,
        unit: unit(manifest),
        n_objects: all.len(),
        next_after,
        objects,
    }
}

fn describe(scene: &Scene<'_>, object: usize) -> ObjectOnBoard {
    let (record, everywhere) = (objects::record(scene, object), Region::default());
    let n_gaussians = objects::count_in(scene, object, &everywhere);
    let found = FoundObject { object, record, score: 0.0, n_gaussians, cut: None };
    let Extent { position_in_world, box_in_world: Aabb { min, max } } = found.extent();
    ObjectOnBoard {
        id: found.public_id(),
        frame: FRAME,
        generation: scene.manifest.generation,
        position_in_world,
        geographic: scene.manifest.geo_reference.map(|geo| geo.geographic_from_world(position_in_world)),
        box_min_in_world: min,
        box_max_in_world: max,
        oriented_box: objects::oriented_box(scene, &found, &everywhere, alignment(scene.manifest)),
        n_gaussians,
        n_gaussians_in_scene: u64::from(record.n_gaussians),
        evidence: Evidence { photo: objects::photo(scene, object).to_owned(), box_px: record.photo_box_px },
    }
}
