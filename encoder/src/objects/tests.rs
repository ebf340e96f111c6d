use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::atomic::AtomicBool;

use glam::DVec3;
use slag_common::Gaussians;
use slag_common::objects::object_score;
use slag_common::shard::Basis;
use slag_math::random::Random;

use super::consensus::{MaskClusters, Masks, Sightings, cluster_masks};
use super::shards::{CellObjects, CentroidBasis};
use super::*;
use crate::cells::{CellLimits, CellSplit, split};
use crate::codebook::{ScoreMetric, ScoreMetricContext, TextBank};
use crate::lift::photos::{MaskOutline, Photo};
use crate::lift::{Contribution, ContributionIndex, RegionTable, ViewContributions};

/// What views show: of each view, the masks of each Gaussian that it sees; masks numbered within the view.
type Shown = Vec<BTreeMap<u32, BTreeSet<u32>>>;

/// The same as regions, sightings and views of masks.
struct Made {
    sightings: Sightings,
    masks_of_region: Vec<Vec<u32>>,
    view_of_mask: Vec<u32>,
}

fn make(shown: &Shown, n_gaussians: u32) -> Made {
    let mut made = Made {
        sightings: Sightings { starts: vec![0], views: Vec::new(), regions: Vec::new() },
        masks_of_region: Vec::new(),
        view_of_mask: Vec::new(),
    };
    let mut region_of = HashMap::new();
    for (view, of_view) in shown.iter().enumerate() {
        let first = made.view_of_mask.len() as u32;
        for masks in of_view.values() {
            region_of.entry((view, masks.clone())).or_insert_with(|| {
                made.masks_of_region.push(masks.iter().map(|mask| mask + first).collect());
                made.masks_of_region.len() as u32 - 1
            });
        }
        let n = of_view.values().flatten().max().map_or(0, |most| most + 1);
        made.view_of_mask.extend(std::iter::repeat_n(view as u32, n as usize));
    }
    for gaussian in 0..n_gaussians {
        for (view, of_view) in shown.iter().enumerate() {
            if let Some(masks) = of_view.get(&gaussian) {
                made.sightings.views.push(view as u32);
                made.sightings.regions.push(region_of[&(view, masks.clone())]);
            }
        }
        made.sightings.starts.push(made.sightings.views.len());
    }
    made
}

impl Made {
    fn clusters(&self) -> MaskClusters {
        let of_region = |region: u32| &self.masks_of_region[region as usize][..];
        let n_views = self.view_of_mask.last().map_or(0, |view| *view as usize + 1);
        cluster_masks(
            &self.sightings,
            &Masks { of_region: &of_region, view_of_mask: &self.view_of_mask, n_views },
            &AtomicBool::new(false),
        )
        .expect("not cancelled")
    }
}

