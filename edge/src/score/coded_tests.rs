//! Shards with bases and residual codes.

use slag_common::container::AlignedBytes;
use slag_common::shard::{Basis, MAX_SUBSPACES, Residuals, ShardLayout, ShardView};

use super::cell::UNDECIDED;
use super::tests::{random_question, score_in_f64, views};
use super::*;
use crate::testing::BuiltShard;
use crate::testing::coded::{CODE_ERROR, CodedShard, FINE_ERROR};
use glam::DVec3;
use half::f16;
use slag_math::random::Random;

/// Dimension, components, whether there is a basis, subspaces.
const SHAPES: [(usize, usize, bool, usize); 10] = [
    (16, 0, true, 0),
    (1, 1, false, 0),
    (37, 37, false, 0),
    (64, 64, false, 32),
    (40, 7, true, 0),
    (40, 7, true, 2),
    (33, 33, true, 14),
    (512, 96, true, 32),
    (130, 130, true, MAX_SUBSPACES),
    (515, 3, true, 2),
];

fn shards(
    random: &mut Random,
    (dim, n_components, has_basis, n_subspaces): (usize, usize, bool, usize),
    is_exact: bool,
) -> Vec<BuiltShard> {
    // Centroids that end inside blocks or at block ends, or span several blocks.
    let lens = [&[1, 31, 32, 33, 70, 64, 5][..], &[1], &[3; 40]];
    let mut build = |(at, lens): (usize, &[usize])| {
        let cell_id = 9 - at as u32;
        let origin = DVec3::new(12.0 * at as f64, 0.0, 0.0);
        let centroid_lens = lens.to_vec();
        CodedShard { cell_id, dim, n_components, has_basis, n_subspaces, is_exact, centroid_lens, origin }
            .build(random)
    };
    lens.into_iter().enumerate().map(&mut build).collect()
}

/// Scores a Gaussian by the definitions of format and module, from the rounded parts.
fn defined_score(search: &Search<'_>, shard_at: usize, index: usize) -> f32 {
    let shard = &search.shards[shard_at];
    let (centroid, scores) = (shard.centroid_of(index), search.scored[shard_at].as_ref().expect("searched"));
    let product = |place: &usize| {
        let own = scores.centroids[*place][centroid];
        let Some(residuals) = shard.residuals.filter(|_| search.precision != Precision::Centroids) else {
            return own;
        };
        let (tables, scale) = (&scores.projections[*place].tables, residuals.residual_scales[centroid]);
        let value = |subspace: usize| {
            let half = if subspace.is_multiple_of(2) { &tables.low } else { &tables.high };
            u32::from(half[subspace / 2][residuals.code(index, subspace)])
        };
        let sum: u32 = (0..shard.header.n_subspaces as usize).map(value).sum();
        (own + scale * tables.offset) + scale * tables.step * sum as f32
    };
    let products: Vec<f32> = search.places.iter().map(product).collect();
    let worst = products[1..].iter().copied().fold(f32::NEG_INFINITY, f32::max);
    if products.len() > 1 { products[0] - worst } else { products[0] }
}

