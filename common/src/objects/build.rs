//! Makes the columns that describe a shard's objects.

use crate::quantise::quantise;

/// Rounds the vectors of an object (`[n][m]`, components) to 8 bits and pads them to `n_vectors` by repeating the
/// last, which changes no score.
///
/// Returns components and steps; a step is 1/127 of its vector's largest component.
pub fn quantise_vectors(vectors: &[f32], m: usize, n_vectors: usize) -> (Vec<i8>, Vec<f32>) {
    let (mut components, mut steps) = (Vec::new(), Vec::new());
    let last = (vectors.len() / m.max(1)).saturating_sub(1);
    for vector in 0..n_vectors {
        let (rounded, step) = quantise(&vectors[vector.min(last) * m..][..m]);
        components.extend(rounded);
        steps.push(step);
    }
    (components, steps)
}

/// Collects runs of consecutive Gaussians of the same object.
///
/// `objects`: the object of each Gaussian of a shard, [`NO_OBJECT`](super::columns::NO_OBJECT) for none. Returns
/// the end and the object of each run.
pub fn collect_runs(objects: impl IntoIterator<Item = u16>) -> (Vec<u32>, Vec<u16>) {
    let (mut run_ends, mut run_objects) = (Vec::new(), Vec::new());
    for (index, object) in (0u32..).zip(objects) {
        if run_objects.last() != Some(&object) {
            run_objects.push(object);
            run_ends.push(index);
        }
        run_ends.last_mut().into_iter().for_each(|end| *end = index + 1);
    }
    (run_ends, run_objects)
}
