//! The things on board: their names, made on first request, then only read; and their area.

use std::cmp::Reverse;
use std::sync::{Arc, OnceLock, PoisonError};
use std::time::Duration;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_api::FRAME;
use slag_api::objects::{MAX_NAMES, ObjectOnBoard, ObjectPage, OrientedBox};
use slag_common::frames::Aabb;
use slag_common::objects::public_id;

use super::answers::ClusterAnswer;
use super::cluster::{Grouping, cluster};
use super::engine::{Engine, OnBoard, QueryError};
use super::names::{Names, Words};
use super::objects::{self, FoundObject};
use super::oriented::Extent;
use super::request::RequestError;
use super::scene::{Scene, alignment, default_voxel, unit};
use crate::score::{Budget, Region, Run};
use crate::text::TextService;

// The API's description states the number of names.
const _: () = assert!(MAX_NAMES == slag_models::names::MAX_NAMES);

pub const OBJECT_ID: &str = "^o[0-9a-f]{16}$";

/// Order of the objects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ObjectOrder {
    /// By id.
    #[default]
    Id,
    /// By the best name, the surest first; those without names last.
    Name,
    /// By the area of the largest face of the box, the largest first.
    Area,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct ObjectFilter {
    pub after: Option<u64>,
    pub region: Region,
    pub min_size: f64,
    pub order: ObjectOrder,
}

/// Longest wait of a request for the words.
pub(crate) const NAMES_WAIT: Duration = Duration::from_millis(500);

impl Engine {
    /// Returns the names of the things on board, waiting at most `wait` for the words; `None` if the text model is
    /// still encoding them, has stopped, or is not the scene's.
    pub(crate) fn names<'a>(
        &self,
        on_board: &'a OnBoard,
        wait: Duration,
        budget: &Budget,
    ) -> Result<Option<&'a Names>, QueryError> {
        if let Some(names) = on_board.names.get() {
            return Ok(Some(names));
        }
        if on_board.check().is_err() {
            return Ok(None);
        }
        let Some(words) = self.words(&on_board.text).wait(wait) else { return Ok(None) };
        let used_bytes = budget.used_bytes();
        let made = Names::new(words, &Scene::of(&on_board.snapshot), budget);
        budget.give_back_to(used_bytes, 0);
        let made = made?;
        Ok(Some(on_board.names.get_or_init(|| made)))
    }

    pub(crate) fn begin_names(&self) {
        if let Ok(on_board) = self.on_board()
            && on_board.check().is_ok()
        {
            self.words(&on_board.text);
        }
    }

    /// Returns a text model's words; first starts their encoding.
    fn words(&self, text: &Arc<TextService>) -> Arc<Words> {
        let encoder_id = text.info().id;
        let mut kept = self.words.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(words) = kept.as_ref().filter(|words| words.are_of(encoder_id)) {
            return Arc::clone(words);
        }
        let begun = Words::begin(self.cache(), text);
        Arc::clone(kept.insert(begun))
    }

    /// Returns at most `limit` objects on board that pass a filter; waits at most `wait` for their names.
    pub fn objects(
        &self,
        on_board: &OnBoard,
        filter: &ObjectFilter,
        limit: usize,
        wait: Duration,
        budget: &Budget,
    ) -> Result<ObjectPage, QueryError> {
        let names = self.names(on_board, wait, budget)?;
        let scene = Scene::of(&on_board.snapshot);
        budget.take(limit.min(scene.index.len()) * size_of::<ObjectOnBoard>());
        let unmeasured = || (0..scene.index.len()).map(|_| OnceLock::new()).collect();
        let boxes: &[OnceLock<OrientedBox>] = on_board.boxes.get_or_init(unmeasured);
        let page = page(&scene, (names, boxes), filter, limit, budget);
        budget.check()?;
        Ok(page?)
    }
}