/// Oracle: float64 decoding, and the embeddings that the shards were made from.
#[test]
fn scores_are_within_the_stated_error() {
    let mut random = Random::new(21);
    let mut largest_share = 0.0f64;
    for shape in SHAPES {
        let built = shards(&mut random, shape, false);
        let views = views(&built);
        for n_negatives in [0, 3] {
            let question = random_question(&mut random, shape.0, n_negatives);
            for precision in [Precision::Exact, Precision::Centroids] {
                let search = Search::new(&views, &question, Region::default(), precision).expect("valid");
                for (at, (shard, built)) in views.iter().zip(&built).enumerate() {
                    let cell = search.cell(at).expect("searched");
                    for (index, embedding) in built.embeddings.iter().enumerate() {
                        let centroid = shard.centroid_of(index);
                        let found = f64::from(defined_score(&search, at, index));
                        let mut decoded = vec![0.0; shape.0];
                        match precision {
                            Precision::Exact | Precision::Measured => shard.decode(index, &mut decoded),
                            Precision::Centroids => shard.decode_centroid(centroid, &mut decoded),
                        }
                        let rounding = (found - score_in_f64(&question, decoded.iter().copied())).abs();
                        let truth = score_in_f64(&question, embedding.iter().map(|e| f64::from(*e)));
                        let bound = cell.score_error(centroid);
                        let of_rounding = match (&shard.residuals, precision) {
                            (Some(_), Precision::Centroids) => cell.centroid_error(centroid),
                            _ => bound - search.steepness * shard.radii[centroid],
                        };
                        let share = rounding / f64::from(of_rounding);
                        assert!((found - truth).abs() <= f64::from(bound), "{shape:?} {found} {truth}");
                        assert!(share <= 1.0, "{shape:?} {precision:?} {rounding} {of_rounding}");
                        largest_share = largest_share.max(share);
                        let (lower, upper) = cell.bounds(centroid);
                        let (lower, upper) = (f64::from(lower), f64::from(upper));
                        assert!(lower <= found && found <= upper, "{shape:?} {lower} {found} {upper}");
                    }
                }
            }
        }
    }
    println!("largest rounding: {largest_share:.2} of its bound");
    assert!(largest_share > 0.05, "the bound says nothing: {largest_share}");
}

/// Oracle: every Gaussian's score by definition, compared and sorted.
#[test]
fn answers_are_those_of_brute_force() {
    let mut random = Random::new(22);
    let (mut n_scanned, mut n_all) = (0, 0);
    for shape in SHAPES {
        let built = shards(&mut random, shape, false);
        let views = views(&built);
        for (n_negatives, precision, is_near) in [
            (0, Precision::Exact, false),
            (0, Precision::Centroids, false),
            (2, Precision::Exact, false),
            (0, Precision::Exact, true),
            (2, Precision::Centroids, true),
        ] {
            let question = random_question(&mut random, shape.0, n_negatives);
            let ball = Ball { centre_in_world: DVec3::new(11.0, 5.0, 5.0), radius: 6.0 };
            let region = Region { ball: is_near.then_some(ball), bounds: None, polygon: None };
            let search = Search::new(&views, &question, region.clone(), precision).expect("valid");
            let mut all: Vec<Hit> = Vec::new();
            for (at, view) in views.iter().enumerate().filter(|(at, _)| search.cell(*at).is_some()) {
                let inside = |index: &usize| region.contains(view.position_in_world(*index));
                let hit = |index: usize| {
                    let score = defined_score(&search, at, index);
                    Hit { shard: at as u32, index: index as u32, score }
                };
                all.extend((0..view.n_with_evidence()).filter(inside).map(hit));
            }
            let mut scores: Vec<f32> = all.iter().map(|hit| hit.score).collect();
            scores.sort_by(f32::total_cmp);
            let thresholds =
                [0.0, 0.3, 0.6, 0.9, 0.99].map(|p| scores[(p * (scores.len() - 1) as f64) as usize]);
            for threshold in thresholds.into_iter().chain([-9.0, 9.0]) {
                let matches = search.matching(threshold);
                let members = |run: &Run| {
                    let Run { shard, start, end, score } = *run;
                    (start..end).map(move |index| (Hit { shard, index, score }, end - start == 1))
                };
                let found: Vec<(Hit, bool)> = matches.runs.iter().flat_map(members).collect();
                let expected: Vec<&Hit> = all.iter().filter(|hit| hit.score >= threshold).collect();
                assert_eq!(found.len(), expected.len(), "{shape:?} {precision:?} {threshold}");
                for ((found, _), expected) in found.iter().zip(&expected) {
                    assert_eq!((found.shard, found.index), (expected.shard, expected.index));
                    // A centroid that matches as a whole reports its own score.
                    let centroid = views[found.shard as usize].centroid_of(found.index as usize);
                    let cell = search.cell(found.shard as usize).expect("searched");
                    assert!(found.score == expected.score || found.score == cell.centroids[centroid]);
                }
                n_scanned += matches.effort.n_rescored;
                n_all += all.len() as u64;
                let mut ranked: Vec<Hit> = expected.into_iter().copied().collect();
                let cell = |hit: &Hit| views[hit.shard as usize].header.cell_id;
                ranked.sort_by(|a, b| {
                    b.score.total_cmp(&a.score).then((cell(a), a.index).cmp(&(cell(b), b.index)))
                });
                for limit in [1, 7, 100, 180, usize::MAX] {
                    let best = search.best(limit, threshold, None);
                    assert_eq!(best, ranked[..limit.min(ranked.len())], "{shape:?} {precision:?} {limit}");
                }
            }
        }
    }
    assert!(n_scanned * 2 < n_all, "the centroids served for nothing: {n_scanned} of {n_all}");
    assert!(n_scanned * 20 > n_all, "hardly any code was read: {n_scanned} of {n_all}");
}

