use std::path::PathBuf;

use proptest::prelude::*;
use slag_common::container::AlignedBytes;

use super::contributions::{GAUSSIANS_PER_SLICE, MAX_REGIONS};
use super::*;
use slag_math::dot;
use slag_math::random::mix64;

pub(super) struct Scene {
    pub(super) index: ContributionIndex,
    pub(super) table: RegionTable,
    paths: Vec<PathBuf>,
    _dir: tempfile::TempDir,
}

/// Writes views in the given order and opens them, with parts of at most `part_entries`.
pub(super) fn open(views: &[ViewContributions], dim: usize, n_of_cell: &[usize], part_entries: u64) -> Scene {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = |(i, view): (usize, &ViewContributions)| {
        let path = dir.path().join(format!("{i}.contributions"));
        view.write(&path).expect("writes");
        path
    };
    let paths: Vec<PathBuf> = views.iter().enumerate().map(path).collect();
    let (index, table) = ContributionIndex::open_with(&paths, dim, n_of_cell, part_entries).expect("opens");
    Scene { index, table, paths, _dir: dir }
}

/// One cell: `n_views` views of 12 masks and 30 regions see two of three Gaussians.
pub(super) fn scene_of(dim: usize, n_gaussians: u32, n_views: u64) -> Scene {
    let random = |seed: u64| mix64(seed) >> 20;
    let view = |view: u64| {
        let at = |what: u64, i: u64| random(view << 40 ^ what << 32 ^ i);
        let entry = |g: u32, step: u64| Contribution {
            local: g,
            region: ((at(1, g.into()) % 10) * 3 + step) as u32,
            weight: (at(2, u64::from(g) * 3 + step) % 1000) as f32 / 97.0 + 1e-3,
        };
        let seen = (0..n_gaussians).filter(|g| !at(3, (*g).into()).is_multiple_of(3));
        let entries = seen.flat_map(|g| (0..1 + at(4, g.into()) % 3).map(move |step| entry(g, step)));
        let mask = |m: u64| (0..dim as u64).map(move |c| at(5, m * 1000 + c) as f32 % 200.0 / 100.0 - 0.9);
        ViewContributions {
            dim,
            mask_vectors: (0..12).flat_map(mask).collect(),
            masks_of_region: (0..30).map(|r| (0..1 + r % 3).map(|j| (r + j * 4) % 12).collect()).collect(),
            entries_of_cell: vec![(0, entries.collect())],
        }
    };
    open(&(0..n_views).map(view).collect::<Vec<_>>(), dim, &[n_gaussians as usize], u64::MAX)
}

fn transpose(scene: &Scene, budget_bytes: u64) -> Vec<PartContributions> {
    scene.index.transposed_parts(&scene.table, budget_bytes).collect::<Result<_, _>>().expect("transposes")
}

/// The paper's equation in float64, mask by mask, without regions or sparse rows.
fn oracle(cell: u32, k: u32, views: &[ViewContributions], dim: usize) -> (f64, Option<Vec<f64>>) {
    let mut sum = vec![0.0f64; dim];
    let mut total = 0.0f64;
    for view in views {
        let of_cell = view.entries_of_cell.iter().filter(|(id, _)| *id == cell);
        for entry in of_cell.flat_map(|(_, entries)| entries).filter(|e| e.local == k) {
            for mask in &view.masks_of_region[entry.region as usize] {
                let w = f64::from(entry.weight);
                total += w;
                (0..dim).for_each(|c| sum[c] += w * f64::from(view.mask_vectors[*mask as usize * dim + c]));
            }
        }
    }
    let length = sum.iter().map(|c| c * c).sum::<f64>().sqrt();
    let is_clear = total > 0.0 && length / total > 2e-3;
    (total, is_clear.then(|| sum.iter().map(|c| c / length).collect()))
}

