//! What a thing is called: the words that it scores best for, each with the chance that it is right.
//!
//! A score s stands z = (s - mean) / spread above the scores of all words and things of a scene, which makes models
//! comparable. The confidence of a word is a softmax over all words and "none of these":
//! exp(a z) / (exp(a c) + sum of exp(a z') over all words z').

use crate::everyday_nouns;

pub const MAX_NAMES: usize = 3;
/// Most words that things are named by: lists of phrases for people are shorter.
const MAX_WORDS: usize = 4096;
/// Least spread of scores: a smaller one says that nothing was measured.
const MIN_SPREAD: f64 = 1e-3;

#[derive(Clone, Copy, Debug)]
struct Fit {
    sharpness: f64,
    none_at: f64,
}

/// The likeliest for the names of things in two generated houses, with true and automatic masks: the model's 85 words
/// are what is generated.
const EMBEDDED: Fit = Fit { sharpness: 1.5, none_at: 1.0 };
/// The likeliest for ConSE's names of the things of house_a, with true and automatic masks. Other models were not
/// measured: none could be had.
const OTHERS: Fit = Fit { sharpness: 1.0, none_at: 5.0 };

/// Returns the words that things are named by: a model's own, or everyday nouns.
pub fn words_of(vocabulary: Option<&[String]>) -> Vec<String> {
    match vocabulary {
        None | Some([]) => everyday_nouns().map(str::to_owned).collect(),
        Some(own) => own.iter().take(MAX_WORDS).cloned().collect(),
    }
}

/// How the scores of a scene's things become confidences.
#[derive(Clone, Copy, Debug)]
pub struct Confidence {
    fit: Fit,
    mean: f64,
    spread: f64,
}

/// Measures the scores of all words and things of a scene, or of as many as represent them.
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

    /// Returns the weight of a word beside 1 for "none of these".
    fn weight(&self, score: f32) -> f64 {
        let z = (f64::from(score) - self.mean) / self.spread;
        // Thousands of such weights have a finite sum.
        (self.fit.sharpness * (z - self.fit.none_at)).min(600.0).exp()
    }
}

/// Collects the scores of a thing, word by word.
#[derive(Clone, Copy, Debug, Default)]
pub struct Naming {
    /// The best scores and their words, best first; of equal ones the first.
    best: [(f32, u32); MAX_NAMES],
    n: usize,
    /// Sum of the weights of all words.
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

    /// Returns the best words with their confidences, best first.
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

    /// A word far above all others is nearly sure; where none stands out, no word is likely.
    #[test]
    fn what_stands_out_is_sure() {
        let mut scores = [0.1f32; 85];
        assert!(names_of("slag-embedded-1", &scores).iter().all(|(_, confidence)| *confidence < 0.02));
        scores[7] = 0.7;
        let names = names_of("slag-embedded-1", &scores);
        assert!(names[0].0 == 7 && names[0].1 > 0.95 && names[1].1 < 0.01, "{names:?}");
        // One word for thousands of things.
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