/// Oracle: each Gaussian's scores by code, fine residual and embedding, as the format and the module define them, and
/// the resulting matches.
#[test]
fn measured_errors_decide_as_defined() {
    let mut random = Random::new(24);
    let (mut n_fine, mut n_embeddings, mut n_all) = (0, 0, 0);
    for shape in SHAPES.into_iter().filter(|shape| shape.3 > 0) {
        let built = shards(&mut random, shape, true);
        let views = views(&built);
        for n_negatives in [0, 2] {
            let question = random_question(&mut random, shape.0, n_negatives);
            let measured = Precision::Measured;
            let search = Search::new(&views, &question, Region::default(), measured).expect("valid");
            assert!(!search.is_exact());
            let n_products = if n_negatives == 0 { 1.0 } else { 2.0 };
            let (code_margin, fine_margin) =
                (UNDECIDED * n_products * CODE_ERROR, UNDECIDED * n_products * FINE_ERROR);
            // By code, fine residual, embedding.
            let scores = |at: usize, index: usize| -> [f32; 3] {
                let (shard, mut decoded) = (&views[at], vec![0.0; shape.0]);
                let exact = shard.exact.expect("exact");
                shard.decode_fine(index, &exact.fine.expect("fine"), &mut decoded);
                let cell = search.cell(at).expect("searched");
                let (centroid, fine) =
                    (shard.centroid_of(index), score_in_f64(&question, decoded.iter().copied()));
                let (of_centroid, bound) =
                    (f64::from(cell.centroids[centroid]), f64::from(cell.embedding_bound(centroid)));
                let fine = fine.clamp(of_centroid - bound, of_centroid + bound);
                let embedding = &exact.embeddings[index * shape.0..][..shape.0];
                let exact = score_in_f64(&question, embedding.iter().map(|v| v.to_f64()));
                [defined_score(&search, at, index), fine as f32, exact as f32]
            };
            let mut all: Vec<(u32, u32, [f32; 3])> = Vec::new();
            for (at, view) in views.iter().enumerate() {
                let of_shard = (0..view.n_with_evidence()).map(|i| (at as u32, i as u32, scores(at, i)));
                all.extend(of_shard);
            }
            // Products are rounded to 16 bits, which decides in a few cases.
            let rounding = 1e-3 * n_products;
            let mut codes: Vec<f32> = all.iter().map(|(_, _, scores)| scores[0]).collect();
            codes.sort_by(|a, b| b.total_cmp(a));
            for rank in [0, 5, 50, 200, codes.len() - 1] {
                let threshold = codes[rank];
                let matches = search.matching(threshold);
                n_fine += matches.effort.n_fine_read;
                n_embeddings += matches.effort.n_embeddings_read;
                n_all += all.len() as u64;
                let members =
                    |run: &Run| (run.start..run.end).map(|index| (run.shard, index)).collect::<Vec<_>>();
                let found: Vec<(u32, u32)> = matches.runs.iter().flat_map(members).collect();
                assert!(found.is_sorted(), "{shape:?}");
                for (at, index, [code, fine, exact]) in &all {
                    let is_near = |score: f32, border: f32| (score - border).abs() <= rounding;
                    let is_in = if (code - threshold).abs() >= code_margin {
                        *code >= threshold
                    } else if (fine - threshold).abs() > fine_margin {
                        *fine >= threshold
                    } else {
                        *exact >= threshold
                    };
                    let is_close = is_near(*code, threshold + code_margin)
                        || is_near(*code, threshold - code_margin)
                        || [threshold - fine_margin, threshold + fine_margin]
                            .iter()
                            .any(|b| is_near(*fine, *b))
                        || is_near(*exact, threshold);
                    let is_found = found.binary_search(&(*at, *index)).is_ok();
                    assert!(is_close || is_found == is_in, "{shape:?} {code} {fine} {exact} {threshold}");
                }
                let limit = rank + 1;
                let best = search.best(limit, f32::NEG_INFINITY, None);
                assert_eq!(best.len(), limit, "{shape:?}");
                assert!(best.is_sorted_by(|a, b| a.score >= b.score));
                // Ranks are counted in steps of 1/2048.
                let (border, slack) = (threshold, 1.0 / 2048.0 + rounding);
                for hit in &best {
                    let at = all.iter().find(|(at, index, _)| (*at, *index) == (hit.shard, hit.index));
                    let [code, fine, exact] = at.expect("known").2;
                    assert!(code >= border - code_margin - slack, "{code} {border}");
                    let is_one =
                        [code, fine, exact].iter().any(|score| (score - hit.score).abs() <= rounding);
                    assert!(is_one, "{shape:?} {} of {code} {fine} {exact}", hit.score);
                }
            }
        }
    }
    assert!(n_fine * 2 < n_all && n_embeddings * 2 < n_fine, "{n_all} {n_fine} {n_embeddings}");
    assert!(n_fine * 50 > n_all && n_embeddings > 0, "{n_all} {n_fine} {n_embeddings}");
}

