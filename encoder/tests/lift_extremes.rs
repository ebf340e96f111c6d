//! Embeddings at the extremes: rows of the table in docs/numerics.md, against the paper's equation in float64 or a
//! closed form.

use super::*;
use half::f16;
use slag_common::Hash32;
use slag_common::container::AlignedBytes;
use slag_common::shard::{Additions, Profile, ShardLayout, ShardView};
use slag_encoder::cells::{self, Cell, CellLimits, PositionError};
use slag_encoder::codebook::{ScoreMetric, ScoreMetricContext, TextBank};
use slag_encoder::lift::{CellField, Contribution, ContributionIndex, RegionTable, ViewContributions};
use slag_encoder::shard::{CellEmbeddings, ShardBuilder, ShardSettings};
use slag_math::matrix::Rows;

const DIM: usize = 512;

/// A Gaussian with a shorter mean vector has no evidence.
const MIN_MEAN_LENGTH: f64 = 1e-3;

fn uniform(random: &mut Random) -> f64 {
    random.below(1 << 30) as f64 / f64::from(1 << 30)
}

fn length(vector: &[f64]) -> f64 {
    vector.iter().map(|c| c * c).sum::<f64>().sqrt()
}

fn unit(vector: &[f64]) -> Vec<f64> {
    let length = length(vector);
    vector.iter().map(|c| c / length).collect()
}

fn direction(random: &mut Random) -> Vec<f64> {
    unit(&(0..DIM).map(|_| uniform(random) - 0.5).collect::<Vec<_>>())
}

/// Writes and reads a view of one cell with a region per mask; returns its field, table and embeddings.
fn one_cell(
    vectors: &[Vec<f32>],
    entries: Vec<Contribution>,
    input_indices: Vec<u32>,
) -> (CellField, RegionTable, Vec<f32>) {
    let view = ViewContributions {
        dim: DIM,
        mask_vectors: vectors.concat(),
        masks_of_region: (0..vectors.len() as u32).map(|mask| vec![mask]).collect(),
        entries_of_cell: vec![(0, entries)],
    };
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("view.contributions");
    view.write(&path).expect("writes");
    let (index, table) = ContributionIndex::open(&[path], DIM, &[input_indices.len()]).expect("opens");
    assert_eq!(index.parts.len(), 1);
    let raw = index.read(0..1).expect("reads");
    let contributions = index.transpose(&raw, &table).expect("transposes").remove(0);
    let mut embeddings = vec![f32::NAN; input_indices.len() * DIM];
    let field = CellField::new(input_indices, contributions, &table, &mut embeddings);
    (field, table, embeddings)
}

/// One Gaussian's weights over regions of one mask each.
struct Seen {
    vectors: Vec<Vec<f32>>,
    weights: Vec<f32>,
}

impl Seen {
    fn field(&self) -> (CellField, RegionTable) {
        let entry = |(region, weight): (usize, &f32)| Contribution {
            local: 0,
            region: region as u32,
            weight: *weight,
        };
        let entries = self.weights.iter().enumerate().map(entry).collect();
        let (field, table, _) = one_cell(&self.vectors, entries, vec![0]);
        (field, table)
    }

    /// The mean vector and the total weight, in float64.
    fn truth(&self) -> (Vec<f64>, f64) {
        let total: f64 = self.weights.iter().map(|w| f64::from(*w)).sum();
        let component = |c: usize| {
            let terms = self.vectors.iter().zip(&self.weights).map(|(v, w)| f64::from(*w) * f64::from(v[c]));
            terms.sum::<f64>() / total
        };
        ((0..DIM).map(component).collect(), total)
    }

