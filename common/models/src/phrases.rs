//! A text encoder of fixed phrases with given vectors; needs no ONNX Runtime.

use std::{collections::HashMap, path::Path, sync::Arc};

use crate::description::read_text;

use crate::encoder::TextEncoder;
use crate::error::{InferenceError, ModelError};
use crate::synonyms::{KnownPhrases, key, singulars, without_hyphens};
use crate::{tensors, text::centred};

const N_NEAR: usize = 5;

/// Longer texts are sentences, not misspelt phrases, and get no suggestions.
const LONGEST_COMPARED: usize = 100;

#[derive(Debug)]
pub struct PhraseEncoder {
    dim: usize,
    phrases: Vec<String>,
    index_of_key: HashMap<String, usize>,
    known: Arc<KnownPhrases>,
    /// `[phrases][dim]`, centred unit vectors.
    vectors: Vec<f32>,
}

impl PhraseEncoder {
    /// Reads phrases, one per line, and their vectors, (file, tensor) `[phrases][dim]`; `centre`: `[dim]`. Of
    /// equal phrases the first counts.
    pub fn open(
        dim: usize,
        phrases: &Path,
        (vectors, tensor): (&Path, &str),
        centre: Option<Vec<f32>>,
    ) -> Result<Self, ModelError> {
        let text = read_text(phrases)?;
        let unfit =
            |index: usize, fault: String| ModelError::at(phrases, format_args!("line {}{fault}", index + 1));
        let lines: Vec<String> = text.lines().map(str::to_owned).collect();
        let mut index_of_key = HashMap::new();
        for (index, phrase) in lines.iter().enumerate() {
            let key = key(phrase);
            if key.is_empty() {
                return Err(unfit(index, " is empty; the list needs one phrase a line".into()));
            }
            index_of_key.entry(key).or_insert(index);
        }
        for (index, phrase) in lines.iter().enumerate() {
            for other in other_keys(&key(phrase)) {
                index_of_key.entry(other).or_insert(index);
            }
        }
        let mut vectors = tensors::read(vectors, tensor, Some(lines.len()), dim)?;
        for (index, vector) in vectors.chunks_exact_mut(dim).enumerate() {
            if !centred(vector, centre.as_deref()) {
                let phrase = &lines[index];
                let fault = format!(": the vector of {phrase:?} is zero after centring; remove the phrase");
                return Err(unfit(index, fault));
            }
        }
        let known = Arc::new(KnownPhrases::new(index_of_key.keys().cloned(), true));
        Ok(Self { dim, phrases: lines, index_of_key, known, vectors })
    }

    /// Returns the index of a phrase, also for its plural.
    fn find(&self, key: &str) -> Option<usize> {
        let spaced = without_hyphens(key);
        let mut keys = [key.to_owned(), spaced.clone()].into_iter().chain(singulars(&spaced));
        keys.find_map(|key| self.index_of_key.get(&key).copied())
    }

    /// Known phrases within a few edits of `key`, or with a word in common.
    fn near(&self, key: &str) -> Vec<String> {
        let letters: Vec<char> = key.chars().collect();
        if letters.len() > LONGEST_COMPARED {
            return Vec::new();
        }
        let is_start = |a: &str, b: &str| a.len() >= 3 && b.starts_with(a);
        let mut near: Vec<(usize, usize)> = self
            .phrases
            .iter()
            .enumerate()
            .filter_map(|(index, phrase)| {
                let other: Vec<char> = phrase.to_lowercase().chars().collect();
                // Among phrases that share a word, shorter ones rank first.
                let shares_a_word = key
                    .split(' ')
                    .any(|w| phrase.split_whitespace().any(|p| p == w || is_start(w, p) || is_start(p, w)));
                let allowed = letters.len() / 4 + 1;
                let distance = (letters.len().abs_diff(other.len()) <= allowed)
                    .then(|| strsim::generic_levenshtein(&letters, &other))
                    .filter(|&d| d <= allowed);
                distance
                    .or_else(|| shares_a_word.then(|| allowed + 1 + phrase.matches(' ').count()))
                    .map(|d| (d, index))
            })
            .collect();
        near.sort_unstable();
        near.into_iter().take(N_NEAR).map(|(_, index)| self.phrases[index].clone()).collect()
    }
}

impl TextEncoder for PhraseEncoder {
    fn dim(&self) -> usize {
        self.dim
    }

    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError> {
        let key = key(text);
        if key.is_empty() {
            return Err(InferenceError::EmptyText);
        }
        match self.find(&key).or_else(|| self.find(&self.known.asked_as(&key)?)) {
            Some(index) => Ok(self.vectors[index * self.dim..][..self.dim].to_vec()),
            None => Err(InferenceError::UnknownPhrase {
                n_known: self.phrases.len(),
                near: self.near(&key),
                text: key,
            }),
        }
    }

    fn known_phrases(&self) -> Option<&Arc<KnownPhrases>> {
        Some(&self.known)
    }

    fn vocabulary(&self) -> Option<&[String]> {
        Some(&self.phrases)
    }
}

/// Other names in a phrase: `barrel` and `bucket` for `barrel/bucket`, `tractor` for `tractor (farm equipment)`.
fn other_keys(key: &str) -> impl Iterator<Item = String> {
    let bare = key.split(" (").next().unwrap_or(key);
    [key, bare].into_iter().chain(bare.split('/')).map(|key| without_hyphens(key.trim()))
}