/// The definition, set by set: no counts, no shares of integers.
fn oracle(shown: &Shown) -> (Vec<Option<usize>>, Vec<f64>, usize) {
    type Set = HashSet<u32>;
    let (mut masks, mut seen): (Vec<(usize, Set)>, Vec<Set>) = (Vec::new(), Vec::new());
    for (view, of_view) in shown.iter().enumerate() {
        let n = of_view.values().flatten().max().map_or(0, |most| most + 1);
        let of_mask =
            |mask: u32| of_view.iter().filter(|(_, m)| m.contains(&mask)).map(|(g, _)| *g).collect();
        masks.extend((0..n).map(|mask| (view, of_mask(mask))));
        seen.push(of_view.keys().copied().collect());
    }
    let is_large = |mask: usize| masks[mask].1.len() >= 3;
    let iou = |a: &Set, b: &Set| a.intersection(b).count() as f64 / a.union(b).count().max(1) as f64;
    let within = |a: &Set, b: &Set| -> Set { a.intersection(b).copied().collect() };
    let both = |a: usize, b: usize| {
        let common = within(&seen[masks[a].0], &seen[masks[b].0]);
        (within(&masks[a].1, &common), within(&masks[b].1, &common))
    };
    let mut judged = Vec::new();
    for a in 0..masks.len() {
        let (mut agreement, mut judges) = (0.0, 0);
        for (view, seen) in seen.iter().enumerate() {
            let visible = within(&masks[a].1, seen).len();
            if is_large(a) && visible > 0 && visible as f64 >= 0.3 * masks[a].1.len() as f64 - 1e-9 {
                let of_view = (0..masks.len()).filter(|b| masks[*b].0 == view);
                let ious = of_view
                    .map(|b| both(a, b))
                    .map(|(x, y)| if x.is_disjoint(&y) { 0.0 } else { iou(&x, &y) });
                agreement += ious.fold(0.0, f64::max);
                judges += 1;
            }
        }
        let consensus = if judges > 1 { (agreement - 1.0) / f64::from(judges - 1) } else { 0.0 };
        judged.push((agreement, consensus));
    }
    let mut seeds: Vec<usize> = (0..masks.len()).filter(|m| judged[*m].1 >= 0.5).collect();
    seeds.sort_by(|a, b| judged[*b].0.total_cmp(&judged[*a].0).then(a.cmp(b)));
    let n_aside = (0..masks.len()).filter(|m| is_large(*m) && judged[*m].1 < 0.5).count();
    let mut cluster_of = vec![None; masks.len()];
    let (mut gathered, mut consensuses) = (HashSet::new(), Vec::new());
    for seed in seeds {
        if !gathered.insert(seed) {
            continue;
        }
        let same = (0..masks.len()).filter(|m| is_large(*m)).filter(|m| {
            let (x, y) = both(seed, *m);
            !x.is_disjoint(&y) && iou(&x, &y) >= 0.5
        });
        let same: Vec<usize> = same.collect();
        let views: BTreeSet<usize> = same.iter().map(|m| masks[*m].0).collect();
        let all: Set = same.iter().flat_map(|m| masks[*m].1.iter().copied()).collect();
        let shape: Set = all
            .into_iter()
            .filter(|g| {
                let seers: Vec<usize> = views.iter().copied().filter(|v| seen[*v].contains(g)).collect();
                let shows = |v: usize| same.iter().any(|m| masks[*m].0 == v && masks[*m].1.contains(g));
                2 * seers.iter().filter(|v| shows(**v)).count() >= seers.len()
            })
            .collect();
        let shape_iou = |m: usize| {
            let visible = within(&shape, &seen[masks[m].0]);
            if visible.is_disjoint(&masks[m].1) { 0.0 } else { iou(&visible, &masks[m].1) }
        };
        let members: Vec<usize> = (0..masks.len()).filter(|m| is_large(*m) && shape_iou(*m) >= 0.5).collect();
        if members.iter().map(|m| masks[*m].0).collect::<HashSet<_>>().len() < 2 {
            continue;
        }
        let judges = (0..seen.len()).filter(|v| {
            let n = within(&shape, &seen[*v]).len();
            n > 0 && 10 * n >= shape.len()
        });
        let best =
            |v: usize| (0..masks.len()).filter(|m| masks[*m].0 == v).map(shape_iou).fold(0.0, f64::max);
        let agreements: Vec<f64> = judges.map(best).collect();
        gathered.extend(members.iter().copied());
        let free: Vec<usize> = members.iter().copied().filter(|m| cluster_of[*m].is_none()).collect();
        if 2 * free.len() >= members.len() {
            free.iter().for_each(|m| cluster_of[*m] = Some(consensuses.len()));
            consensuses.push(agreements.iter().sum::<f64>() / agreements.len() as f64);
        }
    }
    (cluster_of, consensuses, n_aside)
}

/// Things of [`made_things`], of 40 Gaussians each.
const N_THINGS: u32 = 8;
/// Masks a view: one a thing, two for the parts of a thing that is split, one of everything.
const N_MASKS: usize = N_THINGS as usize + 3;

/// Eight views of eight things: seven in ten Gaussians are seen. View 2 has one mask for things 0, 1 and 3, view 5 three
/// for thing 2; every view has one for everything.
fn made_things(random: &mut Random) -> Shown {
    let view = |view: u32| {
        let mut of_view = BTreeMap::new();
        for gaussian in 0..40 * N_THINGS {
            if random.below(10) >= 7 {
                continue;
            }
            let thing = gaussian / 40;
            let own = match (view, thing) {
                (2, 0 | 1 | 3) => 0,
                (5, 2) => [2, N_THINGS, N_THINGS + 1][gaussian as usize % 3],
                _ => thing,
            };
            // Ragged: one in twenty shows something else's mask.
            let own = if random.below(20) == 0 { random.below(u64::from(N_THINGS)) as u32 } else { own };
            of_view.insert(gaussian, BTreeSet::from([own, N_MASKS as u32 - 1]));
        }
        of_view
    };
    (0..8).map(view).collect()
}