    /// Errors of the total weight (relative), the mean length, the unit embedding and its cosine with a query, the
    /// last two times the mean length; `None` without evidence.
    fn errors(&self, query: &[f64]) -> Option<[f64; 4]> {
        let (field, table) = self.field();
        let (mean, total) = self.truth();
        let query_f32: Vec<f32> = query.iter().map(|c| *c as f32).collect();
        let cosine = field.cosines(&table.scores(&query_f32))[0];
        let mut embedding = vec![f32::NAN; DIM];
        field.embedding(0, &table, &mut embedding);
        assert!(embedding.iter().all(|c| c.is_finite()));
        assert!(field.mean_lengths[0].is_finite());
        if !field.has_evidence(0) {
            assert!(cosine.is_nan() && embedding.iter().all(|c| *c == 0.0));
            return None;
        }
        let (true_length, expected) = (length(&mean), unit(&mean));
        let difference: Vec<f64> = embedding.iter().zip(&expected).map(|(a, b)| f64::from(*a) - b).collect();
        let true_cosine: f64 = expected.iter().zip(&query_f32).map(|(e, q)| e * f64::from(*q)).sum();
        Some([
            (f64::from(field.total_weights[0]) / total - 1.0).abs(),
            (f64::from(field.mean_lengths[0]) - true_length).abs(),
            length(&difference) * true_length,
            (f64::from(cosine) - true_cosine).abs() * true_length,
        ])
    }
}

fn to_f32(vector: &[f64]) -> Vec<f32> {
    vector.iter().map(|c| *c as f32).collect()
}

fn print(row: &str, range: &str, worst: [f64; 4], claimed: f64) {
    let [total, mean, embedding, cosine] = worst;
    println!(
        "| {row} | {range} | total {total:.1e}, mean length {mean:.1e}, embedding x length {embedding:.1e}, \
         cosine x length {cosine:.1e} | claimed {claimed:.0e} |"
    );
    assert!(worst.iter().all(|error| *error <= claimed), "{row}: {worst:?}");
    assert!(total <= 1e-7, "{row}: a total is f64 rounded to f32, off by {total}");
}

fn worst_of(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    std::array::from_fn(|i| a[i].max(b[i]))
}

/// Two masks at an angle have a mean of length cos(angle / 2); antiparallel ones leave only noise.
#[test]
fn parallel_and_antiparallel_vectors() {
    let random = &mut Random::new(1);
    let (mut worst, mut n_flagged) = ([0.0; 4], 0);
    let from_pi = [0.0, 1e-7, 1e-5, 1e-4, 1e-3, 1.9e-3, 2.1e-3, 1e-2, 0.1];
    let angles =
        [0.0, 1e-7, 1e-5, 1e-3, 0.1, 1.0, 2.0].into_iter().chain(from_pi.map(|d| std::f64::consts::PI - d));
    for angle in angles {
        for _ in 0..20 {
            let a = direction(random);
            let other = direction(random);
            let along: f64 = a.iter().zip(&other).map(|(x, y)| x * y).sum();
            let b = unit(&other.iter().zip(&a).map(|(y, x)| y - along * x).collect::<Vec<_>>());
            let (sin, cos) = f64::sin_cos(angle);
            let turned: Vec<f64> = a.iter().zip(&b).map(|(x, y)| cos * x + sin * y).collect();
            let weight = (0.01 + 1e4 * uniform(random)) as f32;
            let seen = Seen { vectors: vec![to_f32(&a), to_f32(&turned)], weights: vec![weight; 2] };
            match seen.errors(&direction(random)) {
                Some(errors) => worst = worst_of(worst, errors),
                None => n_flagged += 1,
            }
            let is_clear = (angle / 2.0).cos() > MIN_MEAN_LENGTH;
            assert_eq!(seen.field().0.has_evidence(0), is_clear, "angle {angle}");
        }
    }
    assert_eq!(n_flagged, 6 * 20);
    print("parallel to antiparallel", "angles 0 to pi", worst, 1e-6);
}

/// Pairs of opposite vectors in random order cancel exactly; a vector of known weight remains.
#[test]
fn masks_that_disagree() {
    let random = &mut Random::new(2);
    let mut worst = [0.0; 4];
    // Shares that do not cancel, around the limit of evidence.
    for (share, has_evidence) in [(0.0, false), (1e-6, false), (9e-4, false), (1.1e-3, true), (1e-2, true)] {
        for n_pairs in [1, 30, 1000] {
            let mut terms: Vec<(Vec<f32>, f32)> = Vec::new();
            for _ in 0..n_pairs {
                let vector = to_f32(&direction(random));
                let weight = 10.0_f64.powf(uniform(random) * 6.0 - 1.0) as f32;
                let opposite = vector.iter().map(|c| -c).collect();
                terms.push((vector, weight));
                terms.insert(random.below(terms.len()), (opposite, weight));
            }
            let total: f64 = terms.iter().map(|t| f64::from(t.1)).sum();
            terms.push((to_f32(&direction(random)), (share * total) as f32));
            let (vectors, weights) = terms.into_iter().unzip();
            let errors = Seen { vectors, weights }.errors(&direction(random));
            assert_eq!(errors.is_some(), has_evidence, "{share} of {n_pairs} pairs remain");
            worst = worst_of(worst, errors.unwrap_or_default());
        }
    }
    print("cancellation", "2 to 2,001 masks, weights to 1e5, 0 to 1e-2 remain", worst, 1e-6);
}

