//! Answers made of objects, which are scored as a whole.
//!
//! An object in several cells is stored in all their shards and scored once, with its Gaussians in the region.

use glam::DVec3;
use slag_api::objects::{Alignment, Evidence, OrientedBox};
use slag_common::manifest::Calibration;
use slag_common::objects::{ObjectRecord, Objects, public_id};

use super::oriented::{Extent, TRIMMED, box_around};
use super::scene::Scene;
use crate::score::{Region, Run};
use crate::store::objects::Part;

#[derive(Clone, Copy)]
pub struct FoundObject<'a> {
    pub object: usize,
    pub record: &'a ObjectRecord,
    pub score: f32,
    /// Gaussians on board in the region.
    pub n_gaussians: u64,
    /// Their extent if the region cuts the object.
    pub cut: Option<Extent>,
}

impl FoundObject<'_> {
    /// Returns the extent of the part in the region.
    pub fn extent(&self) -> Extent {
        let whole =
            || Extent { position_in_world: self.record.position(), box_in_world: self.record.bounds() };
        self.cut.unwrap_or_else(whole)
    }

    pub fn public_id(&self) -> String {
        public_id(self.record.id)
    }
}

/// Returns whether at least `min_count` of an object's Gaussians, and at least one, lie in a region.
pub fn in_region(scene: &Scene<'_>, object: usize, region: &Region, min_count: u64) -> bool {
    count_in(scene, object, region) >= min_count.max(1)
}

pub fn count_in(scene: &Scene<'_>, object: usize, region: &Region) -> u64 {
    scene.index.parts(object).iter().map(|part| count(scene, *part, region)).sum()
}

/// Returns the mean and spread of a bank of texts' scores over the scene's objects.
pub fn calibration(objects: &[Option<Objects<'_>>]) -> Option<Calibration> {
    let header = objects.iter().flatten().next()?.header;
    Some(Calibration { score_mean: header.score_mean, score_spread: header.score_spread })
}

pub fn best(scores: &[f32]) -> Option<usize> {
    (0..scores.len()).reduce(|best, object| if scores[object] > scores[best] { object } else { best })
}

/// A scene's objects with their scores for a question. Only those with at least `min_count` Gaussians (and at least
/// one) in the region count.
#[derive(Clone, Copy)]
pub struct ScoredObjects<'s, 'a> {
    pub scene: &'s Scene<'a>,
    pub scores: &'s [f32],
    pub region: &'s Region,
    pub min_count: u64,
}

impl<'a> ScoredObjects<'_, 'a> {
    /// Returns those that reach a threshold, by id.
    pub fn reaching(&self, threshold: f32) -> Vec<FoundObject<'a>> {
        let reaching = (0..self.scores.len()).filter(|object| self.scores[*object] >= threshold);
        reaching.filter_map(|object| self.found(object)).collect()
    }

    pub fn best(&self) -> Option<FoundObject<'a>> {
        let mut best: Option<usize> = None;
        for (object, score) in self.scores.iter().enumerate() {
            if best.is_none_or(|best| *score > self.scores[best])
                && in_region(self.scene, object, self.region, self.min_count)
            {
                best = Some(object);
            }
        }
        self.found(best?)
    }

    fn found(&self, object: usize) -> Option<FoundObject<'a>> {
        let Self { scene, region, .. } = *self;
        let (record, n_gaussians) = (record(scene, object), count_in(scene, object, region));
        if n_gaussians < self.min_count.max(1) {
            return None;
        }
        let cut = (!region.covers(&record.bounds())).then(|| {
            let parts = scene.index.parts(object).iter();
            Extent::of(&parts.flat_map(|part| points(scene, *part, region)).collect::<Vec<DVec3>>())
        });
        Some(FoundObject { object, record, score: self.scores[object], n_gaussians, cut })
    }
}

pub fn record<'a>(scene: &Scene<'a>, object: usize) -> &'a ObjectRecord {
    let first = scene.index.parts(object)[0];
    &of_part(scene, first).records[first.number as usize]
}

pub fn evidence(scene: &Scene<'_>, object: usize) -> Evidence {
    let record = record(scene, object);
    Evidence {
        photo: of_part(scene, scene.index.parts(object)[0]).photo(record).to_owned(),
        box_px: record.photo_box_px,
        has_thumbnail: thumbnail(scene, object).is_some(),
    }
}

/// Returns an object's small picture, a JPEG file, if one of its shards has it.
pub fn thumbnail<'a>(scene: &Scene<'a>, object: usize) -> Option<&'a [u8]> {
    let of_part = |part: &Part| of_part(scene, *part).thumbnails?.get(part.number as usize);
    scene.index.parts(object).iter().find_map(of_part)
}

pub fn oriented_box(
    scene: &Scene<'_>,
    found: &FoundObject<'_>,
    region: &Region,
    alignment: Alignment,
) -> OrientedBox {
    let parts = scene.index.parts(found.object).iter();
    let points: Vec<DVec3> = parts.flat_map(|part| points(scene, *part, region)).collect();
    let bounds = found.extent().box_in_world;
    box_around(&points, |point| bounds.contains(*point), alignment, TRIMMED)
}

/// Returns an object's Gaussians in a region, by shard and index. `score`: the object's.
pub fn members(scene: &Scene<'_>, object: usize, region: &Region, score: f32) -> Vec<Run> {
    let mut members: Vec<Run> = Vec::new();
    for part in scene.index.parts(object) {
        let shard = &scene.shards[part.shard as usize];
        let indices = scene.index.runs(*part, of_part(scene, *part)).flatten();
        for index in indices.filter(|index| region.contains(shard.position_in_world(*index as usize))) {
            match members.last_mut() {
                Some(last) if (last.shard, last.end) == (part.shard, index) => last.end = index + 1,
                _ => members.push(Run { shard: part.shard, start: index, end: index + 1, score }),
            }
        }
    }
    members
}

/// Returns the number of a part's Gaussians in a region; examines them only if the region's border crosses the shard.
fn count(scene: &Scene<'_>, part: Part, region: &Region) -> u64 {
    let reach = scene.shards[part.shard as usize].position_box();
    if !region.touches(&reach) {
        return 0;
    }
    if region.covers(&reach) {
        return u64::from(of_part(scene, part).records[part.number as usize].n_gaussians_here);
    }
    points(scene, part, region).count() as u64
}

fn points<'a>(scene: &'a Scene<'_>, part: Part, region: &'a Region) -> impl Iterator<Item = DVec3> + 'a {
    let shard = &scene.shards[part.shard as usize];
    let members = scene.index.runs(part, of_part(scene, part)).flatten();
    members.map(|i| shard.position_in_world(i as usize)).filter(|point| region.contains(*point))
}

fn of_part<'s, 'a>(scene: &'s Scene<'a>, part: Part) -> &'s Objects<'a> {
    match &scene.objects[part.shard as usize] {
        Some(objects) => objects,
        None => unreachable!("only shards with objects have parts"),
    }
}
