use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;

use glam::DVec3;
use slag_common::Gaussians;
use slag_common::objects::object_score;
use slag_common::shard::Basis;
use slag_math::random::Random;
use slag_test_support::assert_error;

use super::shards::{CellObjects, CentroidBasis};
use super::tree::Evidence;
use super::*;
use crate::cells::{CellLimits, CellSplit, split};
use crate::codebook::{ScoreMetric, ScoreMetricContext, TextBank};
use crate::ground::Standing;
use crate::lift::photos::{MaskOutline, Photo};
use crate::lift::superpoint::Superpoints;
use crate::lift::{
    Contribution, ContributionError, ContributionIndex, RegionTable, SceneContributions, ViewContributions,
};
use crate::masks::Mask;

/// Things in a row of cells, as contribution files; masks of thing i have the vector of axis i.
struct World {
    gaussians: Gaussians,
    split: CellSplit,
    index: ContributionIndex,
    table: RegionTable,
    photos: Vec<Photo>,
    score_context: ScoreMetricContext,
    _dir: tempfile::TempDir,
}

const DIM: usize = 8;
const PER_THING: u32 = 60;

fn world() -> World {
    let n = 3 * PER_THING;
    let means =
        (0..n).map(|i| DVec3::new(f64::from(i / PER_THING) * 10.0, f64::from(i % PER_THING) * 0.1, 0.0));
    let gaussians = Gaussians::balls(means.collect(), 0.1);
    // Cells of at most 70 cut the things.
    let split = split(&gaussians, CellLimits::by_count(70));
    let mut random = Random::new(3);
    let mut views = Vec::new();
    for view in 0..6u32 {
        let mut entries: BTreeMap<u32, Vec<Contribution>> = BTreeMap::new();
        for i in 0..n {
            if random.below(10) >= 8 {
                continue;
            }
            let (cell, local) = (split.cell_of_gaussian[i as usize], split.local_of_gaussian[i as usize]);
            let thing = i / PER_THING;
            // Some of each lies under a neighbour's mask; the last view sees thing 2 whole and large.
            let weight = if view == 5 && thing == 2 { 9.0 } else { 1.0 + random.below(8) as f32 / 8.0 };
            let spilt = Contribution { local, region: (thing + 1) % 3, weight: 0.25 };
            let mut of_gaussian = vec![Contribution { local, region: thing, weight }, spilt];
            of_gaussian.sort_by_key(|entry| entry.region);
            entries.entry(cell).or_default().extend(of_gaussian);
        }
        entries.values_mut().for_each(|entries| entries.sort_by_key(|entry| (entry.local, entry.region)));
        views.push(ViewContributions {
            dim: DIM,
            mask_vectors: (0..3).flat_map(axis).collect(),
            masks_of_region: vec![vec![0], vec![1], vec![2]],
            entries_of_cell: entries.into_iter().collect(),
        });
    }
    World::new(gaussians, split, &views)
}

fn axis(of: usize) -> impl Iterator<Item = f32> {
    (0..DIM).map(move |c| f32::from(u8::from(c == of % DIM)))
}

impl World {
    fn new(gaussians: Gaussians, split: CellSplit, views: &[ViewContributions]) -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let (mut paths, mut photos) = (Vec::new(), Vec::new());
        for (view, contributions) in (0u32..).zip(views) {
            let path = dir.path().join(format!("{view}.contributions"));
            contributions.write(&path).expect("writes");
            paths.push(path);
            let outline =
                |mask| MaskOutline { box_px: [view, mask, view + 10, mask + 10], ..MaskOutline::default() };
            let outlines = (0..(contributions.mask_vectors.len() / DIM) as u32).map(outline).collect();
            photos.push(Photo { name: format!("{view}.jpg"), outlines });
        }
        let n_of_cell: Vec<usize> = split.cells.iter().map(|cell| cell.gaussians.len()).collect();
        let (index, table) = ContributionIndex::open(&paths, DIM, &n_of_cell).expect("opens");
        let bank = TextBank::directions(DIM);
        let metric = ScoreMetric::new(DIM, &bank);
        let spread = metric.spread(table.mask_vectors());
        let score_context = ScoreMetricContext { metric, bank, spread };
        Self { gaussians, split, index, table, photos, score_context, _dir: dir }
    }

    fn objects(&self, group_bytes: u64) -> SceneObjects {
        self.objects_of(None, group_bytes, false).expect("not cancelled")
    }

    fn objects_of(
        &self,
        superpoints: Option<&Superpoints>,
        group_bytes: u64,
        is_cancelled: bool,
    ) -> Result<SceneObjects, ContributionError> {
        let Self { gaussians, split, index, photos, .. } = self;
        let cancel = &AtomicBool::new(is_cancelled);
        let standing = &Standing::default();
        let scene = SceneContributions { index, gaussians, split, standing, photos, group_bytes, cancel };
        find(&scene, &self.table, superpoints, &self.score_context)
    }
}