/// A Gaussian in 16,384 views of 65,536 pixels each: 2^30 pixels.
#[test]
fn a_billion_pixels_over_many_views() {
    let random = &mut Random::new(3);
    let masks: Vec<Vec<f32>> = (0..7).map(|_| to_f32(&direction(random))).collect();
    let n_views = 1 << 14;
    let vectors = (0..n_views).map(|_| masks[random.below(7)].clone()).collect();
    let weights: Vec<f32> = (0..n_views).map(|_| (65536.0 * (0.5 + uniform(random))) as f32).collect();
    let n_px: f64 = weights.iter().map(|w| f64::from(*w)).sum();
    assert!(n_px > 1e9);
    let errors = Seen { vectors, weights }.errors(&direction(random)).expect("evidence");
    print("contributions of views", "16,384 views, 1.07e9 pixels", errors, 1e-5);
}

/// Non-finite mask vectors, which slag-models refuses, give no evidence, and never a NaN in the field.
#[test]
fn vectors_that_are_no_numbers_are_no_evidence() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX] {
        let mut vector = vec![0.1; DIM];
        vector[7] = bad;
        let seen = Seen { vectors: vec![vector, vec![0.04; DIM]], weights: vec![3.0, 2.0] };
        assert_eq!(seen.errors(&vec![0.04; DIM]), None, "{bad}");
    }
}

/// The exact shard of a cell, and its stated position error.
fn exact_shard(scene: &Gaussians, cell: &Cell, embeddings: &CellEmbeddings) -> (AlignedBytes, f64) {
    let bank = TextBank::directions(embeddings.dim);
    let metric = ScoreMetric::new(embeddings.dim, &bank);
    let spread = metric.spread(Rows::all(&embeddings.vectors, embeddings.dim));
    let settings = &ShardSettings { profiles: vec![Profile::Exact], ..ShardSettings::default() };
    let score_context = &ScoreMetricContext { metric, bank, spread };
    let builder = ShardBuilder { scene, encoder_id: Hash32([0; 32]), score_context, settings };
    let built = builder.build(0, cell, embeddings, None, Additions::default());
    (AlignedBytes::copy_of(&built.shards[0].bytes), built.position_error)
}

/// The exact shard of a one-cell scene in which each Gaussian shows one mask.
fn one_shard(vectors: &[Vec<f32>], means: Vec<DVec3>) -> AlignedBytes {
    let n = vectors.len();
    let scene = Gaussians::balls(means, 0.1);
    let limits = CellLimits { position_error: PositionError::Within(0.01), ..CellLimits::by_count(n) };
    let split = cells::split(&scene, limits);
    let cell = &split.cells[0];
    let entry = |i: usize| Contribution { local: split.local_of_gaussian[i], region: i as u32, weight: 2.0 };
    let mut entries: Vec<Contribution> = (0..n).map(entry).collect();
    entries.sort_by_key(|entry| entry.local);
    let (field, _, embeddings) = one_cell(vectors, entries, cell.gaussians.clone());
    let has_evidence = (0..n).map(|k| field.has_evidence(k)).collect();
    exact_shard(&scene, cell, &CellEmbeddings { dim: DIM, vectors: embeddings, has_evidence }).0
}

