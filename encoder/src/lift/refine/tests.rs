use std::sync::atomic::AtomicBool;

use glam::DVec3;
use slag_common::Gaussians;
use slag_common::container::AlignedBytes;
use slag_common::frames::Aabb;
use slag_math::random::mix64;

use super::*;
use crate::cells::{Cell, CellSplit, PositionGrid};
use crate::ground::Standing;
use crate::lift::photos::MaskOutline;
use crate::lift::tests::{Scene, open};
use crate::lift::{CellField, Contribution, ViewContributions};
use slag_math::dot;

const DIM: usize = 12;
const N: usize = 90;
const UNSEEN: [usize; 2] = [7, 50];

fn random(seed: u64) -> f64 {
    (mix64(seed) >> 20) as f64 / (1u64 << 44) as f64
}

/// Three patches of 30 Gaussians, far apart, one colour each.
fn gaussians() -> Gaussians {
    let at =
        |i: usize| DVec3::new((i / 30 * 10) as f64 + (i % 6) as f64 * 0.1, (i % 30 / 6) as f64 * 0.1, 0.0);
    let mut scene = Gaussians::balls((0..N).map(at).collect(), 0.1);
    scene.scales.fill([0.1, 0.1, 0.01]);
    scene.opacities.fill(0.9);
    scene.sh_dc = (0..N).map(|i| [(i / 30) as f32; 3]).collect();
    scene
}

fn split() -> CellSplit {
    let bounds = Aabb::EMPTY;
    let grid = PositionGrid::default();
    let cell = Cell { gaussians: (0..N as u32).collect(), mean_bounds: bounds, bounds, grid };
    let local_of_gaussian = (0..N as u32).collect();
    CellSplit { cells: vec![cell], cell_of_gaussian: vec![0; N], local_of_gaussian, ..CellSplit::default() }
}

/// The first two patches are objects, but every fourth Gaussian belongs to none.
fn object_of() -> [Vec<u32>; 1] {
    [(0..N).map(|i| if i < 60 && i % 4 > 0 { i as u32 / 30 } else { NO_SUPERPOINT }).collect()]
}

/// Views with two overlapping masks per patch; view 3 has the others' vectors reversed.
fn views() -> Vec<ViewContributions> {
    let view = |v: u64| {
        let vector = |mask: u64| {
            let patch = if v == 3 { (mask / 2 + 1) % 3 } else { mask / 2 };
            let raw: Vec<f32> = (0..DIM as u64)
                .map(|c| {
                    (f64::from(u8::from(c == patch * 3)) + 0.3 * (random(v << 20 ^ mask << 8 ^ c) - 0.5))
                        as f32
                })
                .collect();
            let length = dot(&raw, &raw).sqrt();
            raw.into_iter().map(move |x| x / length)
        };
        let entry = |k: u64, step: u64| Contribution {
            local: k as u32,
            region: (k / 30 * 3 + step) as u32,
            weight: (0.05 + random(v << 30 ^ k << 10 ^ step << 2) * [9.0, 3.0, 0.4][step as usize]) as f32,
        };
        let seen =
            (0..N as u64).filter(|k| !UNSEEN.contains(&(*k as usize)) && random(v ^ k << 5 ^ 99) > 0.2);
        let entries = seen.flat_map(|k| (0..3).map(move |step| entry(k, step))).collect();
        ViewContributions {
            dim: DIM,
            mask_vectors: (0..6).flat_map(vector).collect(),
            masks_of_region: (0..9)
                .map(|r| {
                    [vec![r / 3 * 2], vec![r / 3 * 2, r / 3 * 2 + 1], vec![r / 3 * 2 + 1]][r as usize % 3]
                        .clone()
                })
                .collect(),
            entries_of_cell: vec![(0, entries)],
        }
    };
    (0..7).map(view).collect()
}

/// One box for all masks, of which photos' edges cut off between nothing and all.
fn is_filler(v: usize, mask: usize) -> bool {
    (v + mask).is_multiple_of(5)
}

