//! Measures of agreement between answers and labels.

/// Area under the ROC curve, ties counted half (Mann and Whitney 1947); `None` without both classes.
pub(super) fn area_under_roc(scores: &[f32], positive: &[bool]) -> Option<f64> {
    let n_positive = positive.iter().filter(|p| **p).count() as f64;
    let n_negative = positive.len() as f64 - n_positive;
    if n_positive == 0.0 || n_negative == 0.0 {
        return None;
    }
    // Ranks from the worst; equal scores share their mean rank.
    let (mut sum, mut n_left) = (0.0, positive.len() as f64);
    for (n, n_right) in equal_scores(scores, positive) {
        sum += (n_left - (n - 1.0) / 2.0) * n_right;
        n_left -= n;
    }
    Some((sum - n_positive * (n_positive + 1.0) / 2.0) / (n_positive * n_negative))
}

/// Average precision: the sum of precision over steps of recall, as in TREC and scikit-learn. Equal scores form one
/// step. `None` without positives.
pub(super) fn average_precision(scores: &[f32], positive: &[bool]) -> Option<f64> {
    let n_positive = positive.iter().filter(|p| **p).count() as f64;
    if n_positive == 0.0 {
        return None;
    }
    let (mut sum, mut found, mut n_found) = (0.0, 0.0, 0.0);
    for (n, n_right) in equal_scores(scores, positive) {
        found += n_right;
        n_found += n;
        sum += n_right / n_positive * found / n_found;
    }
    Some(sum)
}

/// Numbers of equal scores, best first, and of those that are positive.
fn equal_scores(scores: &[f32], positive: &[bool]) -> Vec<(f64, f64)> {
    let mut order: Vec<usize> = (0..scores.len()).collect();
    order.sort_unstable_by(|a, b| scores[*b].total_cmp(&scores[*a]));
    let counts = |same: &[usize]| (same.len() as f64, same.iter().filter(|k| positive[**k]).count() as f64);
    order.chunk_by(|a, b| scores[*a] == scores[*b]).map(counts).collect()
}

#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Confusion {
    n_classes: usize,
    /// `[true class][answered class]`, the last answer being none.
    counts: Vec<u64>,
}

impl Confusion {
    pub(super) fn new(n_classes: usize) -> Self {
        Self { n_classes, counts: vec![0; n_classes * (n_classes + 1)] }
    }

    /// Counts an answer; `None` is wrong for every class.
    pub(super) fn count(&mut self, truth: usize, answer: Option<usize>) {
        self.counts[truth * (self.n_classes + 1) + answer.unwrap_or(self.n_classes)] += 1;
    }

    fn row(&self, truth: usize) -> &[u64] {
        &self.counts[truth * (self.n_classes + 1)..(truth + 1) * (self.n_classes + 1)]
    }

    /// Intersection over union; `None` where the class neither occurs nor is answered.
    pub(super) fn iou(&self, class: usize) -> Option<f64> {
        let both = self.row(class)[class];
        let is_true: u64 = self.row(class).iter().sum();
        let answered: u64 = (0..self.n_classes).map(|truth| self.row(truth)[class]).sum();
        let union = is_true + answered - both;
        (union > 0).then(|| both as f64 / union as f64)
    }

    /// Share answered correctly; `None` where the class does not occur.
    pub(super) fn accuracy(&self, class: usize) -> Option<f64> {
        let is_true: u64 = self.row(class).iter().sum();
        (is_true > 0).then(|| self.row(class)[class] as f64 / is_true as f64)
    }
}

pub(super) fn mean(values: impl IntoIterator<Item = Option<f64>>) -> Option<f64> {
    let (sum, n) = values.into_iter().flatten().fold((0.0, 0), |(sum, n), v| (sum + v, n + 1));
    (n > 0).then(|| sum / f64::from(n))
}

pub(super) fn iou_of_sets(pairs: impl IntoIterator<Item = (bool, bool)>) -> Option<f64> {
    let (both, any) = pairs
        .into_iter()
        .fold((0u64, 0u64), |(both, any), (a, b)| (both + u64::from(a && b), any + u64::from(a || b)));
    (any > 0).then(|| both as f64 / any as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition, pair by pair.
    #[test]
    fn roc_is_the_share_of_ordered_pairs() {
        let scores = [0.9, 0.4, 0.4, 0.4, 0.1, 0.8, 0.1, -0.3];
        let positive = [true, true, false, true, false, false, true, false];
        let (mut right, mut n) = (0.0, 0.0);
        for (a, _) in scores.iter().zip(&positive).filter(|(_, p)| **p) {
            for (b, _) in scores.iter().zip(&positive).filter(|(_, p)| !**p) {
                right += if a > b {
                    1.0
                } else if a == b {
                    0.5
                } else {
                    0.0
                };
                n += 1.0;
            }
        }
        let found = area_under_roc(&scores, &positive).expect("both kinds");
        assert!((found - right / n).abs() < 1e-12, "{found} {}", right / n);
        assert_eq!(area_under_roc(&scores, &[true; 8]), None);
    }

    /// By hand: positives at ranks 1, 3 and 5 of 6; and all scores equal.
    #[test]
    fn average_precision_by_hand() {
        let scores = [0.9, 0.8, 0.7, 0.6, 0.5, 0.4];
        let positive = [true, false, true, false, true, false];
        let expected = (1.0 + 2.0 / 3.0 + 3.0 / 5.0) / 3.0;
        assert!((average_precision(&scores, &positive).expect("positives") - expected).abs() < 1e-12);
        assert_eq!(average_precision(&[0.5; 6], &positive), Some(0.5));
        assert_eq!(average_precision(&scores, &[false; 6]), None);
    }

    /// By hand: three classes, one answer missing.
    #[test]
    fn confusion_by_hand() {
        let mut confusion = Confusion::new(3);
        for (truth, answer) in [(0, Some(0)), (0, Some(0)), (0, Some(1)), (1, Some(1)), (1, None)] {
            confusion.count(truth, answer);
        }
        assert_eq!(confusion.iou(0), Some(2.0 / 3.0));
        assert_eq!(confusion.iou(1), Some(1.0 / 3.0));
        assert_eq!(confusion.iou(2), None);
        assert_eq!([0, 1, 2].map(|c| confusion.accuracy(c)), [Some(2.0 / 3.0), Some(0.5), None]);
        assert_eq!(mean([Some(1.0), None, Some(0.5)]), Some(0.75));
        assert_eq!(iou_of_sets([(true, true), (true, false), (false, false)]), Some(0.5));
    }
}
