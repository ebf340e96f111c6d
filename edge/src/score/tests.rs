use std::sync::Arc;

use glam::DVec3;
use proptest::prelude::*;
use slag_common::frames::Aabb;
use slag_common::shard::ShardView;

use super::cell::F16_ROUNDING;
use super::*;
use crate::testing::{BuiltShard, Member, TestShard, normalised};
use slag_math::random::Random;

/// Positions spread over all 16 bits, so that a ball can cover a shard.
const STEPS_PER_UNIT: f64 = 5000.0;

/// Shards whose scores by [`exact_question`] are exact in f32, in f64 and in any order of addition: components are
/// multiples of 1/2. Ties are frequent.
fn exact_shards() -> impl Strategy<Value = Vec<TestShard>> {
    let component = (-2i32..=2).prop_map(|v| v as f32 / 2.0);
    let member = (prop::array::uniform3(0u16..13), prop::collection::vec(component, 4))
        .prop_map(|(units, embedding)| Member { steps: units.map(|u| u * STEPS_PER_UNIT as u16), embedding });
    let shard = (
        prop::collection::vec(prop::collection::vec(member, 1..6), 0..8),
        prop::collection::vec(prop::array::uniform3(0u16..12), 0..3),
        prop::array::uniform3(-3i32..3),
    );
    prop::collection::vec(shard, 0..5).prop_map(|shards| {
        let build =
            |(at, (centroids, without_evidence, origin)): (usize, (Vec<Vec<Member>>, _, [i32; 3]))| {
                let origin = DVec3::from(origin.map(|v| f64::from(v) * 8.0));
                let step = DVec3::new(1.0, 0.5, 0.25) / STEPS_PER_UNIT;
                let cell_id = at as u32 + 10;
                let shard = TestShard { has_exact_centroids: true, ..TestShard::new(centroids) };
                TestShard { cell_id, origin, step, without_evidence, ..shard }
            };
        shards.into_iter().enumerate().map(build).filter(|s| !s.centroids.is_empty()).collect()
    })
}

/// Unit vectors whose products with [`exact_shards`] are exact: signs of 1/2, and axes.
fn exact_vector() -> impl Strategy<Value = Arc<[f32]>> {
    let halves = prop::array::uniform4(any::<bool>()).prop_map(|s| s.map(|s| if s { 0.5 } else { -0.5 }));
    let axis = (0usize..4, any::<bool>()).prop_map(|(axis, sign)| {
        std::array::from_fn(|i| if i == axis { [-1.0, 1.0][usize::from(sign)] } else { 0.0 })
    });
    prop_oneof![halves, axis].prop_map(|v: [f32; 4]| v.into())
}

fn exact_question() -> impl Strategy<Value = Question> {
    (exact_vector(), prop::collection::vec(exact_vector(), 0..4))
        .prop_map(|(vector, negatives)| Question { negatives, ..Question::new(vector) })
}

fn region() -> impl Strategy<Value = Region> {
    let point = || prop::array::uniform3(-20i32..20).prop_map(|c| DVec3::from(c.map(f64::from)));
    let ball = (point(), 0u32..40)
        .prop_map(|(centre_in_world, radius)| Ball { centre_in_world, radius: f64::from(radius) + 0.1 });
    let bounds = (point(), point()).prop_map(|(a, b)| Aabb { min: a.min(b), max: a.max(b) });
    let either = (prop::option::of(ball), prop::option::of(bounds));
    either.prop_map(|(ball, bounds)| Region { ball, bounds, polygon: None })
}

/// `q · e - max_j n_j · e` in f64.
pub(super) fn score_in_f64(question: &Question, embedding: impl Iterator<Item = f64> + Clone) -> f64 {
    let dot = |v: &[f32]| embedding.clone().zip(v).map(|(e, v)| e * f64::from(*v)).sum::<f64>();
    let worst = question.negatives.iter().map(|n| dot(n)).reduce(f64::max).unwrap_or(0.0);
    // A sum of zeros only is -0, which sorts before 0.
    dot(&question.vector) - worst + 0.0
}

