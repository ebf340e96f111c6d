//! Scores questions against the objects of a generation, each object once.
//!
//! With `q^` and `y^` as in `project.rs`, a vector `v` of an object scores `mean . q + step * v . y^`: an integer
//! product, scaled once. A stored vector has length at most 1 + e, with the shard's stated quantisation error bound
//! e. Rounding the question therefore changes the score by at most `|q - q^| (1 + e + |mean|) + step * |v| * |y -
//! y^|` (Cauchy-Schwarz); the bounds returned are the sum of that and e.

use rayon::prelude::*;
use slag_common::objects::{MAX_VECTORS, Objects, object_score};
use slag_common::shard::ShardView;
use slag_math::simd::InstructionSet;

use super::budget::ScoreError;
use super::project::{Projection, Vector, up};
use super::question::{Question, check};
use super::search::{combine, distinct};
use super::simd::RowsTimesVector;
use crate::store::objects::ObjectIndex;

/// Objects scored at a time; their products stay in the L1 cache.
const TOGETHER: usize = 64;
/// Rounding of two cosines and their mean to f32: half a step each, at 2 or less.
const ROUNDING: f64 = 2.0 * f32::EPSILON as f64;

#[derive(Clone, Debug, PartialEq)]
pub struct ObjectScores {
    /// By object, in the order of the index.
    pub scores: Vec<f32>,
    pub error_bound: f32,
}