/// Order by centroid, then along the Morton curve; without evidence last. Oracle: bits interleaved one by one.
#[test]
fn gaussians_are_in_the_order_of_the_format() {
    let random = &mut Random::new(6);
    let n = 2000;
    let directions: Vec<Vec<f32>> = (0..9).map(|_| to_f32(&direction(random))).collect();
    let vectors: Vec<Vec<f32>> = (0..n)
        .map(|i| if i % 10 == 0 { vec![f32::NAN; DIM] } else { directions[random.below(9)].clone() })
        .collect();
    let means: Vec<DVec3> =
        (0..n).map(|_| DVec3::new(uniform(random), 30.0 * uniform(random), -uniform(random))).collect();
    let bytes = one_shard(&vectors, means.clone());
    let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
    let indices = shard.exact.expect("exact").input_indices;
    let least = means.iter().copied().reduce(DVec3::min).expect("means");
    let size = means.iter().copied().reduce(DVec3::max).expect("means") - least;
    let morton = |index: &u32| {
        let steps = (means[*index as usize] - least) / (size / f64::from((1 << 21) - 1));
        (0..21).rev().fold(0u64, |code, bit| {
            [steps.z, steps.y, steps.x].iter().fold(code, |code, axis| code << 1 | (*axis as u64 >> bit & 1))
        })
    };
    let starts: Vec<usize> = shard.centroid_starts.iter().map(|start| *start as usize).chain([n]).collect();
    assert!(starts.len() > 5, "{starts:?}");
    for run in starts.windows(2).map(|ends| &indices[ends[0]..ends[1]]) {
        assert!(run.is_sorted_by_key(|index| (morton(index), *index)), "{run:?}");
    }
    let n_with = n - n / 10;
    assert_eq!(*shard.centroid_starts.last().expect("starts") as usize, n_with);
    assert!(indices[n_with..].iter().all(|index| index % 10 == 0));
}

/// Components from 1 down to 1e-12 as f16: errors of half a step of 2^-11, below 2^-14 of 2^-24; the smallest are 0.
#[test]
fn embeddings_stored_as_f16() {
    let random = &mut Random::new(4);
    let n = 300;
    let vectors: Vec<Vec<f32>> = (0..n)
        .map(|i| {
            // Every tenth is a unit axis, so that 1 itself occurs.
            let raw = (0..DIM).map(|c| match (i % 10 == 0, c == i) {
                (true, is_axis) => f64::from(u8::from(is_axis)),
                _ => (1.0 - 2.0 * random.below(2) as f64) * 10.0_f64.powf(-12.0 * uniform(random)),
            });
            to_f32(&unit(&raw.collect::<Vec<_>>()))
        })
        .collect();
    let means = (0..n).map(|i| DVec3::new(i as f64, 0.0, 1.0)).collect();
    let bytes = one_shard(&vectors, means);
    let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
    let exact = shard.exact.expect("exact");
    assert_eq!(exact.input_indices.len(), n);
    let (mut worst_step, mut worst_vector, mut n_zero, mut n_subnormal) = (0.0_f64, 0.0_f64, 0, 0);
    for (stored, input) in exact.embeddings.chunks_exact(DIM).zip(exact.input_indices) {
        let expected: Vec<f64> = vectors[*input as usize].iter().map(|c| f64::from(*c)).collect();
        let difference: Vec<f64> = stored.iter().zip(&expected).map(|(s, e)| s.to_f64() - e).collect();
        assert!(stored.iter().all(|c| c.is_finite()));
        for (difference, expected) in difference.iter().zip(&expected) {
            let half_step = (expected.abs() * 2.0_f64.powi(-11)).max(2.0_f64.powi(-25));
            // The rest is the f32 rounding of the mean and of its length.
            worst_step = worst_step.max((difference.abs() - 4e-7 * expected.abs()) / half_step);
        }
        worst_vector = worst_vector.max(length(&difference));
        n_zero += stored.iter().zip(&expected).filter(|(s, e)| **s == f16::ZERO && **e != 0.0).count();
        n_subnormal += stored.iter().filter(|s| !s.is_normal() && **s != f16::ZERO).count();
    }
    assert!(n_zero > 1000 && n_subnormal > 1000, "underflow must occur");
    println!(
        "| f16 embeddings | components 1e-12 to 1 | {worst_step:.3} half steps, vector {worst_vector:.1e} | claimed 1, 5e-4 |"
    );
    assert!(worst_step <= 1.0 && worst_vector <= 5e-4, "{worst_step} {worst_vector}");
}

