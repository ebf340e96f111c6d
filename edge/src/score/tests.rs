use proptest::prelude::*;
use slag_common::shard::ShardView;

use super::*;
use crate::testing::{BuiltShard, Member, Random, TestShard, normalised};

/// Positions spread over all 16 bits, so that a ball can cover a shard.
const STEPS_PER_UNIT: f64 = 5000.0;

/// Shards whose scores by [`exact_query`] are exact in f32, f64 and any order of addition: components
/// are multiples of 1/2 and the query's are all 1/2. Ties are plentiful.
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
        let build = |(at, (rows, without_evidence, origin)): (usize, (Vec<Vec<Member>>, _, [i32; 3]))| {
            let origin = DVec3::from(origin.map(|v| f64::from(v) * 8.0));
            let step = DVec3::new(1.0, 0.5, 0.25) / STEPS_PER_UNIT;
            TestShard { cell_id: at as u32 + 10, origin, step, without_evidence, ..TestShard::new(rows) }
        };
        shards.into_iter().enumerate().map(build).filter(|s| !s.rows.is_empty()).collect()
    })
}

fn exact_query() -> Vec<f32> {
    vec![0.5; 4]
}

/// (shard, index, score, position) of every Gaussian with evidence inside the ball, in f64.
fn brute_force(
    built: &[BuiltShard],
    query: &[f32],
    ball: Option<Ball>,
    exact: bool,
) -> Vec<(u32, u32, f64, DVec3)> {
    let mut all = Vec::new();
    for (at, shard) in built.iter().enumerate() {
        let view = shard.view();
        for row in 0..view.header.n_rows as usize {
            for index in view.members(row) {
                let dim = query.len();
                let vector = match (&view.exact, exact) {
                    (Some(columns), true) => &columns.embeddings[index * dim..][..dim],
                    _ => &view.palette[row * dim..][..dim],
                };
                let score = vector.iter().zip(query).map(|(e, q)| e.to_f64() * f64::from(*q)).sum();
                let position = view.position_in_world(index);
                if ball.is_none_or(|b| position.distance(b.centre_in_world) <= b.radius) {
                    all.push((at as u32, index as u32, score, position));
                }
            }
        }
    }
    all
}

fn members_of(matches: &Matches) -> Vec<(u32, u32)> {
    matches.runs.iter().flat_map(|run| (run.start..run.end).map(|i| (run.shard, i))).collect()
}

fn views(built: &[BuiltShard]) -> Vec<ShardView<'_>> {
    built.iter().map(BuiltShard::view).collect()
}

proptest! {
    /// Oracle: every Gaussian scored in f64; exact arithmetic, so the sets and orders must be equal.
    #[test]
    fn equals_brute_force(
        shards in exact_shards(), exact in any::<bool>(), threshold in -16i32..16, limit in 0usize..12,
        ball in prop::option::of((prop::array::uniform3(-20i32..20), 0u32..40)), near in prop::option::of(prop::array::uniform3(-20i32..20)),
    ) {
        let built: Vec<_> = shards.iter().map(|s| s.build(exact)).collect();
        let (views, query) = (views(&built), exact_query());
        let threshold = threshold as f32 / 8.0;
        let ball = ball.map(|(centre, radius)| Ball {
            centre_in_world: DVec3::from(centre.map(f64::from)), radius: f64::from(radius) + 0.1,
        });
        let search = Search::new(&views, &query, ball).expect("valid");
        // The palette of a compact shard is rounded to f16, after which sums are still exact.
        let mut expected = brute_force(&built, &query, ball, exact);
        expected.retain(|(_, _, score, _)| *score >= f64::from(threshold));
        let matches = search.matching(threshold);
        prop_assert_eq!(members_of(&matches), expected.iter().map(|e| (e.0, e.1)).collect::<Vec<_>>());
        prop_assert_eq!(matches.n_gaussians as usize, expected.len());

        let near = near.map(|near| DVec3::from(near.map(f64::from)));
        let distance = |p: DVec3| near.map_or(0.0, |n| n.distance(p));
        expected.sort_by(|a, b| {
            b.2.total_cmp(&a.2).then(distance(a.3).total_cmp(&distance(b.3))).then((a.0, a.1).cmp(&(b.0, b.1)))
        });
        expected.truncate(limit);
        let best = search.best(limit, threshold, near);
        let found: Vec<_> = best.iter().map(|h| (h.shard, h.index, f64::from(h.score), h.position_in_world)).collect();
        prop_assert_eq!(found, expected);
    }
}

/// Rows of noisy unit embeddings around random directions.
fn noisy_shards(random: &mut Random, n_shards: usize, n_rows: usize, dim: usize) -> Vec<TestShard> {
    let mut shard = |cell_id: usize| {
        let mut rows = Vec::new();
        for _ in 0..n_rows {
            let (centre, noise) = (random.unit(dim), random.signed().abs() * 0.4);
            let member = |random: &mut Random| {
                let offset = random.unit(dim);
                let embedding = normalised(centre.iter().zip(offset).map(|(c, o)| c + noise * o).collect());
                Member { steps: [0; 3].map(|_| random.next() as u16), embedding }
            };
            let n = 1 + random.next() % 20;
            rows.push((0..n).map(|_| member(random)).collect());
        }
        TestShard { cell_id: cell_id as u32, ..TestShard::new(rows) }
    };
    (0..n_shards).map(&mut shard).collect()
}