fn photos() -> Vec<Photo> {
    let outline = |v: u32, mask: u32| MaskOutline {
        box_px: [4, 4, 14, 14],
        cut_px: (v * 6 + mask) % 41,
        level: if is_filler(v as usize, mask as usize) { Mask::FILLER.into() } else { 0 },
    };
    let photo =
        |v: u32| Photo { name: v.to_string(), outlines: (0..6).map(|mask| outline(v, mask)).collect() };
    (0..7).map(photo).collect()
}

struct Lifted {
    field: CellField,
    table: RegionTable,
    embeddings: Vec<f32>,
}

fn lifted(settings: Aggregation, group_bytes: u64) -> Lifted {
    lift(&views(), DIM, &photos(), settings, group_bytes)
}

fn lift(
    views: &[ViewContributions],
    dim: usize,
    photos: &[Photo],
    settings: Aggregation,
    group_bytes: u64,
) -> Lifted {
    let Scene { index, table, .. } = &open(views, dim, &[N], u64::MAX);
    let (gaussians, split, cancel) = (&gaussians(), &split(), &AtomicBool::new(false));
    let standing = &Standing::default();
    let scene = SceneContributions { index, gaussians, split, standing, photos, group_bytes, cancel };
    let pending = PendingRefinement::begin(settings, &scene, table.clone()).expect("reads");
    let (table, refinement) = pending.finish(&scene, &object_of()).expect("reads");
    let raw = index.read(0..1).expect("reads");
    let mut contributions = index.transpose(&raw, &table).expect("transposes").remove(0);
    refinement.apply(&mut contributions, &split.cells[0].gaussians);
    let mut embeddings = vec![f32::NAN; N * dim];
    let field = CellField::new(split.cells[0].gaussians.clone(), contributions, &table, &mut embeddings);
    Lifted { field, table, embeddings }
}

/// A Gaussian's entries in float64, by view: `(masks of the view, region, weight)`.
fn row(views: &[ViewContributions], k: usize) -> Vec<Vec<(usize, f64)>> {
    let of_view = |view: &ViewContributions| {
        let entries = view.entries_of_cell[0].1.iter().filter(|e| e.local as usize == k);
        entries.map(|e| (e.region as usize, f64::from(e.weight))).collect()
    };
    views.iter().map(of_view).collect()
}

fn pruned(rows: Vec<Vec<(usize, f64)>>, settings: &Aggregation) -> Vec<Vec<(usize, f64)>> {
    let weight = |view: &Vec<(usize, f64)>| view.iter().map(|e| e.1).sum::<f64>();
    let best = rows.iter().map(weight).fold(0.0, f64::max);
    let kept = |view: Vec<(usize, f64)>| {
        if weight(&view) < f64::from(settings.min_view_share) * best { Vec::new() } else { view }
    };
    rows.into_iter().map(kept).collect()
}

/// `Σ weight * mask's count * its vector` over a view's entries.
fn contribution(view: &ViewContributions, entries: &[(usize, f64)], counts: &[f64]) -> Vec<f64> {
    let mut sum = vec![0.0; DIM];
    for (region, weight) in entries {
        for mask in &view.masks_of_region[*region] {
            let mask = *mask as usize;
            (0..DIM)
                .for_each(|c| sum[c] += weight * counts[mask] * f64::from(view.mask_vectors[mask * DIM + c]));
        }
    }
    sum
}