/// (shard, index, score, position) of every Gaussian with evidence inside the region, in f64.
fn brute_force(
    built: &[BuiltShard],
    question: &Question,
    region: Region,
    precision: Precision,
) -> Vec<(u32, u32, f64, DVec3)> {
    let mut all = Vec::new();
    for (at, shard) in built.iter().enumerate() {
        let view = shard.view();
        for centroid in 0..view.header.n_centroids as usize {
            for index in view.members(centroid) {
                let mut vector = vec![0.0; question.vector.len()];
                match precision {
                    Precision::Exact | Precision::Measured => view.decode(index, &mut vector),
                    Precision::Centroids => view.decode_centroid(centroid, &mut vector),
                }
                let score = score_in_f64(question, vector.iter().copied());
                let p = view.position_in_world(index);
                let in_ball = region.ball.is_none_or(|b| p.distance(b.centre_in_world) <= b.radius);
                let in_box = |b: Aabb| (0..3).all(|axis| b.min[axis] <= p[axis] && p[axis] <= b.max[axis]);
                if in_ball && region.bounds.is_none_or(in_box) {
                    all.push((at as u32, index as u32, score, p));
                }
            }
        }
    }
    all
}

fn members_of(matches: &Matches) -> Vec<(u32, u32)> {
    matches.runs.iter().flat_map(|run| (run.start..run.end).map(|i| (run.shard, i))).collect()
}

pub(super) fn views(built: &[BuiltShard]) -> Vec<ShardView<'_>> {
    built.iter().map(BuiltShard::view).collect()
}

proptest! {
    /// Oracle: every Gaussian scored in f64. Arithmetic is exact, so sets and orders are equal, in a batch and alone.
    #[test]
    fn equals_brute_force(
        shards in exact_shards(), is_exact in any::<bool>(), centroids_only in any::<bool>(),
        questions in prop::collection::vec(exact_question(), 1..4), threshold in -16i32..16, limit in 0usize..30,
        region in region(), near in prop::option::of(prop::array::uniform3(-20i32..20)),
    ) {
        let built: Vec<_> = shards.iter().rev().map(|s| s.build(is_exact)).collect();
        let views = views(&built);
        let threshold = threshold as f32 / 8.0;
        let precision = if centroids_only { Precision::Centroids } else { Precision::Exact };
        let batch = Search::batch(&views, &questions, &region, precision, &Budget::default()).expect("valid");
        prop_assert_eq!(batch.len(), questions.len());
        for (search, question) in batch.iter().zip(&questions) {
            // Centroids are rounded with a power-of-two step, so sums stay exact.
            let mut expected = brute_force(&built, question, region.clone(), precision);
            expected.retain(|(_, _, score, _)| *score >= f64::from(threshold));
            let matches = search.matching(threshold);
            prop_assert_eq!(members_of(&matches), expected.iter().map(|e| (e.0, e.1)).collect::<Vec<_>>());
            prop_assert_eq!(matches.n_gaussians as usize, expected.len());
            prop_assert_eq!(search.is_exact(), precision == Precision::Exact && search.searched().all(|s| s.exact.is_some()));

            let near = near.map(|near| DVec3::from(near.map(f64::from)));
            let distance = |p: DVec3| near.map_or(0.0, |n| n.distance(p));
            let cell = |shard: u32| views[shard as usize].header.cell_id;
            expected.sort_by(|a, b| {
                let by_name = (cell(a.0), a.1).cmp(&(cell(b.0), b.1));
                b.2.total_cmp(&a.2).then(distance(a.3).total_cmp(&distance(b.3))).then(by_name)
            });
            expected.truncate(limit);
            let best = search.best(limit, threshold, near);
            let found: Vec<_> = best.iter().map(|h| (h.shard, h.index, f64::from(h.score))).collect();
            prop_assert_eq!(found, expected.iter().map(|e| (e.0, e.1, e.2)).collect::<Vec<_>>());

            let alone = Search::new(&views, question, region.clone(), precision).expect("valid");
            prop_assert_eq!(&alone.matching(threshold), &matches);
            prop_assert_eq!(&alone.best(limit, threshold, near), &best);
        }
    }
}