/// Scores the shards' objects: [`object_score`] of the question's vector, minus the largest of its negatives'.
///
/// Shared negatives are multiplied once. Scores are the same for any number of threads and on every processor.
pub fn score_objects(
    shards: &[ShardView<'_>],
    objects: &[Option<Objects<'_>>],
    index: &ObjectIndex,
    questions: &[Question],
) -> Result<Vec<ObjectScores>, ScoreError> {
    check(shards, questions)?;
    let (vectors, places) = distinct(questions);
    let instructions = InstructionSet::widest();
    let of_shard = |(at, objects): (usize, &Option<Objects<'_>>)| -> Vec<ObjectScores> {
        let Some(objects) = objects else { return Vec::new() };
        let scored =
            vectors.iter().map(|v| of_vector(instructions, &shards[at], objects, index.first_in(at), v));
        let scored: Vec<ObjectScores> = scored.collect();
        questions.iter().zip(&places).map(|(of, places)| of_question(&scored, places, of.least)).collect()
    };
    let by_shard: Vec<Vec<ObjectScores>> = objects.par_iter().enumerate().map(of_shard).collect();
    let mut all = vec![ObjectScores { scores: vec![0.0; index.len()], error_bound: 0.0 }; questions.len()];
    for (shard, of_shard) in by_shard.iter().enumerate() {
        for (all, here) in all.iter_mut().zip(of_shard) {
            all.error_bound = all.error_bound.max(here.error_bound);
            for ((_, object), score) in index.first_in(shard).iter().zip(&here.scores) {
                all.scores[*object as usize] = *score;
            }
        }
    }
    Ok(all)
}

/// Combines the scores of a question's vector and its negatives, listed by `places` in this order.
fn of_question(scored: &[ObjectScores], places: &[usize], least: f32) -> ObjectScores {
    let (own, negatives) = (&scored[places[0]], &places[1..]);
    let of = |(at, own): (usize, &f32)| combine(*own, negatives.iter().map(|n| scored[*n].scores[at]), least);
    let largest = negatives.iter().map(|n| scored[*n].error_bound + f32::EPSILON).reduce(f32::max);
    ObjectScores {
        scores: own.scores.iter().enumerate().map(of).collect(),
        error_bound: own.error_bound + largest.unwrap_or(0.0),
    }
}

/// Scores objects of a shard against one vector. `which`: pairs that begin with an object's number.
fn of_vector(
    instructions: InstructionSet,
    shard: &ShardView<'_>,
    objects: &Objects<'_>,
    which: &[(u32, u32)],
    vector: &Vector,
) -> ObjectScores {
    let projection = Projection::new(instructions, shard, vector);
    let (n_vectors, n_components) = (objects.header.n_vectors, shard.header.n_components as usize);
    let mut scores = Vec::with_capacity(which.len());
    let mut largest_step = 0.0f32;
    for which in which.chunks(TOGETHER) {
        let rows = which.iter().flat_map(|(number, _)| number * n_vectors..(number + 1) * n_vectors);
        let rows: Vec<u32> = rows.collect();
        let products = instructions.dispatch(RowsTimesVector {
            rows: objects.vectors,
            n_components,
            vector: &projection.rounded.steps,
            which: &rows,
        });
        for (rows, products) in rows.chunks(n_vectors as usize).zip(products.chunks(n_vectors as usize)) {
            let mut cosines = [0.0; MAX_VECTORS as usize];
            for ((cosine, row), product) in cosines.iter_mut().zip(rows).zip(products) {
                let step = objects.steps[*row as usize];
                let scale = f64::from(step) * projection.rounded.step;
                *cosine = (projection.base + scale * f64::from(*product)) as f32;
                largest_step = largest_step.max(step);
            }
            scores.push(object_score(&cosines[..rows.len()]) + 0.0);
        }
    }
    let kept = f64::from(objects.header.score_error_bound);
    let longest = f64::from(largest_step) * 128.0 * (n_components as f64).sqrt();
    let of_question = f64::from(projection.error_per_length);
    let error_bound = kept * vector.length
        + of_question * (1.0 + kept + f64::from(projection.mean_length))
        + projection.rounded.error * longest
        + ROUNDING;
    let error_bound = up(error_bound);
    ObjectScores { scores, error_bound }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::score::tests::{random_question, views};
    use crate::testing::coded::CodedShard;
    use crate::testing::{BuiltShard, CALIBRATION, TestObject};
    use glam::DVec3;
    use slag_math::random::Random;

    const KEPT: f32 = 0.005;

    /// Builds a shard with one object, of one Gaussian, for each id.
    fn built(random: &mut Random, (dim, m, has_basis): (usize, usize, bool), ids: &[u64]) -> BuiltShard {
        let (cell_id, n_subspaces, is_exact, origin) = (1, 0, false, DVec3::ZERO);
        let centroid_lens = vec![ids.len()];
        let shard = CodedShard {
            cell_id,
            dim,
            n_components: m,
            has_basis,
            n_subspaces,
            is_exact,
            centroid_lens,
            origin,
        };
        let shard = shard.build(random);
        // At most unit length, with the mean.
        let objects = (0..).zip(ids).map(|(at, id)| TestObject {
            id: *id,
            vectors: (0..3 * m).map(|_| random.signed() * 0.9 / (m as f32).sqrt()).collect(),
            runs: std::iter::once(at..at + 1).collect(),
            n_gaussians: 2,
        });
        shard.with_objects(&objects.collect::<Vec<_>>(), CALIBRATION)
    }

    /// Oracle: the format's definition in float64, in the first shard with the object. The bound holds without the
    /// share for quantisation, which no vector here needs.
    #[test]
    fn each_object_scores_as_defined_within_the_bound_and_at_every_level() {
        let mut random = Random::new(41);
        let mut largest_share = 0.0f32;
        for shape in
            [(16, 0, true), (1, 1, false), (64, 64, false), (40, 7, true), (512, 96, true), (515, 3, true)]
        {
            let ids = [(10..80).rev().collect::<Vec<u64>>(), vec![5], (70..90).collect()];
            let built: Vec<BuiltShard> = ids.iter().map(|ids| built(&mut random, shape, ids)).collect();
            let shards = views(&built);
            let mut objects: Vec<_> =
                built.iter().map(|shard| shard.layout.additions(&shard.bytes).objects).collect();
            objects[1] = None;
            let index = ObjectIndex::new(&objects);
            let mut questions: Vec<Question> =
                [0, 1, 3].map(|n| random_question(&mut random, shape.0, n)).into();
            let shared = questions[2].negatives[1].clone();
            questions[1].negatives.push(shared);
            let found = score_objects(&shards, &objects, &index, &questions).expect("scores");
            for (question, found) in questions.iter().zip(&found) {
                let mut expected: BTreeMap<u64, f32> = BTreeMap::new();
                for (shard, objects) in shards.iter().zip(&objects) {
                    let Some(objects) = objects else { continue };
                    let own = shard.object_scores(objects, &question.vector);
                    let negatives: Vec<_> =
                        question.negatives.iter().map(|n| shard.object_scores(objects, n)).collect();
                    for (number, record) in objects.records.iter().enumerate() {
                        let worst = negatives.iter().map(|scores| scores[number]).reduce(f32::max);
                        expected.entry(record.id).or_insert(own[number] - worst.unwrap_or(0.0));
                    }
                }
                assert_eq!((found.scores.len(), index.len()), (80, expected.len()), "{shape:?}");
                let n_products = if question.negatives.is_empty() { 1.0 } else { 2.0 };
                let bound = found.error_bound - n_products * KEPT * (1.0 - 1e-5);
                assert!(bound > 0.0 && bound < 2e-3, "{shape:?} {bound}");
                for (found, expected) in found.scores.iter().zip(expected.values()) {
                    let share = (found - expected).abs() / bound;
                    assert!(share <= 1.0, "{shape:?} {found} {expected} {bound}");
                    largest_share = largest_share.max(share);
                }
                let alone = score_objects(&shards, &objects, &index, std::slice::from_ref(question));
                assert_eq!(alone.expect("scores"), std::slice::from_ref(found));
            }
            let vector = Vector::new(&questions[0].vector);
            let at = |instructions: InstructionSet| {
                let objects = objects[0].as_ref().expect("has objects");
                of_vector(instructions, &shards[0], objects, index.first_in(0), &vector)
            };
            for set in InstructionSet::available() {
                assert_eq!(at(*set), at(InstructionSet::Portable), "{} {shape:?}", set.name());
            }
        }
        assert!(largest_share > 0.02, "the bound was hardly tested: {largest_share}");
    }
}