impl Scene<'_> {
    /// Returns the object with an id. Check the budget afterwards.
    pub fn object(&self, id: u64, names: Option<&Names>, budget: &Budget) -> Option<ObjectOnBoard> {
        let object = self.number_of(id)?;
        take_points(self, object, budget).then(|| describe(self, names, object, &OnceLock::new()))
    }

    /// Returns an object's thumbnail, a JPEG file; outer `None`: no such object.
    pub fn thumbnail(&self, id: u64) -> Option<Option<Vec<u8>>> {
        Some(objects::thumbnail(self, self.number_of(id)?).map(<[u8]>::to_vec))
    }

    /// Returns at most `limit` positions of an object's Gaussians on board, evenly spread over their order: those of
    /// its largest cluster inside the cluster's box. Some objects have nearly as many stray Gaussians as their own.
    pub(crate) fn object_points(&self, id: u64, limit: usize, budget: &Budget) -> Vec<DVec3> {
        match self.number_of(id).filter(|object| take_points(self, *object, budget)) {
            Some(object) => thinned(largest_cluster(self, object), limit),
            None => Vec::new(),
        }
    }

    /// As [`Scene::object_points`], of an answer that lists its members.
    pub(crate) fn answer_points(&self, answer: &ClusterAnswer, limit: usize, budget: &Budget) -> Vec<DVec3> {
        if !budget.take(answer.n_gaussians as usize * size_of::<DVec3>()) {
            return Vec::new();
        }
        let bounds = Aabb { min: answer.box_min_in_world, max: answer.box_max_in_world };
        thinned(points_of(self, &answer.members, &bounds), limit)
    }

    fn number_of(&self, id: u64) -> Option<usize> {
        // Objects are in order of their ids.
        let (mut low, mut high) = (0, self.index.len());
        while low < high {
            let middle = low.midpoint(high);
            if objects::record(self, middle).id < id { low = middle + 1 } else { high = middle }
        }
        (low < self.index.len() && objects::record(self, low).id == id).then_some(low)
    }
}

fn points_of(scene: &Scene<'_>, members: &[Run], bounds: &Aabb) -> Vec<DVec3> {
    let point = |run: &Run, index: u32| scene.shards[run.shard as usize].position_in_world(index as usize);
    let all = members.iter().flat_map(|run| (run.start..run.end).map(move |index| point(run, index)));
    all.filter(|point| bounds.contains(*point)).collect()
}

fn thinned(points: Vec<DVec3>, limit: usize) -> Vec<DVec3> {
    let step = points.len().div_ceil(limit.max(1)).max(1);
    points.into_iter().step_by(step).collect()
}

/// Charges the memory for the positions of an object's Gaussians; returns whether the work may go on.
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
    let clusters = cluster(&scene.shards, &runs, &grouping, &Budget::default()).clusters;
    let Some(largest) = clusters.into_iter().max_by_key(|of| (of.n_gaussians, Reverse(of.first))) else {
        return Vec::new();
    };
    points_of(scene, &largest.members, &largest.extent.box_in_world)
}

fn page(
    scene: &Scene<'_>,
    (names, boxes): (Option<&Names>, &[OnceLock<OrientedBox>]),
    filter: &ObjectFilter,
    limit: usize,
    budget: &Budget,
) -> Result<ObjectPage, RequestError> {
    let passes = |object: &usize| {
        let record = objects::record(scene, *object);
        filter.region.contains(record.position()) && record.bounds().size().max_element() >= filter.min_size
    };
    let mut all: Vec<usize> = (0..scene.index.len()).filter(passes).collect();
    sort(scene, names, filter.order, &mut all);
    let id = |object: &usize| objects::record(scene, *object).id;
    let first = match filter.after {
        None => 0,
        Some(after) if filter.order == ObjectOrder::Id => all.partition_point(|object| id(object) <= after),
        Some(after) => {
            let at = all.iter().position(|object| id(object) == after);
            let refused =
                || RequestError::new("after", &public_id(after), "next_after of a page of the same objects");
            at.ok_or_else(refused)? + 1
        }
    };
    // Positions are needed for one object at a time.
    let described = |at: &usize| {
        let (used_bytes, measured) = (budget.used_bytes(), &boxes[*at]);
        let may_go_on = measured.get().is_some() || take_points(scene, *at, budget);
        let described = may_go_on.then(|| describe(scene, names, *at, measured));
        budget.give_back_to(used_bytes, 0);
        described
    };
    let end = first.saturating_add(limit).min(all.len());
    let objects: Vec<ObjectOnBoard> = all[first..end].iter().map_while(described).collect();
    let is_last = end == all.len();
    let next_after = objects.last().filter(|_| !is_last).map(|last| last.id.clone());
    let manifest = scene.manifest;
    Ok(ObjectPage {
        scene: manifest.scene.clone(),
        generation: manifest.generation,
        frame: FRAME.into(),
        unit: unit(manifest).into(),
        named: names.is_some(),
        n_objects: all.len(),
        next_after,
        coverage: scene.coverage(&filter.region),
        objects,
    })
}