/// One cell has three slices, the last of them short; contributions crowd around their ends.
const N_OF_CELL: [usize; 3] = [9, 2 * GAUSSIANS_PER_SLICE + 2, 1];
const LOCALS: [&[u32]; 3] = [&[0, 3, 8], &[0, 1, 4095, 4096, 4097, 8191, 8192, 8193], &[0]];

prop_compose! {
    fn any_view(dim: usize)(
        n_masks in 1usize..5,
        seeds in prop::collection::vec(-1.0f32..1.0, 5 * dim),
        regions in prop::collection::vec(prop::collection::btree_set(0u32..5, 1..4), 1..6),
        raw in prop::collection::btree_map((0..3usize, 0..8usize, 0u32..6), 1e-3f32..100.0, 0..40),
    ) -> ViewContributions {
        let masks_of_region: Vec<Vec<u32>> = regions.iter().map(|set| {
            let masks: std::collections::BTreeSet<u32> = set.iter().map(|m| m % n_masks as u32).collect();
            masks.into_iter().collect()
        }).collect();
        let mut mask_vectors = seeds[..n_masks * dim].to_vec();
        for vector in mask_vectors.chunks_mut(dim) {
            vector[0] += 0.01;
            let length = dot(vector, vector).sqrt();
            vector.iter_mut().for_each(|c| *c /= length);
        }
        let n_regions = masks_of_region.len() as u32;
        let entries_of_cell = (0..3).map(|cell| {
            let of_cell = raw.iter().filter(|((c, at, region), _)| *c == cell && *at < LOCALS[cell].len() && *region < n_regions);
            let entry = |((_, at, region), weight): (&(usize, usize, u32), &f32)| Contribution { local: LOCALS[cell][*at], region: *region, weight: *weight };
            (cell as u32, of_cell.map(entry).collect::<Vec<_>>())
        }).filter(|(_, entries)| !entries.is_empty()).collect();
        ViewContributions { dim, mask_vectors, masks_of_region, entries_of_cell }
    }
}

proptest! {
    // Each case writes files and waits for the disk.
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Oracle: entries picked from the views one by one.
    #[test]
    fn contributions_by_gaussian_are_those_of_the_views_for_any_budget(
        views in prop::collection::vec(any_view(2), 1..6), part_entries in 1u64..40, budget_bytes in 0u64..500_000,
    ) {
        let scene = open(&views, 2, &N_OF_CELL, part_entries);
        let parts = transpose(&scene, budget_bytes);
        prop_assert_eq!(&transpose(&scene, u64::MAX), &parts);
        let mut next = (0, 0);
        for contributions in &parts {
            let part = &contributions.part;
            // Parts have no gaps and end at the ends of cells.
            prop_assert_eq!((part.cell_id as usize, part.locals.start), next);
            next = if part.locals.end == N_OF_CELL[next.0] { (next.0 + 1, 0) } else { (next.0, part.locals.end) };
            prop_assert!(part.n_entries <= part_entries || part.locals.len() <= GAUSSIANS_PER_SLICE);
            for (k, local) in part.locals.clone().enumerate() {
                let mut expected = Vec::new();
                let mut first_region = 0;
                for view in &views {
                    let of_cell = view.entries_of_cell.iter().filter(|(cell, _)| *cell == part.cell_id);
                    let of_gaussian = of_cell.flat_map(|(_, e)| e).filter(|e| e.local as usize == local);
                    expected.extend(of_gaussian.map(|e| (e.region + first_region, e.weight)));
                    first_region += view.masks_of_region.len() as u32;
                }
                let range = contributions.starts[k] as usize..contributions.starts[k + 1] as usize;
                let found: Vec<(u32, f32)> = range.map(|i| (contributions.regions[i], contributions.weights[i])).collect();
                prop_assert_eq!(found, expected);
            }
        }
        prop_assert_eq!(next, (N_OF_CELL.len(), 0));
    }

    #[test]
    fn embeddings_and_cosines_equal_the_papers_equation(
        views in prop::collection::vec(any_view(7), 1..6),
        query in prop::collection::vec(-1.0f32..1.0, 7),
    ) {
        let scene = open(&views, 7, &N_OF_CELL, 12);
        let table = &scene.table;
        for contributions in transpose(&scene, 0) {
            let part = contributions.part.clone();
            let mut embeddings = vec![f32::NAN; part.locals.len() * 7];
            let field = CellField::new(part.locals.clone().map(|k| k as u32).collect(), contributions, table, &mut embeddings);
            let cosines = field.cosines(&table.scores(&query));
            let mut again = vec![0.0; 7];
            let seen = LOCALS[part.cell_id as usize].iter().filter(|k| part.locals.contains(&(**k as usize)));
            for local in seen {
                let k = *local as usize - part.locals.start;
                let embedding = &embeddings[k * 7..][..7];
                field.embedding(k, table, &mut again);
                prop_assert_eq!(&again, embedding);
                let (total, expected) = oracle(part.cell_id, *local, &views, 7);
                prop_assert!((f64::from(field.total_weights[k]) - total).abs() <= 1e-6 * total);
                let Some(expected) = expected else { continue };
                let cosine: f64 = expected.iter().zip(&query).map(|(e, q)| e * f64::from(*q)).sum();
                prop_assert!(embedding.iter().zip(&expected).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-3));
                prop_assert!((f64::from(cosines[k]) - cosine).abs() < 2e-3);
            }
            let mut bytes = Vec::new();
            field.write(&mut bytes).expect("writes to memory");
            prop_assert_eq!(CellField::from_bytes(&AlignedBytes::copy_of(&bytes), table.len()).expect("valid"), field);
        }
        let mut bytes = Vec::new();
        table.write(&mut bytes).expect("writes to memory");
        prop_assert_eq!(&RegionTable::from_bytes(&AlignedBytes::copy_of(&bytes)).expect("valid"), table);
    }
}