/// Oracle: the world's things.
#[test]
fn objects_are_the_things_for_any_threads_and_memory() {
    let world = world();
    let found = world.objects(u64::MAX);
    assert_eq!(found.objects.len(), 3, "{:?}", found.report);
    assert!(world.split.cells.len() > 2);
    let mut thing_of_object = BTreeMap::new();
    for (cell, of_cell) in world.split.cells.iter().zip(&found.object_of) {
        for (gaussian, object) in cell.gaussians.iter().zip(of_cell).filter(|(_, object)| **object != NONE) {
            let thing = gaussian / PER_THING;
            assert_eq!(*thing_of_object.entry(*object).or_insert(thing), thing, "Gaussian {gaussian}");
        }
    }
    for (object, thing) in thing_of_object {
        let object = &found.objects[object as usize];
        assert_eq!((object.n_gaussians, object.n_masks), (PER_THING, 6), "{object:?}");
        assert!((object.position_in_world.x - f64::from(thing) * 10.0).abs() < 1e-9, "{object:?}");
        let y = [object.box_in_world.min.y, object.box_in_world.max.y];
        assert!((y[0] - 0.1).abs() < 0.15 && (y[1] - 5.8).abs() < 0.15, "{object:?}");
        let cosines: Vec<f32> = object.vectors.chunks(DIM).map(|v| v[thing as usize]).collect();
        assert!((object_score(&cosines) - 1.0).abs() < 1e-6, "{cosines:?}");
        if thing == 2 {
            assert_eq!((object.photo.as_str(), object.photo_box_px), ("5.jpg", [5, 2, 15, 12]));
        }
    }
    // If that photo's edge cuts most of the thing off, another one shows it better.
    let mut cut = self::world();
    cut.photos[5].outlines[2].cut_px = 38;
    let of_thing = |objects: &[Object]| objects.iter().position(|object| object.photo_box_px[1] == 2);
    let whole = of_thing(&found.objects).expect("it is there");
    assert_ne!(cut.objects(u64::MAX).objects[whole].photo, "5.jpg");
    for n_threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().expect("threads");
        for group_bytes in [0, 4_000, u64::MAX] {
            assert_eq!(pool.install(|| world.objects(group_bytes)), found, "{n_threads} {group_bytes}");
        }
    }
}

/// By hand: fillers judge nothing, so objects, masks and consensus are those of the other views.
#[test]
fn fillers_are_no_evidence() {
    let mut world = world();
    let of_all = world.objects(u64::MAX);
    let n_masks = world.photos.iter().flat_map(|photo| &photo.outlines).count();
    let is_filler = |mask: usize| mask < 6;
    world.table.set_levels((0..n_masks).map(|mask| if is_filler(mask) { Mask::FILLER } else { 0 }).collect());
    let found = world.objects(u64::MAX);
    let n_masks_of =
        |found: &SceneObjects| found.objects.iter().map(|object| object.n_masks).collect::<Vec<_>>();
    assert_eq!((n_masks_of(&of_all), n_masks_of(&found)), (vec![6; 3], vec![4; 3]));
    world.table.set_levels(vec![Mask::FILLER; n_masks]);
    assert!(world.objects(u64::MAX).objects.is_empty());
}

/// By hand: all photos cut a quarter of thing 0's outline off, then one of them a tenth.
#[test]
fn what_no_photo_shows_whole_is_no_object() {
    let mut world = world();
    world.photos.iter_mut().for_each(|photo| photo.outlines[0].cut_px = 10);
    assert_eq!(world.objects(u64::MAX).objects.len(), 2);
    world.photos[1].outlines[0].cut_px = 4;
    assert_eq!(world.objects(u64::MAX).objects.len(), 3);
}

#[test]
fn a_search_can_be_cancelled() {
    assert!(matches!(world().objects_of(None, u64::MAX, true), Err(ContributionError::Cancelled)));
}

/// By hand: two isolated pieces at the ends of a row, and in two views one mask over both, each with an intersection
/// over union of one half with it. Neither has a mask of its own, so neither is an object.
#[test]
fn a_mask_is_of_one_object_at_most() {
    let (n, per_superpoint) = (1500u32, 10u32);
    let gaussians = Gaussians::balls((0..n).map(|i| DVec3::new(f64::from(i), 0.0, 0.0)).collect(), 0.1);
    let split = split(&gaussians, CellLimits::by_count(2000));
    let seen = (0..n).filter(|i| *i < per_superpoint || *i >= n - per_superpoint);
    let local = |i: u32| split.local_of_gaussian[i as usize];
    let mut entries: Vec<Contribution> =
        seen.map(|i| Contribution { local: local(i), region: 0, weight: 1.0 }).collect();
    entries.sort_by_key(|entry| entry.local);
    let view = ViewContributions {
        dim: DIM,
        mask_vectors: axis(0).collect(),
        masks_of_region: vec![vec![0]],
        entries_of_cell: vec![(0, entries)],
    };
    let world = World::new(gaussians, split, &[view.clone(), view]);
    let of_gaussian = (0..n).map(|i| i / per_superpoint).collect();
    let superpoints = Superpoints { of_gaussian, n: (n / per_superpoint) as usize };
    let found = world.objects_of(Some(&superpoints), u64::MAX, false).expect("finds");
    assert!(found.objects.is_empty(), "{:?}", found.objects);
}