fn norm(v: &[f64]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn unit(v: &[f64]) -> Vec<f64> {
    v.iter().map(|x| x / norm(v).max(1e-12)).collect()
}

/// Sum of Gaussians' rows, with every mask counted once.
fn sum_of(views: &[ViewContributions], gaussians: impl IntoIterator<Item = usize>) -> Vec<f64> {
    let mut sum = vec![0.0; DIM];
    for k in gaussians {
        for (view, entries) in views.iter().zip(row(views, k)) {
            contribution(view, &entries, &[1.0; 6]).iter().enumerate().for_each(|(c, x)| sum[c] += x);
        }
    }
    sum
}

/// Masks' weights by the definition, in float64 without axes.
fn oracle_counts(views: &[ViewContributions], settings: &Aggregation) -> Vec<Vec<f64>> {
    let whole = |v: usize, mask: usize| {
        let of_kind = if is_filler(v, mask) && settings.truncation_power > 0.0 { 0.1 } else { 1.0 };
        of_kind * (1.0 - ((v * 6 + mask) % 41) as f64 / 40.0).max(0.01).powf(settings.truncation_power.into())
    };
    (0..views.len()).map(|v| (0..6).map(|mask| whole(v, mask)).collect()).collect()
}

fn assert_near(found: &[f32], expected: &[f64], what: &str) {
    let length = norm(expected);
    for (a, b) in found.iter().zip(expected) {
        assert!((f64::from(*a) - b / length).abs() < 2e-4, "{what}: {found:?} {expected:?}");
    }
}

/// Oracle: table and contributions as read.
#[test]
fn the_plain_average_changes_neither_table_nor_contributions() {
    let Scene { index, table, .. } = &open(&views(), DIM, &[N], u64::MAX);
    let plain = lifted(Aggregation::default(), u64::MAX);
    assert_eq!(plain.table, *table);
    let contributions = index.transpose(&index.read(0..1).unwrap(), table).unwrap().remove(0);
    let mut embeddings = vec![f32::NAN; N * DIM];
    let field = CellField::new((0..N as u32).collect(), contributions, table, &mut embeddings);
    assert_eq!((plain.field, plain.embeddings), (field, embeddings));
}

/// Oracle: float64 by definition, Gaussian by Gaussian.
#[test]
fn what_masks_and_views_count_is_that_of_the_definition() {
    let views = views();
    for (truncation_power, min_view_share) in [(0.0, 0.3), (2.0, 0.0), (2.0, 0.3), (0.5, 0.05)] {
        let settings = Aggregation { truncation_power, min_view_share, ..Aggregation::default() };
        let Lifted { field, table, embeddings } = lifted(settings, u64::MAX);
        let counts = oracle_counts(&views, &settings);
        for k in (0..N).filter(|k| !UNSEEN.contains(k)) {
            let rows = pruned(row(&views, k), &settings);
            let mut expected = vec![0.0; DIM];
            for ((view, entries), counts) in views.iter().zip(&rows).zip(&counts) {
                let part = contribution(view, entries, counts);
                (0..DIM).for_each(|c| expected[c] += part[c]);
            }
            assert_near(&embeddings[k * DIM..][..DIM], &expected, &format!("{settings:?} {k}"));
            // Scores equal those of the embeddings, from the published numbers alone.
            let query: Vec<f32> = (0..DIM).map(|c| random(c as u64) as f32).collect();
            let cosine = field.cosines(&table.scores(&query))[k];
            assert!((cosine - dot(&embeddings[k * DIM..][..DIM], &query)).abs() < 1e-4);
        }
    }
}

/// Oracle: the superpoints are the patches; half of a row is the patch's sum, by length.
#[test]
fn a_superpoint_gives_its_part_and_fills_what_no_view_sees() {
    let views = views();
    // Larger superpoints are the same patches here.
    let parts = |superpoint, coarse| Aggregation { superpoint, coarse, fill: true, ..Aggregation::default() };
    for (settings, n_levels) in [(parts(1.0, 0.0), 1), (parts(0.0, 0.5), 2), (parts(2.0, 0.5), 2)] {
        let Lifted { field, embeddings, table } = lifted(settings, u64::MAX);
        for k in 0..N {
            let patch = sum_of(&views, k / 30 * 30..k / 30 * 30 + 30);
            let mut expected = unit(&sum_of(&views, [k]));
            for count in [settings.superpoint, settings.coarse] {
                let own = if norm(&expected) > 0.0 { unit(&expected) } else { unit(&patch) };
                let of_patch = unit(&patch);
                expected = (0..DIM).map(|c| own[c] + f64::from(count) * of_patch[c]).collect();
            }
            assert_near(&embeddings[k * DIM..][..DIM], &expected, &format!("{settings:?} {k}"));
            assert!(field.has_evidence(k));
            assert_eq!(UNSEEN.contains(&k), field.total_weights[k] < 0.01);
        }
        assert_eq!(table.len(), 7 * 9 + 3 * n_levels);
        let mut bytes = Vec::new();
        table.write(&mut bytes).expect("writes to memory");
        assert_eq!(RegionTable::from_bytes(&AlignedBytes::copy_of(&bytes)).expect("valid"), table);
    }

    let unfilled = lifted(Aggregation { superpoint: 1.0, ..Aggregation::default() }, u64::MAX);
    assert!(UNSEEN.iter().all(|k| !unfilled.field.has_evidence(*k)));
    let only_filled = lifted(Aggregation { fill: true, ..Aggregation::default() }, u64::MAX);
    let plain = lifted(Aggregation::default(), u64::MAX);
    for k in 0..N {
        let same = only_filled.embeddings[k * DIM..][..DIM] == plain.embeddings[k * DIM..][..DIM];
        assert_eq!(same, !UNSEEN.contains(&k), "{k}");
    }
}

/// Oracle in float64: a third of a row is the sum of its object's Gaussians, by length; other rows are unchanged.
/// Superpoints come first.
#[test]
fn an_object_gives_its_part_to_its_gaussians() {
    let views = views();
    let [object_of] = object_of();
    let sum_of = |members: &dyn Fn(usize) -> bool| unit(&sum_of(&views, (0..N).filter(|k| members(*k))));
    for superpoint in [0.0, 1.0] {
        let found = lifted(Aggregation { superpoint, object: 0.5, ..Aggregation::default() }, u64::MAX);
        for k in (0..N).filter(|k| !UNSEEN.contains(k)) {
            let patch = sum_of(&|other| other / 30 == k / 30);
            let mut expected = unit(&self::sum_of(&views, [k]));
            expected =
                unit(&(0..DIM).map(|c| expected[c] + f64::from(superpoint) * patch[c]).collect::<Vec<_>>());
            if object_of[k] != NO_SUPERPOINT {
                let object = sum_of(&|other| object_of[other] == object_of[k]);
                expected = (0..DIM).map(|c| expected[c] + 0.5 * object[c]).collect();
            }
            assert_near(&found.embeddings[k * DIM..][..DIM], &expected, &format!("{superpoint} {k}"));
        }
        assert_eq!(found.table.len(), 7 * 9 + if superpoint > 0.0 { 3 } else { 0 } + 2);
        assert!(UNSEEN.iter().all(|k| !found.field.has_evidence(*k)));
    }
}

#[test]
fn threads_and_budget_do_not_show() {
    let run = |threads: usize, group_bytes: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let Lifted { field, table, embeddings } = pool.install(|| lifted(Aggregation::REFINED, group_bytes));
        (field, table, embeddings)
    };
    let expected = run(1, u64::MAX);
    assert!(expected.2.iter().all(|x| x.is_finite()));
    assert!(run(3, 1) == expected);
}

#[test]
fn a_single_view_keeps_its_evidence() {
    let view = ViewContributions {
        dim: 64,
        mask_vectors: (0..64).map(|c| f32::from(u8::from(c == 3))).collect(),
        masks_of_region: vec![vec![0]],
        entries_of_cell: vec![(0, vec![Contribution { local: 2, region: 0, weight: 1.0 }])],
    };
    let outline = MaskOutline { box_px: [0, 0, 8, 8], ..MaskOutline::default() };
    let photos = [Photo { name: "0".into(), outlines: vec![outline] }];
    let Lifted { field, embeddings, .. } = lift(&[view], 64, &photos, Aggregation::REFINED, u64::MAX);
    // Its patch is filled, the others have no evidence.
    assert!((0..N).all(|k| field.has_evidence(k) == (k < 30)));
    assert!((0..30).all(|k| (embeddings[k * 64 + 3] - 1.0).abs() < 1e-6));
}