#[test]
fn masks_of_one_thing_meet_and_those_of_several_are_set_aside() {
    let made = make(&made_things(&mut Random::new(1)), 40 * N_THINGS);
    let found = made.clusters();
    let of = |view: usize, mask: usize| found.cluster_of_mask[N_MASKS * view + mask];
    for thing in 0..N_THINGS as usize {
        let clusters: BTreeSet<u32> = [0, 1, 3, 4, 6, 7].into_iter().map(|view| of(view, thing)).collect();
        assert!(clusters.len() == 1 && !clusters.contains(&NONE), "thing {thing}: {found:?}");
    }
    let things: BTreeSet<u32> = (0..N_THINGS as usize).map(|thing| of(0, thing)).collect();
    assert_eq!(things.len(), N_THINGS as usize, "{found:?}");
    // What covers several things, or a third of one, has the consensus of nobody.
    let odd = [(2, 0), (5, 2), (5, N_THINGS as usize), (5, N_THINGS as usize + 1)];
    assert!(odd.iter().all(|(view, mask)| of(*view, *mask) == NONE), "{found:?}");
    assert!(found.n_set_aside >= odd.len(), "{found:?}");
    // The mask of everything is an object of its own: it is not chained to what it contains.
    assert!(of(0, N_MASKS - 1) != NONE && !things.contains(&of(0, N_MASKS - 1)), "{found:?}");
}

/// Oracle: sets and float64.
#[test]
fn clusters_are_those_of_the_definition() {
    let check = |shown: &Shown, n_gaussians: u32, what: &str| {
        let found = make(shown, n_gaussians).clusters();
        let (expected, consensus, n_aside) = oracle(shown);
        let found_of: Vec<Option<usize>> =
            found.cluster_of_mask.iter().map(|c| (*c != NONE).then_some(*c as usize)).collect();
        assert_eq!(found_of, expected, "{what}");
        assert_eq!(found.n_set_aside, n_aside, "{what}");
        for (found, expected) in found.consensus.iter().zip(&consensus) {
            assert!((found - expected).abs() < 1e-12, "{what}: {found} {expected}");
        }
        found.consensus.len()
    };
    let mut n_clusters = 0;
    for seed in 0..40 {
        let mut random = Random::new(seed);
        n_clusters += check(&made_things(&mut random), 40 * N_THINGS, &format!("things {seed}"));
        // Anything: few views, masks without sense, Gaussians that nobody sees.
        let n_views = 1 + random.below(5);
        let shown: Shown = (0..n_views)
            .map(|_| {
                let n_masks = 1 + random.below(4);
                let seen = (0..24).filter(|_| random.below(3) > 0).collect::<Vec<u32>>();
                let masks = |g: u32, random: &mut Random| {
                    let of_block = u64::from(g / 6) % n_masks;
                    let other = if random.below(4) == 0 { random.below(n_masks) } else { of_block };
                    BTreeSet::from([of_block as u32, other as u32])
                };
                seen.into_iter().map(|g| (g, masks(g, &mut random))).collect()
            })
            .collect();
        n_clusters += check(&shown, 24, &format!("anything {seed}"));
    }
    assert!(n_clusters > 150, "{n_clusters}");
    assert_eq!(check(&Vec::new(), 5, "no view"), 0);
}