/// Sums saturate at 64 bits: thousands of views of billions of Gaussians.
#[test]
fn evidence_saturates() {
    let mut evidence = Evidence { together: u64::MAX - 1, n: u64::MAX - 1 };
    evidence += Evidence { together: 5, n: 5 };
    assert_eq!(evidence, Evidence { together: u64::MAX, n: u64::MAX });
}

#[test]
fn shards_carry_the_objects_of_their_cell() {
    let world = world();
    let found = world.objects(u64::MAX);
    for (cell_id, of_cell) in found.object_of.iter().enumerate() {
        let mut locals: Vec<u32> = (0..of_cell.len() as u32).collect();
        locals.sort_by_key(|local| local.wrapping_mul(0x9e37_79b9));
        let cell = CellObjects::new(&found, cell_id as u32, &locals, &CentroidBasis::new(DIM, None));
        let objects = cell.view();
        let mut n = 0;
        for (run, object) in objects.runs() {
            for index in run {
                let id = object.map(|object| objects.records[object].id);
                let expected = of_cell[locals[index as usize] as usize];
                let expected = (expected != NONE).then(|| found.objects[expected as usize].id);
                assert_eq!((id, index), (expected, n));
                n += 1;
            }
        }
        assert_eq!(n as usize, locals.len());
        for record in objects.records {
            let object = found.objects.iter().find(|object| object.id == record.id).expect("known");
            assert_eq!(objects.photo(record), object.photo);
        }
    }
}

/// Oracle: normal equations and the definition of what is kept, in float64. Vectors in the basis's span come back; of
/// others the rest is at right angles to it, and the stated bound is the largest distance.
#[test]
fn vectors_are_kept_in_the_basis_of_centroids() {
    let mut random = Random::new(9);
    let mut small = |n: usize| -> Vec<i8> { (0..n).map(|_| random.below(255) as u8 as i8).collect() };
    let (m, dim) = (5, 16);
    let mut vectors = small(m * dim);
    // The last is twice another and needs no component.
    let repeated: Vec<i8> = vectors[..dim].iter().map(|v| v / 2 * 2).collect();
    vectors[..dim].copy_from_slice(&repeated);
    vectors[(m - 1) * dim..].iter_mut().zip(&repeated).for_each(|(last, v)| *last = v / 2);
    let mean: Vec<half::f16> =
        small(dim).iter().map(|v| half::f16::from_f32(f32::from(*v) / 256.0)).collect();
    let steps = [0.01, 0.02, 0.005, 0.01, 0.01];
    let basis = CentroidBasis::new(dim, Some(Basis { mean: &mean, vectors: &vectors, steps: &steps }));
    assert_eq!(basis.m(), m);
    let row = |c: usize| vectors[c * dim..][..dim].iter().map(move |v| f64::from(*v) * f64::from(steps[c]));
    let make = |components: &[f64]| -> Vec<f64> {
        let mut made: Vec<f64> = mean.iter().map(|mean| mean.to_f64()).collect();
        for (c, scale) in components.iter().enumerate() {
            made.iter_mut().zip(row(c)).for_each(|(made, b)| *made += scale * b);
        }
        made
    };
    let within: Vec<f32> = make(&[0.3, -0.2, 0.5, 0.1, 0.0]).into_iter().map(|v| v as f32).collect();
    let found = basis.components(&within);
    for (found, expected) in found.iter().zip([0.3, -0.2, 0.5, 0.1, 0.0]) {
        assert!((found - expected).abs() < 1e-4, "{found:?}");
    }
    let outside: Vec<f32> = (0..dim).map(|_| random.below(1000) as f32 / 1000.0).collect();
    let components: Vec<f64> = basis.components(&outside).into_iter().map(f64::from).collect();
    let made = make(&components);
    for c in 0..m {
        let product: f64 =
            row(c).zip(made.iter().zip(&outside)).map(|(b, (made, v))| b * (made - f64::from(*v))).sum();
        assert!(product.abs() < 1e-4, "{c}: {product}");
    }
}

/// By hand: an eighth of 100 contributions, each with an entry of 24 bytes and one of 16.
#[test]
fn lists_are_reserved() {
    let rest = |available_bytes: u64, n_entries: u64| {
        let mut plan = MemoryPlan::new(available_bytes);
        plan.views_are_done();
        reserve_contributions(&mut plan, n_entries);
        plan.rest(0)
    };
    assert_eq!(rest(480, 100), Ok(0));
    assert_error(rest(479, 100), &["480 for masks of superpoints"]);
}

mod definition;