fn noisy_shards(random: &mut Random, n_shards: usize, n_centroids: usize, dim: usize) -> Vec<TestShard> {
    let mut shard = |cell_id: usize| {
        let mut centroids = Vec::new();
        for _ in 0..n_centroids {
            let (centre, noise) = (random.unit_vector(dim), random.signed().abs() * 0.4);
            let member = |random: &mut Random| {
                let offset = random.unit_vector(dim);
                let embedding = normalised(centre.iter().zip(offset).map(|(c, o)| c + noise * o).collect());
                Member { steps: [0; 3].map(|_| random.bits() as u16), embedding }
            };
            let n = 1 + random.bits() % 20;
            centroids.push((0..n).map(|_| member(random)).collect());
        }
        TestShard { cell_id: cell_id as u32, ..TestShard::new(centroids) }
    };
    (0..n_shards).map(&mut shard).collect()
}

/// The bound holds for every unrounded embedding. Compact membership errs within the bound, exact in the last bits.
#[test]
fn answers_keep_within_the_stated_bound() {
    let mut random = Random::new(1);
    let (mut n_between, mut n_saved, mut largest_share) = (0, 0, 0.0f64);
    for (dim, n_negatives) in [(5, 0), (64, 0), (64, 4), (515, 0), (515, 2)] {
        let shards = noisy_shards(&mut random, 3, 40, dim);
        let compact: Vec<_> = shards.iter().map(|s| s.build(false)).collect();
        let exact: Vec<_> = shards.iter().map(|s| s.build(true)).collect();
        let (compact_views, exact_views) = (views(&compact), views(&exact));
        for _ in 0..20 {
            let question = random_question(&mut random, dim, n_negatives);
            let threshold = random.signed() * 0.5;
            let search = |views, precision| {
                Search::new(views, &question, Region::default(), precision).expect("valid")
            };
            let centroids = search(&compact_views, Precision::Exact);
            let bound = f64::from(centroids.score_error_bound());
            let matches = centroids.matching(threshold);
            assert_eq!(search(&exact_views, Precision::Centroids).matching(threshold), matches);
            let mut expected_in =
                matches.runs.iter().flat_map(|r| (r.start..r.end).map(|i| (r.shard, i, r.score))).peekable();
            let exact_search = search(&exact_views, Precision::Exact);
            let exact_matches = exact_search.matching(threshold);
            let exact_in = members_of(&exact_matches);
            let mut n = 0;
            for (at, shard) in compact.iter().enumerate() {
                for (index, embedding) in shard.embeddings.iter().enumerate() {
                    let truth = score_in_f64(&question, embedding.iter().map(|e| f64::from(*e)));
                    let name = (at as u32, index as u32);
                    let is_in = expected_in.next_if(|(s, i, _)| (*s, *i) == name);
                    if let Some((_, _, score)) = is_in {
                        let error = (f64::from(score) - truth).abs();
                        assert!(error <= bound, "{score} {truth} {bound}");
                        largest_share = largest_share.max(error / bound);
                    } else {
                        let holds = truth < f64::from(threshold) + bound;
                        assert!(holds, "missed {truth} at {threshold}, bound {bound}");
                    }
                    n_between += usize::from((truth - f64::from(threshold)).abs() < bound);
                    let is_exactly_in = exact_in.binary_search(&name).is_ok();
                    if (truth - f64::from(threshold)).abs() > 2.0 * f64::from(F16_ROUNDING) {
                        assert_eq!(is_exactly_in, truth >= f64::from(threshold), "{truth} at {threshold}");
                    }
                    n += 1;
                }
            }
            assert!(expected_in.next().is_none());
            assert!(exact_search.is_exact() && !centroids.is_exact());
            n_saved += n - exact_matches.effort.n_rescored;
        }
    }
    println!("largest error of a centroid's score: {largest_share:.2} of the bound");
    assert!(n_between > 1000, "the bound was hardly tested: {n_between}");
    assert!(n_saved > 1000, "every Gaussian was scored by itself: the centroids served for nothing");
}

pub(super) fn random_question(random: &mut Random, dim: usize, n_negatives: usize) -> Question {
    let mut unit = || Arc::from(random.unit_vector(dim));
    Question {
        vector: unit(),
        negatives: (0..n_negatives).map(|_| unit()).collect(),
        least: f32::NEG_INFINITY,
    }
}

