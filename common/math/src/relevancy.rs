//! Relevancies: scores against negative prompts as a number from 0 to 1 (LERF, Kerr et al. 2023, section 3.3).

/// Steepness of [`relevancy`], from LERF.
pub const RELEVANCY_STEEPNESS: f32 = 10.0;

/// Maps a score with negatives to LERF's relevancy, `1 / (1 + exp(-t s))` with [t = 10](RELEVANCY_STEEPNESS): 0.5
/// where the query and the closest negative are equally near.
pub fn relevancy(score: f32) -> f32 {
    let t = f64::from(RELEVANCY_STEEPNESS);
    (1.0 / (1.0 + (-t * f64::from(score)).exp())) as f32
}

/// Inverse of [`relevancy`]; infinite for 0 and 1.
pub fn score_of_relevancy(relevancy: f32) -> f32 {
    let p = f64::from(relevancy);
    ((p / (1.0 - p)).ln() / f64::from(RELEVANCY_STEEPNESS)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: LERF's own formula, the minimum of pairwise softmaxes of 10 times the cosines.
    #[test]
    fn relevancy_is_the_least_pairwise_softmax() {
        for (positive, negatives) in
            [(0.3f64, [0.1f64, 0.25, -0.2]), (0.1, [0.4, 0.0, 0.3]), (0.2, [0.2, 0.1, 0.0])]
        {
            let softmax = |n: &f64| (10.0 * positive).exp() / ((10.0 * positive).exp() + (10.0 * n).exp());
            let expected = negatives.iter().map(softmax).fold(1.0, f64::min);
            let score = (positive - negatives.iter().fold(-1.0, |a: f64, b| a.max(*b))) as f32;
            assert!((f64::from(relevancy(score)) - expected).abs() < 1e-6);
            assert!((score_of_relevancy(relevancy(score)) - score).abs() < 1e-6);
        }
        assert_eq!((relevancy(0.0), score_of_relevancy(0.5)), (0.5, 0.0));
    }
}
