//! The few vectors that represent an object's masks.

use slag_common::manifest::Calibration;
use slag_common::objects::object_score;

use super::object::Object;
use crate::codebook::TextBank;
use crate::lift::RegionTable;
use slag_math::dot;

/// Most medoids of an object, in addition to its mean: one for each side of an object.
pub(super) const MAX_MEDOIDS: usize = 4;
/// Most masks considered, the heaviest first: more hardly change the medoids, and time grows with the square.
const MAX_MASKS: usize = 256;

/// Returns `[n][dim]`: the direction of the weighted mean of some masks' vectors, then medoids. Each medoid in
/// turn is the mask that most raises the weighted mean of all masks' cosines with their nearest medoid.
pub(super) fn choose(masks: &[u32], weights: &[f64], table: &RegionTable) -> Vec<f32> {
    let dim = table.dim();
    let vector = |mask: u32| table.mask_vectors().get(mask as usize);
    let mut masks = masks.to_vec();
    let weight = |mask: u32| weights[mask as usize];
    masks.sort_by(|a, b| weight(*b).total_cmp(&weight(*a)).then(a.cmp(b)));
    masks.truncate(MAX_MASKS);
    let mut mean = vec![0.0f64; dim];
    for mask in &masks {
        let scale = weight(*mask);
        mean.iter_mut().zip(vector(*mask)).for_each(|(m, v)| *m += scale * f64::from(*v));
    }
    let length = mean.iter().map(|m| m * m).sum::<f64>().sqrt();
    let mut chosen: Vec<f32> = match length > 0.0 {
        true => mean.iter().map(|m| (m / length) as f32).collect(),
        // Vectors that cancel have no mean direction: the heaviest one replaces it.
        false => vector(masks[0]).to_vec(),
    };
    let n = masks.len();
    let cosines: Vec<f32> =
        masks.iter().flat_map(|a| masks.iter().map(|b| dot(vector(*a), vector(*b)))).collect();
    let mut nearest = vec![-1.0f32; n];
    let mut taken = vec![false; n];
    for _ in 0..MAX_MEDOIDS.min(n) {
        let gain = |candidate: usize| -> f64 {
            let of_candidate = cosines[candidate * n..][..n].iter().zip(&nearest).zip(&masks);
            of_candidate
                .map(|((cosine, nearest), mask)| weight(*mask) * f64::from(cosine.max(*nearest)))
                .sum()
        };
        let gains = (0..n).filter(|i| !taken[*i]).map(|i| (i, gain(i)));
        let Some((best, _)) = gains.reduce(|a, b| if b.1 > a.1 { b } else { a }) else { break };
        taken[best] = true;
        nearest.iter_mut().zip(&cosines[best * n..]).for_each(|(nearest, c)| *nearest = nearest.max(*c));
        chosen.extend(vector(masks[best]));
    }
    chosen
}

/// Returns how the text bank scores over objects. The threshold is what the best object for an absent text hardly
/// ever reaches (see [`TextBank::absent_bound`]); banks too small for that have the standard deviation of all scores.
pub(super) fn calibrate(objects: &[Object], bank: &TextBank) -> Calibration {
    let (mut sum, mut squares, mut n) = (0.0, 0.0, 0.0f64);
    let mut best = vec![-1.0f32; bank.len()];
    for object in objects {
        for (text, best) in bank.vectors.chunks_exact(bank.dim).zip(&mut best) {
            let cosines: Vec<f32> = object.vectors.chunks_exact(bank.dim).map(|v| dot(v, text)).collect();
            let score = object_score(&cosines);
            *best = best.max(score);
            let score = f64::from(score);
            (sum, squares, n) = (sum + score, squares + score * score, n + 1.0);
        }
    }
    let mean = sum / n.max(1.0);
    let variance = (squares / n.max(1.0) - mean * mean).max(0.0);
    match bank.absent_bound(&mut best).filter(|_| !objects.is_empty()) {
        Some(threshold) => Calibration::with_threshold(mean as f32, threshold),
        None => Calibration { score_mean: mean as f32, score_spread: variance.sqrt() as f32 },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use slag_common::frames::Aabb;

    /// By hand: text k scores k / 100 with one object and 0 with the other; of 76 texts the 74th bounds absent ones.
    /// Without objects there is no threshold.
    #[test]
    fn the_best_object_of_an_absent_text_stays_below_the_threshold() {
        let n = 76;
        let object = |vectors: Vec<f32>| Object {
            id: 0,
            n_gaussians: 1,
            n_masks: 1,
            position_in_world: DVec3::ZERO,
            box_in_world: Aabb { min: DVec3::ZERO, max: DVec3::ZERO },
            vectors,
            photo: String::new(),
            photo_box_px: [0; 4],
        };
        let axes = (0..n).flat_map(|text| (0..n).map(move |axis| f32::from(u8::from(axis == text))));
        let bank = TextBank { dim: n, vectors: axes.collect(), present_share: 0.0 };
        let objects = [object(vec![0.0; n]), object((0..n).map(|k| k as f32 / 100.0).collect())];
        let found = calibrate(&objects, &bank);
        // The mean of 0 to 0.75 over both objects.
        assert!((found.score_mean - 0.1875).abs() < 1e-6, "{found:?}");
        assert!((found.threshold() - 0.73).abs() < 1e-6, "{found:?}");
        assert_eq!(calibrate(&[], &bank), Calibration { score_mean: 0.0, score_spread: 0.0 });
    }
}
