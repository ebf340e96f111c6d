use slag_common::container::AlignedBytes;
use slag_common::shard::{
    Basis, ExactColumns, Fine, Positions, Residuals, ShardHeader, ShardLayout, ShardView,
};

use super::*;
use slag_math::random::mix64;

/// `n` unit vectors around `n_centres` random directions of few dimensions.
fn clustered(n: usize, n_centres: usize, dim: usize, spread: f32) -> Vec<f32> {
    let uniform = |i: u64| (mix64(i) >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
    let mut values = Vec::new();
    for i in 0..n {
        let centre = (mix64(i as u64 + 7) % n_centres as u64) * 1_000_003;
        let raw: Vec<f32> = (0..dim as u64)
            .map(|c| uniform(centre + c) + spread * uniform(1 << 40 | (i as u64) << 16 | c))
            .collect();
        let length = slag_math::dot(&raw, &raw).sqrt();
        values.extend(raw.iter().map(|v| v / length));
    }
    values
}

fn score_context(dim: usize, vectors: &[f32]) -> ScoreMetricContext {
    let bank = TextBank::directions(dim);
    let metric = ScoreMetric::new(dim, &bank);
    let spread = metric.spread(Rows::all(vectors, dim));
    ScoreMetricContext { metric, bank, spread }
}

fn shard_of(codebook: &Codebook, dim: usize, balanced: bool) -> AlignedBytes {
    let n = codebook.order.len() as u32;
    let residuals = codebook.residuals.as_ref().filter(|_| balanced);
    let header = ShardHeader {
        cell_id: 0,
        n_gaussians: n,
        n_centroids: codebook.radii.len() as u32,
        dim: dim as u32,
        n_components: codebook.n_components as u32,
        n_subspaces: residuals.map_or(0, |r| r.code.n_subspaces() as u32),
        position_bits: [10, 10, 10, 0],
        centroid_step: codebook.centroid_step,
        origin_in_world: [0.0; 3],
        position_step: [0.0; 3],
        box_min: [0.0; 3],
        box_max: [0.0; 3],
        errors: codebook.errors,
        encoder_id: [0; 32],
    };
    let mut out = Vec::new();
    ShardView {
        header,
        positions: Positions::Packed(&vec![0; n as usize]),
        centroid_starts: &codebook.centroid_starts,
        centroids: &codebook.centroids,
        radii: residuals.map_or(&codebook.radii, |r| &r.radii),
        basis: Some(Basis { mean: &codebook.mean, vectors: &codebook.basis, steps: &codebook.basis_steps }),
        residuals: residuals.map(|r| Residuals {
            subspace_starts: &r.code.subspace_starts,
            codewords: &r.code.codewords,
            residual_scales: &r.residual_scales,
            residual_norms: &r.residual_norms,
            codes: &r.codes,
        }),
        exact: None,
        packed_indices: None,
    }
    .write(&mut out)
    .expect("writes to memory");
    AlignedBytes::copy_of(&out)
}

/// Oracle: the naive decoder of the format, in float64. Radii bound every member and are not much larger;
/// the measured errors are those of the decoded scores; the residual code makes them smaller.
#[test]
fn bounds_and_errors_are_those_of_what_readers_decode() {
    for (dim, n, centres) in [(512, 1400, 20), (64, 900, 300), (16, 500, 5), (3, 40, 2), (5, 1, 1)] {
        let vectors = clustered(n, centres, dim, 0.3);
        let score_context = score_context(dim, &vectors);
        let settings = CodebookSettings { min_gaussians_per_centroid: 20, ..CodebookSettings::default() };
        let codebook = build(Rows::all(&vectors, dim), &score_context, &settings);
        let mut means = Vec::new();
        for balanced in [false, true] {
            let bytes = shard_of(&codebook, dim, balanced);
            let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
            let mut largest = vec![0.0f64; codebook.radii.len()];
            let (mut error_sum, mut error_max, mut n_errors) = (0.0, 0.0f64, 0);
            let mut decoded = vec![0.0; dim];
            for (place, at) in codebook.order.iter().enumerate() {
                let truth = &vectors[*at as usize * dim..][..dim];
                shard.decode(place, &mut decoded);
                let centroid = shard.centroid_of(place);
                let missed: Vec<f64> = truth.iter().zip(&decoded).map(|(t, d)| f64::from(*t) - d).collect();
                let length = missed.iter().map(|v| v * v).sum::<f64>().sqrt();
                largest[centroid] = largest[centroid].max(length);
                if n <= 1024 {
                    for text in score_context.bank.vectors.chunks_exact(dim) {
                        let error: f64 = text.iter().zip(&missed).map(|(t, m)| f64::from(*t) * m).sum();
                        error_sum += error.abs();
                        error_max = error_max.max(error.abs());
                        n_errors += 1;
                    }
                }
            }
            for (radius, largest) in shard.radii.iter().zip(&largest) {
                assert!(f64::from(*radius) >= *largest, "{dim}: {radius} < {largest}");
                assert!(f64::from(*radius) <= largest * 1.01 + 1e-5, "{dim}: {radius} far above {largest}");
            }
            let errors = match &codebook.residuals {
                Some(residuals) if balanced => residuals.errors,
                _ => codebook.errors,
            };
            if n_errors > 0 {
                let mean = error_sum / n_errors as f64;
                assert!((f64::from(errors.mean) - mean).abs() < 1e-3 * mean + 1e-6, "{errors:?} {mean}");
                assert!((f64::from(errors.max) - error_max).abs() < 1e-3 * error_max + 1e-6);
            }
            means.push(errors.mean);
        }
        let residuals = codebook.residuals.as_ref();
        println!(
            "{dim} x {n}: {} centroids of {} components, {} subspaces, errors {means:?}, spread {}",
            codebook.radii.len(),
            codebook.n_components,
            residuals.map_or(0, |r| r.code.n_subspaces()),
            score_context.spread
        );
        assert!(residuals.is_none() || means[1] < 0.8 * means[0], "{dim}: {means:?}");
    }
}

#[test]
fn residual_norms_bound_decoded_residuals() {
    let (dim, n) = (64, 600);
    let vectors = clustered(n, 200, dim, 0.4);
    let codebook =
        build(Rows::all(&vectors, dim), &score_context(dim, &vectors), &CodebookSettings::default());
    let residuals = codebook.residuals.as_ref().expect("one centroid a 40 is not enough here");
    let bytes = shard_of(&codebook, dim, true);
    let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
    let columns = shard.residuals.expect("balanced");
    for place in 0..n {
        let centroid = shard.centroid_of(place);
        let mut squares = 0.0;
        for (subspace, starts) in columns.subspace_starts.windows(2).enumerate() {
            let len = (starts[1] - starts[0]) as usize;
            let at = shard::CODEWORDS * starts[0] as usize + columns.code(place, subspace) * len;
            squares += columns.codewords[at..at + len].iter().map(|w| w.to_f64().powi(2)).sum::<f64>();
        }
        let length = squares.sqrt() * f64::from(columns.residual_scales[centroid]);
        assert!(
            length <= f64::from(residuals.residual_norms[centroid]) * (1.0 + 1e-6),
            "{length} {}",
            residuals.residual_norms[centroid]
        );
    }
}

/// Oracle: the naive decoder of the format, in float64. Fine residuals are many times nearer than codes, and their
/// errors are those that were measured.
#[test]
fn fine_residuals_decode_to_what_was_measured() {
    let (dim, n) = (64, 900);
    let vectors = clustered(n, 300, dim, 0.3);
    let score_context = score_context(dim, &vectors);
    let settings = CodebookSettings { has_fine: true, max_subspaces: 8, ..CodebookSettings::default() };
    let codebook = build(Rows::all(&vectors, dim), &score_context, &settings);
    let residuals = codebook.residuals.as_ref().expect("centroids are not enough here");
    let fine = residuals.fine.as_ref().expect("asked for");
    let stored = shard_of(&codebook, dim, true);
    let view = ShardLayout::check(&stored).expect("valid").view(&stored);
    let columns =
        Fine { errors: fine.errors, steps: &fine.steps, scales: &fine.scales, values: &fine.values };
    let in_order = codebook.order.iter().flat_map(|at| &vectors[*at as usize * dim..][..dim]);
    let embeddings: Vec<f16> = in_order.map(|v| f16::from_f32(*v)).collect();
    let exact = ExactColumns { input_indices: &codebook.order, embeddings: &embeddings, fine: Some(columns) };
    let mut bytes = Vec::new();
    ShardView { exact: Some(exact), ..view }.write(&mut bytes).expect("writes to memory");
    let bytes = AlignedBytes::copy_of(&bytes);
    let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
    let read = shard.exact.and_then(|exact| exact.fine).expect("written");
    let (mut sum, mut max, mut decoded) = (0.0, 0.0f64, vec![0.0; dim]);
    for (place, at) in codebook.order.iter().enumerate() {
        shard.decode_fine(place, &read, &mut decoded);
        let truth = &vectors[*at as usize * dim..][..dim];
        for text in score_context.bank.vectors.chunks_exact(dim) {
            let terms = text.iter().zip(truth).zip(&decoded);
            let error: f64 = terms.map(|((t, v), d)| f64::from(*t) * (f64::from(*v) - d)).sum();
            sum += error.abs();
            max = max.max(error.abs());
        }
    }
    let mean = sum / (n * score_context.bank.n_texts()) as f64;
    assert!((f64::from(fine.errors.mean) - mean).abs() < 1e-3 * mean + 1e-6, "{:?} {mean}", fine.errors);
    assert!((f64::from(fine.errors.max) - max).abs() < 1e-3 * max + 1e-6, "{:?} {max}", fine.errors);
    assert!(fine.errors.mean * 4.0 < residuals.errors.mean, "{:?} {:?}", fine.errors, residuals.errors);
}

#[test]
fn centroids_follow_the_content_not_the_count() {
    let build = |n_centres| {
        let vectors = clustered(5000, n_centres, 128, 0.02);
        let settings = CodebookSettings { min_gaussians_per_centroid: 1, ..CodebookSettings::default() };
        build(Rows::all(&vectors, 128), &score_context(128, &vectors), &settings).radii.len()
    };
    assert_eq!(build(4), 4);
    let many = build(300);
    assert!((250..=360).contains(&many), "{many} centroids for 300 clusters");
}

/// A handful of Gaussians: one centroid, which is their mean, and residuals as large as any.
#[test]
fn a_few_embeddings_are_finite() {
    for n in 1..=6 {
        let vectors = clustered(n, n, 64, 0.3);
        let mut score_context = score_context(64, &clustered(500, 50, 64, 0.3));
        for spread in [score_context.spread, 1e-6] {
            score_context.spread = spread;
            let codebook = build(Rows::all(&vectors, 64), &score_context, &CodebookSettings::default());
            for balanced in [false, true] {
                let bytes = shard_of(&codebook, 64, balanced);
                let shard = ShardLayout::check(&bytes).expect("finite").view(&bytes);
                assert!(shard.radii.iter().all(|r| *r < 1.5), "{n}: {:?}", shard.radii);
            }
        }
    }
}

/// Fewer components take fewer bytes a centroid and have larger errors; `max_components` is only a limit.
#[test]
fn components_are_limited() {
    let vectors = clustered(600, 200, 64, 0.4);
    let score_context = score_context(64, &vectors);
    let with = |max_components| {
        let settings = CodebookSettings { max_components, ..CodebookSettings::default() };
        let codebook = build(Rows::all(&vectors, 64), &score_context, &settings);
        assert_eq!(codebook.centroids.len(), codebook.n_components * codebook.radii.len());
        (codebook.n_components, codebook.errors.mean)
    };
    let (few, some, most) = (with(2), with(8), with(128));
    assert_eq!((few.0, some.0), (2, 8));
    assert!(some.0 < most.0 && most.0 <= 64, "{most:?}");
    assert!(few.1 > some.1 && some.1 > most.1, "{few:?} {some:?} {most:?}");
}

#[test]
fn equal_embeddings_make_one_centroid_and_none_makes_none() {
    let same = [0.5f32; 400];
    let codebook = build(Rows::all(&same, 4), &score_context(4, &same), &CodebookSettings::default());
    assert_eq!((codebook.radii.len(), codebook.residuals.is_none()), (1, true));
    let none = build(Rows::all(&[], 4), &score_context(4, &same), &CodebookSettings::default());
    assert_eq!((none.radii.len(), none.centroid_starts), (0, vec![0]));
}
