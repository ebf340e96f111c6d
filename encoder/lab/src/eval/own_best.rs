//! Words compared by how near a score is to the word's own best ones.
//!
//! Some words score high with everything (hubs), so the argmax gives them the Gaussians of words that score low even where they are
//! right. Cross-domain similarity local scaling (Conneau et al. 2018, equation 4) subtracts from each score half the mean of the
//! word's best scores, and half that of the Gaussian's. The latter is the same for all words, so it is left out here.
//! This is for words that the scene has: the best score of an absent word is low, so the word would gain.

/// Share of the mean that is subtracted.
const SHARE: f32 = 0.4;
/// Best scores of a word.
const N_BEST: usize = 100;

/// Returns the offset to subtract from each word's scores. NaN scores are ignored.
pub(super) fn offsets(scores: &[Vec<f32>]) -> Vec<f32> {
    let offset = |scores: &Vec<f32>| {
        let mut known: Vec<f32> = scores.iter().copied().filter(|score| !score.is_nan()).collect();
        known.sort_unstable_by(|a, b| b.total_cmp(a));
        known.truncate(N_BEST);
        let sum: f64 = known.iter().map(|score| f64::from(*score)).sum();
        SHARE * (sum / known.len().max(1) as f64) as f32
    };
    scores.iter().map(offset).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: a hub that scores 0.5 to 0.6 with everything, and a word that is right where it scores 0.45.
    #[test]
    fn a_hub_leaves_the_gaussians_of_other_words() {
        let hub: Vec<f32> = (0..200).map(|i| if i < 100 { 0.6 } else { 0.5 }).collect();
        let word: Vec<f32> = (0..200).map(|i| if i < 100 { 0.1 } else { 0.45 }).collect();
        let found = offsets(&[hub.clone(), word.clone(), vec![f32::NAN; 3], vec![0.5, f32::NAN, 0.3]]);
        let expected = [0.4 * 0.6, 0.4 * 0.45, 0.0, 0.4 * 0.4];
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}");
        let best = |i: usize| usize::from(word[i] - found[1] > hub[i] - found[0]);
        assert_eq!((best(0), best(150)), (0, 1));
        assert!(hub[150] > word[150]);
    }
}