/// Strays, scenes at any distance, Gaussians of any size: no position errs more than requested, or than stated.
#[test]
fn positions_keep_their_error_with_strays() {
    let random = &mut Random::new(11);
    let (n, dim) = (600, 8);
    for (n_strays, distance, place, scale, error) in [
        (1, 1e3, 0.0, 0.02, PositionError::OfSize),
        (20, 1e4, 0.0, 0.02, PositionError::OfSize),
        (1, 1e5, 0.0, 0.02, PositionError::OfSize),
        (20, 1e6, 0.0, 0.02, PositionError::OfSize),
        (20, 1e9, 0.0, 0.02, PositionError::OfSize),
        (20, 3e38, 0.0, 0.02, PositionError::OfSize),
        (20, 1e9, 0.0, 0.0, PositionError::OfSize),
        (20, 1e6, 0.0, 0.02, PositionError::Within(0.01)),
        (20, 3e38, 0.0, 0.02, PositionError::Within(0.01)),
        (0, 0.0, 0.0, 0.02, PositionError::Within(1e-6)),
        (0, 0.0, 1e9, 0.02, PositionError::Within(1e-3)),
        (3, 1e6, 1e15, 0.02, PositionError::Within(0.01)),
        (20, 1e30, 1e-30, 1e-35, PositionError::OfSize),
    ] {
        let at = |k: usize, random: &mut Random| {
            let towards = DVec3::from_array(std::array::from_fn(|_| uniform(random) * 2.0 - 1.0));
            if k < n_strays { towards * distance } else { DVec3::splat(place) + 4.0 * towards }
        };
        let means: Vec<DVec3> = (0..n).map(|k| at(k, random)).collect();
        let limits = CellLimits { position_error: error, ..CellLimits::by_count(n) };
        let mut largest = 0.0f64;
        let scene = Gaussians::balls(means, scale);
        let split = cells::split(&scene, limits);
        for cell in &split.cells {
            let n = cell.gaussians.len();
            let embeddings =
                CellEmbeddings { dim, vectors: vec![0.0; n * dim], has_evidence: vec![false; n] };
            let (bytes, stated) = exact_shard(&scene, cell, &embeddings);
            let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
            for (k, input) in shard.exact.expect("exact").input_indices.iter().enumerate() {
                let mean = scene.means_in_world[*input as usize];
                let off = (shard.position_in_world(k) - mean).abs().max_element();
                assert!(off <= stated, "{distance}: {off} {stated}");
                // As large as Gaussians, but no finer than f32.
                let allowed = match error {
                    PositionError::Within(error) => error,
                    PositionError::OfSize if (*input as usize) < n_strays => distance * 6e-8,
                    PositionError::OfSize => f64::from(scale / 4.0).max(2.4e-7),
                };
                assert!(off <= allowed, "{n_strays} at {distance}: {off} {allowed}");
                largest = largest.max(off / allowed);
            }
        }
        assert_eq!(split.cells.iter().map(|cell| cell.gaussians.len()).sum::<usize>(), n);
        let n_cells = split.cells.len();
        println!("| {n_strays} strays at {distance:e}: {n_cells} cells, {largest:.3} of the error |");
    }
}

/// How tight the radii of a shard's centroids are, in float64.
struct Bounds {
    /// Ratio of a radius to the distance of its farthest member: least and largest.
    nearest: f64,
    farthest: f64,
    /// Largest error of a score, in radii.
    score: f64,
}

impl Bounds {
    /// `vectors`: by input index. Where all members equal the centroid, its radius must not be negative.
    fn of(shard: &ShardView<'_>, vectors: &[Vec<f32>], queries: &[Vec<f64>]) -> Self {
        let (mut nearest, mut farthest, mut score) = (f64::INFINITY, 0.0_f64, 0.0_f64);
        for centroid in 0..shard.radii.len() {
            let mut stored = vec![0.0; DIM];
            shard.decode_centroid(centroid, &mut stored);
            let radius = f64::from(shard.radii[centroid]);
            let mut largest = 0.0_f64;
            for member in shard.members(centroid) {
                let input = shard.exact.expect("exact").input_indices[member] as usize;
                let difference: Vec<f64> =
                    vectors[input].iter().zip(&stored).map(|(v, s)| f64::from(*v) - s).collect();
                largest = largest.max(length(&difference));
                for query in queries {
                    let off: f64 = difference.iter().zip(query).map(|(d, q)| d * q).sum();
                    score = score.max(if off == 0.0 { 0.0 } else { off.abs() / radius });
                }
            }
            let ratio = if largest == 0.0 { 1.0 + radius } else { radius / largest };
            (nearest, farthest) = (nearest.min(ratio), farthest.max(ratio));
        }
        Self { nearest, farthest, score }
    }
}