/// Sorts objects that arrive in order of their ids.
fn sort(scene: &Scene<'_>, names: Option<&Names>, order: ObjectOrder, all: &mut [usize]) {
    match (order, names) {
        (ObjectOrder::Id, _) | (ObjectOrder::Name, None) => {}
        (ObjectOrder::Name, Some(names)) => {
            let best = |object: &usize| names.of(*object).next();
            all.sort_by(|a, b| match (best(a), best(b)) {
                (Some(a), Some(b)) => a.0.cmp(b.0).then(b.1.total_cmp(&a.1)),
                (a, b) => a.is_none().cmp(&b.is_none()),
            });
        }
        (ObjectOrder::Area, _) => {
            let area = |object: &usize| {
                let [x, y, z] = objects::record(scene, *object).bounds().size().to_array();
                (x * y).max(x * z).max(y * z)
            };
            all.sort_by(|a, b| area(b).total_cmp(&area(a)));
        }
    }
}

/// Describes an object. `measured`: its oriented box if known.
fn describe(
    scene: &Scene<'_>,
    names: Option<&Names>,
    object: usize,
    measured: &OnceLock<OrientedBox>,
) -> ObjectOnBoard {
    let (record, everywhere) = (objects::record(scene, object), Region::default());
    let n_gaussians = objects::count_in(scene, object, &everywhere);
    let found = FoundObject { object, record, score: 0.0, n_gaussians, cut: None };
    let Extent { position_in_world, box_in_world: Aabb { min, max } } = found.extent();
    ObjectOnBoard {
        id: found.public_id(),
        names: names.map(|names| names.describe(object)).unwrap_or_default(),
        frame: FRAME.into(),
        generation: scene.manifest.generation,
        position_in_world,
        geographic: scene.manifest.geo_reference.map(|geo| geo.geographic_from_world(position_in_world)),
        box_min_in_world: min,
        box_max_in_world: max,
        oriented_box: *measured
            .get_or_init(|| objects::oriented_box(scene, &found, &everywhere, alignment(scene.manifest))),
        n_gaussians,
        n_gaussians_in_scene: u64::from(record.n_gaussians),
        evidence: objects::evidence(scene, object),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::Ordering;

    use super::*;
    use crate::store::EdgeCache;
    use crate::testing::{
        CALIBRATION, Gate, Member, TestObject, TestShard, axes_service, open_gate, write_cache,
    };

    /// No names while the text model answers a question; then each word is encoded once, for all callers.
    #[test]
    fn names_come_once_the_words_are_encoded() {
        let dir = tempfile::tempdir().expect("a folder");
        let members = (0..9).map(|i| Member { steps: [i, 0, 0], embedding: vec![0.0, 1.0, 0.0] }).collect();
        let object = TestObject {
            id: 4,
            vectors: vec![0.0, 1.0, 0.0],
            runs: std::iter::once(0..9).collect(),
            n_gaussians: 9,
        };
        let shard = TestShard::new(vec![members]).build(false).with_objects(&[object], CALIBRATION);
        write_cache(dir.path(), &[shard], 1);
        let gate = Gate::default();
        let (text, n_encoded) = axes_service(3, Arc::clone(&gate));
        let engine = Engine::new(EdgeCache::open(dir.path()), text);
        engine.reload().expect("a scene");
        let on_board = engine.on_board().expect("a scene");
        let budget = Budget::default();
        std::thread::scope(|threads| {
            threads.spawn(|| on_board.text.run("wait".to_owned()).expect("answers"));
            while n_encoded.load(Ordering::SeqCst) == 0 {
                std::thread::yield_now();
            }
            let early = engine.names(&on_board, Duration::from_millis(20), &budget).expect("no error");
            open_gate(&gate);
            assert!(early.is_none());
        });
        for _ in 0..2 {
            let names = engine.names(&on_board, Duration::from_secs(20), &budget).expect("no error");
            let names = names.expect("the words are encoded");
            assert_eq!((names.len(), names.describe(0)[0].name.as_str()), (1, "1"));
        }
        assert_eq!(n_encoded.load(Ordering::SeqCst), 1 + 3);
    }
}
