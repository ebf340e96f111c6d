//! The paper's prediction filter: the Gaussians of a superpoint answer together.

use rayon::prelude::*;
use slag_encoder::lift::superpoint::{NO_SUPERPOINT, Superpoints};

/// How a superpoint's Gaussians agree on an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Filter {
    /// All take the most frequent class; ties go to the first of the list.
    Majority,
    /// All take the mean score.
    Mean,
}

/// Gives all Gaussians of a superpoint the mean of their scores, ignoring NaN.
pub(super) fn average(scores: &mut [f32], superpoints: &Superpoints) {
    let mut sums = vec![(0.0f64, 0u32); superpoints.n];
    for (score, superpoint) in scores.iter().zip(&superpoints.of_gaussian) {
        if *superpoint != NO_SUPERPOINT && !score.is_nan() {
            let (sum, n) = &mut sums[*superpoint as usize];
            *sum += f64::from(*score);
            *n += 1;
        }
    }
    for (score, superpoint) in scores.iter_mut().zip(&superpoints.of_gaussian) {
        if let Some((sum, n)) = sums.get(*superpoint as usize).filter(|(_, n)| *n > 0) {
            *score = (sum / f64::from(*n)) as f32;
        }
    }
}

/// Gives all Gaussians of a superpoint their most frequent class.
pub(super) fn vote(classes: &mut [Option<usize>], superpoints: &Superpoints) {
    let labels = (0u32..).zip(&*classes).filter_map(|(gaussian, class)| Some((gaussian, (*class)?)));
    let winners = superpoints.most_frequent(labels.collect::<Vec<_>>().into_par_iter());
    for (class, superpoint) in classes.iter_mut().zip(&superpoints.of_gaussian) {
        if let Some(winner) = winners.get(*superpoint as usize) {
            *class = *winner;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn superpoints() -> Superpoints {
        Superpoints { of_gaussian: vec![0, 0, 1, 0, 1, NO_SUPERPOINT, 2], n: 3 }
    }

    #[test]
    fn means_ignore_missing_scores_and_replace_them() {
        let mut scores = [0.2, 0.4, 1.0, f32::NAN, 0.5, 0.7, f32::NAN];
        average(&mut scores, &superpoints());
        let expected = [0.3, 0.3, 0.75, 0.3, 0.75, 0.7];
        assert!(scores.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{scores:?}");
        assert!(scores[6].is_nan());
    }

    #[test]
    fn the_most_frequent_class_wins_and_ties_go_to_the_first() {
        let mut classes = [Some(2), Some(1), Some(4), Some(2), Some(3), Some(0), None];
        vote(&mut classes, &superpoints());
        assert_eq!(classes, [Some(2), Some(2), Some(3), Some(2), Some(3), Some(0), None]);
    }
}