fn batch<'a>(shards: &'a [ShardView<'a>], questions: &'a [Question]) -> Result<Vec<Search<'a>>, ScoreError> {
    Search::batch(shards, questions, &Region::default(), Precision::Exact, &Budget::default())
}

#[test]
fn does_not_depend_on_threads() {
    let mut random = Random::new(2);
    let shards: Vec<_> = noisy_shards(&mut random, 9, 50, 64).iter().map(|s| s.build(true)).collect();
    let views = views(&shards);
    let questions = [0, 2].map(|n_negatives| random_question(&mut random, 64, n_negatives));
    let answers = [1, 2, 7].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let batch = batch(&views, &questions).expect("valid");
            let answer =
                |search: &Search<'_>| (search.matching(-0.05), search.best(40, -1.0, Some(DVec3::ONE)));
            batch.iter().map(answer).collect::<Vec<_>>()
        })
    });
    assert!(answers[0].iter().all(|(matches, best)| matches.n_gaussians > 0 && best.len() == 40));
    assert!(answers.iter().all(|answer| *answer == answers[0]));
}

/// Counts the work: skipped centroids are not scored at all.
#[test]
fn skips_by_box_and_by_bound() {
    let at = |x: f64, direction: [f32; 2]| {
        let members = vec![Member { steps: [0; 3], embedding: direction.to_vec() }];
        TestShard { origin: DVec3::new(x, 0.0, 0.0), step: DVec3::ZERO, ..TestShard::new(vec![members]) }
            .build(true)
    };
    let built = [at(0.0, [1.0, 0.0]), at(10.0, [0.0, 1.0]), at(100.0, [1.0, 0.0])];
    let ball = Ball { centre_in_world: DVec3::ZERO, radius: 20.0 };
    let shards = views(&built);
    let question = Question::new([1.0, 0.0]);
    let region = Region { ball: Some(ball), bounds: None, polygon: None };
    let search = Search::new(&shards, &question, region, Precision::Exact).expect("valid");
    assert_eq!(search.searched().count(), 2);
    let matches = search.matching(0.5);
    assert_eq!(members_of(&matches), [(0, 0)]);
    assert_eq!(matches.effort.n_rescored, 0);
}

#[test]
fn refuses_what_cannot_be_scored() {
    let members = vec![Member { steps: [1; 3], embedding: vec![1.0, 0.0] }];
    let good = TestShard::new(vec![members]);
    let far = TestShard { step: DVec3::splat(1e300), ..good.clone() }.build(false);
    let good = good.build(false);
    let search = |shard: &BuiltShard, query: &[f32], negatives: &[&[f32]]| {
        let negatives = negatives.iter().map(|n| Arc::from(*n)).collect();
        let questions = [Question::new([1.0, 0.0]), Question { negatives, ..Question::new(query) }];
        let shards = [shard.view()];
        let batch = batch(&shards, &questions).map(|_| ()).err();
        let alone = Search::new(&shards, &questions[1], Region::default(), Precision::Exact);
        assert_eq!(format!("{:?}", alone.map(|_| ()).err()), format!("{batch:?}"));
        batch
    };
    assert_eq!(search(&good, &[0.0, 1.0], &[&[1.0, 0.0]]), None);
    let refused = |shard: &BuiltShard, query: &[f32], negatives: &[&[f32]], expected: &str| {
        let error = search(shard, query, negatives).expect(expected).to_string();
        assert!(error.contains(expected), "{error}");
    };
    refused(&good, &[1.0, 0.0, 0.0], &[], "embeddings of 2 components, but the query vector has 3");
    refused(
        &good,
        &[1.0, 0.0],
        &[&[1.0, 0.0], &[1.0]],
        "a negative has 1 components, but the query vector has 2",
    );
    for (query, negatives) in
        [([1.0, 1.0], vec![]), ([f32::NAN, 1.0], vec![]), ([1.0, 0.0], vec![&[0.0, 0.0][..]])]
    {
        refused(&good, &query, &negatives, "the query vector has length");
    }
    refused(&far, &[0.0, 1.0], &[], "positions reach");
}