#[test]
fn parts_of_a_cell_make_the_cell() {
    let whole = scene_of(5, 10_000, 4);
    let (index, table) = ContributionIndex::open_with(&whole.paths, 5, &[10_000], 1).expect("opens");
    assert_eq!(index.parts.len(), 3);
    let field = |contributions: PartContributions| {
        let locals = contributions.part.locals.clone();
        let mut embeddings = vec![0.0; locals.len() * 5];
        CellField::new(locals.map(|k| k as u32).collect(), contributions, &table, &mut embeddings)
    };
    let mut parts = index.transpose(&index.read(0..3).unwrap(), &table).unwrap().into_iter();
    let mut joined = field(parts.next().expect("a part"));
    parts.for_each(|contributions| joined.append(field(contributions)));
    assert_eq!(joined, field(transpose(&whole, 0).remove(0)));
}

/// If the budget holds all parts, only the first pass reads the files; total weights still follow the table.
#[test]
fn parts_that_fit_the_budget_are_read_once() {
    let scene = scene_of(5, 10_000, 4);
    let (index, mut table) = ContributionIndex::open_with(&scene.paths, 5, &[10_000], 9000).expect("opens");
    assert!(index.parts.len() > 1);
    let pass = |table: &RegionTable, budget_bytes| -> Result<Vec<PartContributions>, ContributionError> {
        index.transposed_parts(table, budget_bytes).collect()
    };
    let before = pass(&table, 0).expect("reads");
    let stopped = index.transposed_parts(&table, u64::MAX).take(1).count();
    assert_eq!((stopped, index.kept.get()), (1, None), "a pass that stopped early keeps nothing");
    assert_eq!(pass(&table, u64::MAX).expect("reads"), before);
    let weights: Vec<f32> = (0..table.n_masks()).map(|mask| 0.3 + mask as f32 / 7.0).collect();
    table.set_mask_weights(&weights);
    let (read_again, _) = ContributionIndex::open_with(&scene.paths, 5, &[10_000], 9000).expect("opens");
    let expected: Vec<PartContributions> =
        read_again.transposed_parts(&table, 0).collect::<Result<_, _>>().expect("reads");
    assert_ne!(expected[0].total_weights, before[0].total_weights);
    scene.paths.iter().for_each(|path| fs_err::remove_file(path).expect("removes"));
    assert_eq!(pass(&table, u64::MAX).expect("kept"), expected);
    let mut unkept = read_again.transposed_parts(&table, u64::MAX);
    assert!(matches!(unkept.next(), Some(Err(ContributionError::Io(_)))) && unkept.next().is_none());
}

