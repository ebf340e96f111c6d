//! Query vectors generated for a measurement.

use slag_common::shard::ShardView;

use slag_math::random::Random;

/// Weight of a scene embedding in a query that resembles a text: text and image vectors of one thing have
/// cosines around this (CLIP).
const LIKENESS: f32 = 0.3;

/// Generates query vectors: every other one in a random direction, the rest as similar to an embedding of the
/// scene as a text's vector is to the thing it names. The same seed gives the same vectors.
pub fn make_queries(shards: &[ShardView<'_>], n: usize, seed: u64) -> Vec<Vec<f32>> {
    let mut random = Random::new(seed);
    let mut queries = Vec::with_capacity(n.min(1 << 16));
    let dim = shards.first().map_or(0, |shard| shard.header.dim as usize);
    let known: Vec<&ShardView<'_>> = shards.iter().filter(|shard| shard.n_with_evidence() > 0).collect();
    for at in 0..n {
        let mut query: Vec<f64> = (0..dim).map(|_| random.normal()).collect();
        normalise(&mut query);
        if at % 2 == 1 && !known.is_empty() {
            let shard = known[random.below(known.len())];
            let mut like = vec![0.0; dim];
            shard.decode(random.below(shard.n_with_evidence()), &mut like);
            normalise(&mut like);
            let rest = f64::from((1.0 - LIKENESS * LIKENESS).sqrt());
            query.iter_mut().zip(like).for_each(|(q, l)| *q = *q * rest + l * f64::from(LIKENESS));
            normalise(&mut query);
        }
        queries.push(query.into_iter().map(|v| v as f32).collect());
    }
    queries
}

/// Scales a vector to unit length, unless it is zero.
pub(super) fn normalise(vector: &mut [f64]) {
    let length = vector.iter().map(|v| v * v).sum::<f64>().sqrt();
    if length > 0.0 {
        vector.iter_mut().for_each(|v| *v /= length);
    }
}
