//! Names of objects: the words with the best scores, each with its share among all words. On scenes unlike those of
//! the fit, a share is no chance: far fewer names are right.
//!
//! A score s is z = (s - mean) / spread above all scores of words and objects of a scene, which makes models
//! comparable. The confidence of a word is a softmax over all words and "none of these": exp(a z) / (exp(a c) +
//! sum of exp(a z') over all words z').

use crate::everyday_nouns;

pub const MAX_NAMES: usize = 3;
/// Most words as names; phrase lists for people are shorter.
const MAX_WORDS: usize = 4096;
/// Least spread of scores; a smaller one means that nothing was measured.
const MIN_SPREAD: f64 = 1e-3;

#[derive(Clone, Copy, Debug)]
struct Fit {
    sharpness: f64,
    none_at: f64,
}

/// Maximum likelihood for two generated houses, true and automatic masks; the model knows the 85 words generated.
const EMBEDDED: Fit = Fit { sharpness: 1.5, none_at: 1.0 };
/// Maximum likelihood for ConSE's names in house_a, with true and automatic masks; no other model was available.
const OTHERS: Fit = Fit { sharpness: 1.0, none_at: 5.0 };

/// Words for names: the model's own, or everyday nouns.
pub fn words_of(vocabulary: Option<&[String]>) -> Vec<String> {
    match vocabulary {
        None | Some([]) => everyday_nouns().map(str::to_owned).collect(),
        Some(own) => own.iter().take(MAX_WORDS).cloned().collect(),
    }
}

/// Maps the scores of a scene's objects to confidences.
#[derive(Clone, Copy, Debug)]
pub struct Confidence {
    fit: Fit,
    mean: f64,
    spread: f64,
}

/// Measures the scores of all words and objects of a scene, or of a sample.
#[derive(Clone, Copy, Debug, Default)]
pub struct Spread {
    sum: f64,
    squares: f64,
    n: f64,
}

impl Spread {
    pub fn add(&mut self, scores: &[f32]) {
        for score in scores.iter().copied().map(f64::from) {
            (self.sum, self.squares, self.n) = (self.sum + score, self.squares + score * score, self.n + 1.0);
        }
    }
}

impl Confidence {
    pub fn new(encoder: &str, scores: Spread) -> Self {
        let fit = if encoder.starts_with("slag-embedded") { EMBEDDED } else { OTHERS };
        let Spread { sum, squares, n } = scores;
        let mean = sum / n.max(1.0);
        let spread = (squares / n.max(1.0) - mean * mean).max(0.0).sqrt().max(MIN_SPREAD);
        Self { fit, mean, spread }
    }

    /// Weight of a word relative to "none of these".
    fn weight(&self, score: f32) -> f64 {
        let z = (f64::from(score) - self.mean) / self.spread;
        // Keeps the sum of thousands of weights finite.
        (self.fit.sharpness * (z - self.fit.none_at)).min(600.0).exp()
    }
}

/// Collects the scores of an object, word by word.
#[derive(Clone, Copy, Debug, Default)]
pub struct Naming {
    /// Best scores and their words, best first; of equal ones the first.
    best: [(f32, u32); MAX_NAMES],
    n: usize,
    sum: f64,
}

impl Naming {
    pub fn add(&mut self, word: u32, score: f32, confidence: &Confidence) {
        self.sum += confidence.weight(score);
        let at = self.best[..self.n].iter().position(|best| best.0 < score).unwrap_or(self.n);
        if at < MAX_NAMES {
            self.n = (self.n + 1).min(MAX_NAMES);
            self.best[at..self.n].rotate_right(1);
            self.best[at] = (score, word);
        }
    }

    /// The best words with their confidences, best first.
    pub fn names(&self, confidence: &Confidence) -> impl Iterator<Item = (u32, f32)> {
        let whole = 1.0 + self.sum;
        let of = move |(score, word): &(f32, u32)| (*word, (confidence.weight(*score) / whole) as f32);
        self.best[..self.n].iter().map(of)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names_of(encoder: &str, scores: &[f32]) -> Vec<(u32, f32)> {
        let (mut naming, mut spread) = (Naming::default(), Spread::default());
        spread.add(scores);
        let confidence = Confidence::new(encoder, spread);
        (0..).zip(scores).for_each(|(word, score)| naming.add(word, *score, &confidence));
        naming.names(&confidence).collect()
    }

    /// By hand: mean 0.3, spread 0.1.
    #[test]
    fn confidences_by_hand() {
        let names = names_of("any", &[0.2, 0.4, 0.2, 0.4]);
        assert_eq!(names.iter().map(|(word, _)| *word).collect::<Vec<_>>(), [1, 3, 0]);
        let [high, low] = [(1.0f64 - 5.0).exp(), (-1.0f64 - 5.0).exp()];
        let whole = 1.0 + 2.0 * high + 2.0 * low;
        for ((_, found), weight) in names.iter().zip([high, high, low]) {
            assert!((f64::from(*found) - weight / whole).abs() < 1e-6, "{found} {weight}");
        }
        assert_eq!(names_of("any", &[]), []);
    }

    /// A word far above all others is nearly sure; otherwise no word is likely.
    #[test]
    fn what_stands_out_is_sure() {
        let mut scores = [0.1f32; 85];
        assert!(names_of("slag-embedded-1", &scores).iter().all(|(_, confidence)| *confidence < 0.02));
        scores[7] = 0.7;
        let names = names_of("slag-embedded-1", &scores);
        assert!(names[0].0 == 7 && names[0].1 > 0.95 && names[1].1 < 0.01, "{names:?}");
        // One clear word among thousands.
        let mut scores = vec![0.0; 10_000];
        scores[0] = 1.0;
        assert!(names_of("any", &scores)[0].1 <= 1.0);
    }

    #[test]
    fn a_model_without_words_names_by_everyday_nouns() {
        assert!(words_of(None).len() > 1600 && words_of(Some(&[])).len() > 1600);
        assert_eq!(words_of(Some(&["mug".to_owned()])), ["mug"]);
    }
}