/// The bound of scores at the extremes: equal vectors, two that cancel, every axis, components below a byte's step
/// beside large ones, one vector unlike thousands. The worst query is the direction of the error.
#[test]
fn scores_keep_their_bound_at_the_extremes() {
    let random = &mut Random::new(12);
    let n = 1200;
    let axis =
        |k: usize, sign: f64| -> Vec<f64> { (0..DIM).map(|c| if c == k { sign } else { 0.0 }).collect() };
    let common = direction(random);
    let needle = |random: &mut Random, size: f64| {
        let noise = direction(random);
        unit(&axis(0, 1.0).iter().zip(&noise).map(|(a, n)| a + size * n).collect::<Vec<_>>())
    };
    let scenes: Vec<(&str, Vec<Vec<f64>>)> = vec![
        ("alike", vec![common.clone(); n]),
        ("opposite", (0..n).map(|i| axis(3, if i % 2 == 0 { 1.0 } else { -1.0 })).collect()),
        ("every axis", (0..n).map(|i| axis(i % DIM, 1.0)).collect()),
        ("small beside large", (0..n).map(|i| needle(random, 10f64.powi(-((i % 13) as i32)))).collect()),
        ("one unlike all", (0..n).map(|i| if i == 77 { axis(9, -1.0) } else { common.clone() }).collect()),
        ("noise", (0..n).map(|_| direction(random)).collect()),
    ];
    for (name, vectors) in scenes {
        let vectors: Vec<Vec<f32>> = vectors.iter().map(|vector| to_f32(vector)).collect();
        let means = (0..n).map(|k| DVec3::splat(k as f64 * 0.01)).collect();
        let bytes = one_shard(&vectors, means);
        let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
        let queries: Vec<Vec<f64>> =
            (0..4).map(|_| direction(random)).chain([common.clone(), axis(0, 1.0)]).collect();
        let Bounds { nearest, score, .. } = Bounds::of(&shard, &vectors, &queries);
        println!(
            "| {name} | {} centroids, radius over distance {nearest:.6}, score {score:.3} radii |",
            shard.radii.len()
        );
        assert!(nearest >= 1.0 && score <= 1.0, "{name}: {nearest} {score}");
    }
}

/// Centroids are within the stated radius of their members, positions within half a step.
#[test]
fn shards_keep_their_bounds() {
    let random = &mut Random::new(5);
    let centres: Vec<Vec<f64>> = (0..8).map(|_| direction(random)).collect();
    let n = 3000;
    let vectors: Vec<Vec<f32>> = (0..n)
        .map(|i| {
            let noise = direction(random);
            to_f32(&unit(&centres[i % 8].iter().zip(&noise).map(|(c, n)| c + 0.3 * n).collect::<Vec<_>>()))
        })
        .collect();
    // A cell of 25 m, 1,000 km from the origin.
    let means: Vec<DVec3> =
        (0..n).map(|_| DVec3::from_array(std::array::from_fn(|_| 1e6 + 25.0 * uniform(random)))).collect();
    let bytes = one_shard(&vectors, means.clone());
    let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
    let input = |i: usize| shard.exact.expect("exact").input_indices[i] as usize;
    let half_step = DVec3::from(shard.header.position_step) / 2.0;
    let offsets =
        (0..n).map(|i| ((shard.position_in_world(i) - means[input(i)]) / half_step).abs().max_element());
    let position = offsets.fold(0.0, f64::max);

    let queries: Vec<Vec<f64>> = centres.iter().cloned().chain((0..20).map(|_| direction(random))).collect();
    let Bounds { nearest, farthest, score } = Bounds::of(&shard, &vectors, &queries);
    println!(
        "| shards | 25 m cell 1e6 m away, {} centroids | position {position:.6} half steps, radius over distance {nearest:.6} \
         to {farthest:.6}, score {score:.3} radii |",
        shard.radii.len()
    );
    assert!(half_step.max_element() <= 0.01, "{half_step}");
    assert!(position <= 1.0 + 1e-5 && nearest >= 1.0 && farthest <= 1.001 && score <= 1.0);
}