/// The bound holds for every Gaussian's unrounded embedding, and compact membership is wrong only
/// within it; exact membership is wrong nowhere but in the last bits.
#[test]
fn answers_keep_within_the_stated_bound() {
    let mut random = Random(1);
    let (mut n_between, mut n_saved) = (0, 0);
    for dim in [5, 64, 515] {
        let shards = noisy_shards(&mut random, 3, 40, dim);
        let compact: Vec<_> = shards.iter().map(|s| s.build(false)).collect();
        let exact: Vec<_> = shards.iter().map(|s| s.build(true)).collect();
        let (compact_views, exact_views) = (views(&compact), views(&exact));
        for _ in 0..20 {
            let query = random.unit(dim);
            let threshold = random.signed() * 0.5;
            let search = Search::new(&compact_views, &query, None).expect("valid");
            let bound = f64::from(search.score_error_bound());
            let matches = search.matching(threshold);
            let mut expected_in =
                matches.runs.iter().flat_map(|r| (r.start..r.end).map(|i| (r.shard, i, r.score))).peekable();
            let exact_search = Search::new(&exact_views, &query, None).expect("valid");
            let exact_matches = exact_search.matching(threshold);
            let exact_in = members_of(&exact_matches);
            let mut n = 0;
            for (at, shard) in compact.iter().enumerate() {
                for (index, embedding) in shard.embeddings.iter().enumerate() {
                    let truth: f64 =
                        embedding.iter().zip(&query).map(|(e, q)| f64::from(*e) * f64::from(*q)).sum();
                    let name = (at as u32, index as u32);
                    let is_in = expected_in.next_if(|(s, i, _)| (*s, *i) == name);
                    if let Some((_, _, score)) = is_in {
                        assert!((f64::from(score) - truth).abs() <= bound, "{score} {truth} {bound}");
                    } else {
                        assert!(
                            truth < f64::from(threshold) + bound,
                            "missed {truth} at {threshold}, bound {bound}"
                        );
                    }
                    n_between += usize::from((truth - f64::from(threshold)).abs() < bound);
                    let is_exactly_in = exact_in.binary_search(&name).is_ok();
                    if (truth - f64::from(threshold)).abs() > f64::from(F16_ROUNDING) {
                        assert_eq!(is_exactly_in, truth >= f64::from(threshold), "{truth} at {threshold}");
                    }
                    n += 1;
                }
            }
            assert!(expected_in.next().is_none());
            assert!(exact_search.is_exact() && !search.is_exact());
            n_saved += n - exact_matches.n_rescored;
        }
    }
    assert!(n_between > 1000, "the bound was hardly tested: {n_between}");
    assert!(n_saved > 1000, "every Gaussian was scored by itself: the rows served for nothing");
}

#[test]
fn does_not_depend_on_threads() {
    let mut random = Random(2);
    let shards: Vec<_> = noisy_shards(&mut random, 9, 50, 64).iter().map(|s| s.build(true)).collect();
    let (views, query) = (views(&shards), random.unit(64));
    let answers = [1, 2, 7].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let search = Search::new(&views, &query, None).expect("valid");
            (search.matching(0.05), search.best(40, -1.0, Some(DVec3::ONE)))
        })
    });
    assert!(answers[0].0.n_gaussians > 0);
    assert!(answers.iter().all(|answer| *answer == answers[0]));
}

/// Work is skipped, not only left out of the answer.
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
    let search = Search::new(&shards, &[1.0, 0.0], Some(ball)).expect("valid");
    assert_eq!(search.searched().count(), 2);
    let matches = search.matching(0.5);
    assert_eq!(members_of(&matches), [(0, 0)]);
    assert_eq!((matches.n_shards_below, matches.n_rescored, matches.n_rows_undecided), (1, 0, 0));
}

#[test]
fn refuses_what_cannot_be_scored() {
    let members = vec![Member { steps: [1; 3], embedding: vec![1.0, 0.0] }];
    let good = TestShard::new(vec![members]);
    let far = TestShard { step: DVec3::splat(1e300), ..good.clone() }.build(false);
    let good = good.build(false);
    let search =
        |shard: &BuiltShard, query: &[f32]| Search::new(&[shard.view()], query, None).map(|_| ()).err();
    assert_eq!(search(&good, &[0.0, 1.0]), None);
    assert!(matches!(
        search(&good, &[1.0, 0.0, 0.0]),
        Some(ScoreError::Dimension { expected: 2, found: 3, .. })
    ));
    assert!(matches!(search(&good, &[1.0, 1.0]), Some(ScoreError::NotUnit { .. })));
    assert!(matches!(search(&good, &[f32::NAN, 1.0]), Some(ScoreError::NotUnit { .. })));
    assert!(matches!(search(&far, &[0.0, 1.0]), Some(ScoreError::Extent { .. })));
}