/// Things in a row of cells, in files of contributions; thing i's masks have the vector of axis i.
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
    let gaussians = Gaussians {
        means_in_world: means.collect(),
        rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; n as usize],
        scales: vec![[0.1; 3]; n as usize],
        opacities: vec![0.5; n as usize],
        sh_dc: vec![[0.0; 3]; n as usize],
        ..Gaussians::default()
    };
    // Cells of at most 70: the things are cut.
    let split = split(&gaussians, CellLimits { max_gaussians: 70, max_width: None });
    let dir = tempfile::tempdir().expect("a temporary folder");
    let mut random = Random::new(3);
    let (mut paths, mut photos) = (Vec::new(), Vec::new());
    for view in 0..6u32 {
        let mut entries: BTreeMap<u32, Vec<Contribution>> = BTreeMap::new();
        for i in 0..n {
            if random.below(10) >= 8 {
                continue;
            }
            let (cell, local) = (split.cell_of_gaussian[i as usize], split.local_of_gaussian[i as usize]);
            let thing = i / PER_THING;
            // A little of each lies under a neighbour's mask too: the last view sees thing 2 whole and large.
            let weight = if view == 5 && thing == 2 { 9.0 } else { 1.0 + random.below(8) as f32 / 8.0 };
            let spilt = Contribution { local, region: (thing + 1) % 3, weight: 0.25 };
            let mut of_gaussian = vec![Contribution { local, region: thing, weight }, spilt];
            of_gaussian.sort_by_key(|entry| entry.region);
            entries.entry(cell).or_default().extend(of_gaussian);
        }
        entries.values_mut().for_each(|entries| entries.sort_by_key(|entry| (entry.local, entry.region)));
        let axis = |thing: usize| (0..DIM).map(move |c| f32::from(u8::from(c == thing)));
        let contributions = ViewContributions {
            dim: DIM,
            mask_vectors: (0..3).flat_map(axis).collect(),
            masks_of_region: vec![vec![0], vec![1], vec![2]],
            entries_of_cell: entries.into_iter().collect(),
        };
        let path = dir.path().join(format!("{view}.contributions"));
        contributions.write(&path).expect("writes");
        paths.push(path);
        let outline =
            |mask| MaskOutline { box_px: [view, mask, view + 10, mask + 10], ..MaskOutline::default() };
        let outlines = (0..3).map(outline).collect();
        photos.push(Photo { name: format!("{view}.jpg"), outlines });
    }
    let n_of_cell: Vec<usize> = split.cells.iter().map(|cell| cell.gaussians.len()).collect();
    let (index, table) = ContributionIndex::open(&paths, DIM, &n_of_cell).expect("opens");
    let bank = TextBank::directions(DIM);
    let metric = ScoreMetric::new(DIM, &bank);
    let spread = metric.spread(table.mask_vectors());
    World {
        gaussians,
        split,
        index,
        table,
        photos,
        score_context: ScoreMetricContext { metric, bank, spread },
        _dir: dir,
    }
}

impl World {
    fn objects(&self, group_bytes: u64) -> SceneObjects {
        self.objects_unless(group_bytes, &AtomicBool::new(false)).expect("not cancelled")
    }

    fn objects_unless(&self, group_bytes: u64, cancel: &AtomicBool) -> Option<SceneObjects> {
        let Self { gaussians, split, index, table, photos, score_context, .. } = self;
        let superpoints = None;
        let scene =
            Scene { index, table, gaussians, split, superpoints, photos, score_context, group_bytes, cancel };
        find(&scene).expect("finds")
    }
}

/// Oracle: the things that the world was made of.
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
        // All but those that no view saw.
        assert!((58..=PER_THING).contains(&object.n_gaussians) && object.n_masks == 6, "{object:?}");
        assert!((object.position_in_world.x - f64::from(thing) * 10.0).abs() < 1e-9, "{object:?}");
        let y = [object.box_in_world.min.y, object.box_in_world.max.y];
        assert!((y[0] - 0.1).abs() < 0.15 && (y[1] - 5.8).abs() < 0.15, "{object:?}");
        let cosines: Vec<f32> = object.vectors.chunks(DIM).map(|v| v[thing as usize]).collect();
        assert!((object_score(&cosines) - 1.0).abs() < 1e-6, "{cosines:?}");
        if thing == 2 {
            assert_eq!((object.photo.as_str(), object.photo_box_px), ("5.jpg", [5, 2, 15, 12]));
        }
    }
    // Where that photo's edge cuts most of the thing off, another one shows it better.
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

#[test]
fn a_cancelled_search_returns_none() {
    assert_eq!(world().objects_unless(u64::MAX, &AtomicBool::new(true)), None);
}

/// What shards say is what was found, in any order of the Gaussians.
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

/// Oracle: the normal equations, and the definition of what is kept, in float64. Vectors that the basis can make come
/// back, of others what is left is at right angles to it, and the stated bound is the largest distance.
#[test]
fn vectors_are_kept_in_the_basis_of_centroids() {
    let mut random = Random::new(9);
    let mut small = |n: usize| -> Vec<i8> { (0..n).map(|_| random.below(255) as u8 as i8).collect() };
    let (m, dim) = (5, 16);
    let mut vectors = small(m * dim);
    // The last is twice another: no component of its own is needed.
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

/// By hand: 10 Gaussians in 3 views with at most 2 masks each are 60 entries of 4 bytes; 4 masks in 3 views, 12 of 8.
#[test]
fn lists_of_masks_are_reserved() {
    let plan = |available_bytes: u64| {
        let mut plan = MemoryPlan::new(available_bytes);
        plan.views_are_done();
        sightings::reserve_masks(&mut plan, 10, 3, (4, 2));
        plan
    };
    assert_eq!(plan(336).rest(0), Ok(0));
    let refused = plan(335).rest(0).expect_err("a byte is missing").to_string();
    assert!(refused.contains("336 for masks of sampled Gaussians"), "{refused}");
}