/// A shard may state any value the format allows, at its largest.
#[test]
fn the_largest_numbers_do_no_harm() {
    let mut random = Random::new(23);
    for (at, shape) in SHAPES.into_iter().enumerate() {
        let built = shards(&mut random, shape, false);
        let view = built[0].view();
        let mut header = view.header;
        header.centroid_step = 64.0;
        let centroids = vec![-128i8; view.centroids.len()];
        let (mean, vectors) = (vec![f16::MAX; shape.0], vec![-128i8; shape.0 * shape.1]);
        let steps = vec![64.0; shape.1];
        let basis = view.basis.map(|_| Basis { mean: &mean, vectors: &vectors, steps: &steps });
        let n = view.header.n_centroids as usize;
        let codewords: Vec<f16> = match view.residuals {
            Some(residuals) => {
                (0..residuals.codewords.len()).map(|i| if i % 3 == 0 { f16::MAX } else { f16::MIN }).collect()
            }
            None => Vec::new(),
        };
        let (scales, residual_norms, radii) =
            (vec![64.0; n], vec![if at % 2 == 0 { 0.0 } else { 64.0 }; n], vec![64.0; n]);
        let residuals = view.residuals.map(|old| Residuals {
            codewords: &codewords,
            residual_scales: &scales,
            residual_norms: &residual_norms,
            ..old
        });
        let mut bytes = Vec::new();
        let hostile = ShardView { header, centroids: &centroids, basis, residuals, radii: &radii, ..view };
        hostile.write(&mut bytes).expect("writes to memory");
        let bytes = AlignedBytes::copy_of(&bytes);
        let layout = ShardLayout::check(&bytes).expect("allowed");
        let views = [layout.view(&bytes)];
        let mut axis = vec![0.0; shape.0];
        axis[shape.0 - 1] = -1.0;
        let questions = [
            Question::new(axis),
            random_question(&mut random, shape.0, 2),
            Question::new(vec![1.0 / (shape.0 as f32).sqrt(); shape.0]),
        ];
        for question in &questions {
            let search = Search::new(&views, question, Region::default(), Precision::Exact).expect("valid");
            assert!(search.score_error_bound().is_finite());
            for threshold in [f32::NEG_INFINITY, -1.0, 0.0, 1.0, f32::INFINITY] {
                let matches = search.matching(threshold);
                assert!(matches.runs.iter().all(|run| run.score.is_finite()));
                assert!(search.best(100, threshold, None).iter().all(|hit| hit.score >= threshold));
            }
        }
    }
}