/// Files of another scene or model, and contributions that do not fit them, are refused with the file's name.
#[test]
fn foreign_files_are_refused() {
    let scene = scene_of(5, 5000, 2);
    let refused = |dim, n_of_cell: &[usize]| {
        let opened = ContributionIndex::open(&scene.paths, dim, n_of_cell);
        let read = opened.and_then(|(index, table)| index.transpose(&index.read(0..1)?, &table).map(drop));
        read.expect_err("refused").to_string()
    };
    for message in [refused(6, &[5000]), refused(5, &[4096]), refused(5, &[]), refused(5, &[4990])] {
        assert!(message.contains(".contributions") && message.contains("delete it"), "{message}");
    }
    // The entries have checksums of their own.
    let mut bytes = fs_err::read(&scene.paths[0]).expect("reads");
    *bytes.last_mut().expect("entries") ^= 1;
    let path = scene.paths[0].with_file_name("flipped.contributions");
    fs_err::write(&path, bytes).expect("writes");
    let opened = ContributionIndex::open(&[path], 5, &[5000]);
    let read = opened.and_then(|(index, _)| index.read(0..index.parts.len()).map(drop));
    assert!(read.expect_err("refused").to_string().contains("flipped.contributions"));
    let mut view = ViewContributions {
        dim: 1,
        mask_vectors: vec![1.0],
        masks_of_region: vec![vec![0]; MAX_REGIONS + 1],
        entries_of_cell: vec![],
    };
    let path = scene.paths[0].with_file_name("many.contributions");
    assert!(view.write(&path).expect_err("refused").to_string().contains("the limit is 1048576"));
    view.masks_of_region.pop();
    view.entries_of_cell =
        vec![(0, vec![Contribution { local: 4095, region: MAX_REGIONS as u32 - 1, weight: 1.0 }])];
    view.write(&path).expect("writes");
    let (index, table) = ContributionIndex::open(&[path], 1, &[4096]).expect("opens");
    let contributions = index.transpose(&index.read(0..1).unwrap(), &table).unwrap().remove(0);
    let found = (contributions.regions, contributions.starts[4095..].to_vec());
    assert_eq!(found, (vec![MAX_REGIONS as u32 - 1], vec![0, 1]));
}

#[test]
fn a_views_weights_are_grouped_by_cell() {
    use crate::cells::{CellSplit, NO_CELL};
    use crate::raster::RegionWeight;
    let split = CellSplit {
        cells: Vec::new(),
        cell_of_gaussian: vec![1, 0, 1, NO_CELL],
        local_of_gaussian: vec![1, 0, 0, 0],
        n_rejected: 1,
        ..CellSplit::default()
    };
    let weight = |gaussian, region| RegionWeight { gaussian, region, weight: (gaussian + region) as f32 };
    let weights = [weight(0, 0), weight(0, 1), weight(1, 1), weight(2, 0), weight(3, 0)];
    let contributions =
        ViewContributions::new(&weights, vec![vec![0], vec![0, 1]], vec![1.0, 0.0, 0.0, 1.0], 2, &split);
    let entry = |local, region, weight| Contribution { local, region, weight };
    assert_eq!(
        contributions.entries_of_cell,
        [(0, vec![entry(0, 1, 2.0)]), (1, vec![entry(0, 0, 2.0), entry(1, 0, 0.0), entry(1, 1, 1.0)])]
    );
}
