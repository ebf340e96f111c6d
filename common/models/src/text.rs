//! Text encoders in ONNX: a `tokenizer.json`, then the model.

use std::path::PathBuf;
use std::sync::Arc;

use ort::value::TensorElementType;
use tokenizers::Tokenizer;

use crate::{
    InferenceError, ModelError, ModelFile, TextEncoder,
    clean::clean,
    description::OnnxText,
    encoder::normalise,
    placement::Placement,
    session::{Model, SessionOptions},
    synonyms::KnownPhrases,
};

#[derive(Debug)]
pub struct Tokens {
    path: PathBuf,
    tokenizer: Tokenizer,
    max_tokens: usize,
    end_token_id: Option<u32>,
}

impl Tokens {
    /// Reads `tokenizer.json`; a text becomes at most `max_tokens` ids, the last of them `end_token_id` if given.
    pub fn open(
        file: &ModelFile,
        max_tokens: usize,
        end_token_id: impl Into<Option<u32>>,
    ) -> Result<Self, ModelError> {
        let end_token_id = end_token_id.into();
        let bytes = file.read().map_err(|cause| ModelError::unreadable(&cause))?;
        let unfit = |fault| ModelError::at(&file.path, format_args!("{fault}; fetch tokenizer.json again"));
        let mut tokenizer = Tokenizer::from_bytes(bytes).map_err(unfit)?;
        // Padding and truncation are done here, alike for every file.
        tokenizer.with_padding(None);
        tokenizer.with_truncation(None).map_err(unfit)?;
        let tokens = Self { path: file.path.clone(), tokenizer, max_tokens, end_token_id };
        let found = tokens.raw_ids("")?.last().copied();
        match end_token_id {
            Some(expected) if found != Some(expected) => {
                let fault = format!(
                    "texts end in token {found:?}, but the model's end token is {expected}; use the model's own \
                     tokenizer"
                );
                Err(ModelError::at(&file.path, fault))
            }
            _ => Ok(tokens),
        }
    }

    /// Largest id of a text, without added tokens, which need not occur.
    fn largest_id(&self) -> u32 {
        self.tokenizer.get_vocab(false).into_values().max().unwrap_or(0)
    }

    fn raw_ids(&self, text: &str) -> Result<Vec<u32>, ModelError> {
        let encoding = self.tokenizer.encode_fast(text, true);
        let unfit = |fault| ModelError::at(&self.path, format_args!("{fault}; use other words"));
        Ok(encoding.map_err(unfit)?.get_ids().to_vec())
    }

    /// Ids of `text`, without a prompt, up to and including the first end token.
    ///
    /// A text that is too long is truncated before the end token. CLIP's attention is causal and its vector is
    /// read at the first end token, so later padding would have no effect.
    pub fn ids(&self, text: &str) -> Result<Vec<u32>, ModelError> {
        let mut ids = self.raw_ids(text)?;
        ids.truncate(self.max_tokens);
        let Some(end_token_id) = self.end_token_id else { return Ok(ids) };
        match ids.iter().position(|&id| id == end_token_id) {
            Some(end) => ids.truncate(end + 1),
            None => {
                ids.truncate(self.max_tokens - 1);
                ids.push(end_token_id);
            }
        }
        Ok(ids)
    }
}

#[derive(Debug)]
pub struct OnnxTextEncoder {
    name: String,
    dim: usize,
    model: Model,
    tokens: Tokens,
    description: OnnxText,
    output: String,
    /// Ids and mask are i32 instead of i64.
    is_i32: bool,
    /// Subtracted from the unit vector, `[dim]`.
    centre: Option<Vec<f32>>,
    /// The words of a model that does not know all.
    nouns: Option<Vec<String>>,
    known: Option<Arc<KnownPhrases>>,
}

impl OnnxTextEncoder {
    /// `dim`: components of a vector; `centre`: `[dim]`. Runs a text with the tokenizer's largest id, to detect a
    /// tokenizer of another model at once.
    pub fn open(
        name: &str,
        dim: usize,
        [model, tokenizer]: [&ModelFile; 2],
        description: &OnnxText,
        centre: Option<Vec<f32>>,
        options: &SessionOptions,
    ) -> Result<Self, ModelError> {
        let tokens = Tokens::open(tokenizer, usize::from(description.max_tokens), description.end_token_id)?;
        let model = Model::open(model, options)?;
        let is_i32 = model.input_element(&description.input_ids) == Some(TensorElementType::Int32);
        let id = if is_i32 { TensorElementType::Int32 } else { TensorElementType::Int64 };
        let n_tokens = description.padding.map_or(-1, |padding| i64::from(padding.n_tokens));
        let names: Vec<&str> = [Some(&description.input_ids), description.attention_mask.as_ref()]
            .into_iter()
            .flatten()
            .map(|name| &**name)
            .collect();
        for name in &names {
            let slot = model.expect_input(*name, id, &[1, n_tokens])?;
            if description.padding.is_none() && slot.shape[1] != -1 {
                return Err(model.fixed_tokens(&slot));
            }
        }
        model.expect_no_input_but(&names)?;
        let output = model
            .expect_output(description.output.as_deref(), TensorElementType::Float32, &[1, dim as i64])?
            .name;
        let (name, description) = (name.to_owned(), description.clone());
        let mut encoder =
            Self { name, dim, model, tokens, description, output, is_i32, centre, nouns: None, known: None };
        let largest = encoder.tokens.largest_id();
        let end = encoder.description.end_token_id.unwrap_or(0);
        match encoder.run(&[largest, end]) {
            Ok(_) => Ok(encoder),
            Err(cause) if encoder.run(&[end, end]).is_ok() => {
                let fault = format!(
                    "has token ids up to {largest}, which the model does not accept ({cause}); use the model's own \
                     tokenizer"
                );
                Err(ModelError::at(&tokenizer.path, fault))
            }
            Err(cause) => Err(cause),
        }
    }

    /// Sets the known words: `nouns` name objects, `kinds` several sorts of objects. By default all are known.
    pub(crate) fn with_words<'a>(
        self,
        nouns: impl Iterator<Item = &'a str>,
        kinds: impl Iterator<Item = &'a str>,
    ) -> Self {
        let nouns: Vec<String> = nouns.map(str::to_owned).collect();
        let words = nouns.iter().cloned().chain(kinds.map(str::to_owned));
        let known = Arc::new(KnownPhrases::new(words, false));
        Self { nouns: Some(nouns), known: Some(known), ..self }
    }

    /// Returns the vector of token ids, `[dim]`.
    fn run(&mut self, ids: &[u32]) -> Result<Vec<f32>, ModelError> {
        let (n_real, padding) = (ids.len(), self.description.padding);
        let n_tokens = padding.map_or(n_real, |padding| usize::from(padding.n_tokens));
        let filler = padding.map_or(0, |padding| padding.token_id);
        let ids = ids.iter().copied().chain(std::iter::repeat(filler)).take(n_tokens);
        let mask = (0..n_tokens).map(|i| u32::from(i < n_real));
        let shape = vec![1, n_tokens as i64];
        let ids = self.model.integers(shape.clone(), ids, self.is_i32)?;
        let mut inputs = vec![(self.description.input_ids.as_str(), ids)];
        if let Some(name) = &self.description.attention_mask {
            inputs.push((name, self.model.integers(shape, mask, self.is_i32)?));
        }
        self.model.run(inputs, &self.output, &[1, self.dim as i64])
    }
}

impl TextEncoder for OnnxTextEncoder {
    fn dim(&self) -> usize {
        self.dim
    }

    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError> {
        let text = clean(text);
        if text.is_empty() {
            return Err(InferenceError::EmptyText);
        }
        let text = self.known.as_ref().and_then(|known| known.asked_as(&text)).unwrap_or(text);
        let mut prompt = self.description.prompt.replace("{}", &text);
        if self.description.lowercase {
            prompt = prompt.to_lowercase();
        }
        let ids = self.tokens.ids(&prompt)?;
        let mut vector = self.run(&ids)?;
        if centred(&mut vector, self.centre.as_deref()) {
            Ok(vector)
        } else {
            Err(InferenceError::NoDirection { model: self.name.clone(), index: 0 })
        }
    }

    fn known_phrases(&self) -> Option<&Arc<KnownPhrases>> {
        self.known.as_ref()
    }

    fn nouns(&self) -> Option<&[String]> {
        self.nouns.as_deref()
    }

    fn placement(&self) -> Option<&Placement> {
        Some(&self.model.placement)
    }
}

/// Replaces v by normalize(normalize(v) - centre), both `[dim]`; returns false if that is zero or not finite.
pub(crate) fn centred(vector: &mut [f32], centre: Option<&[f32]>) -> bool {
    if !normalise(vector) {
        return false;
    }
    match centre {
        None => true,
        Some(centre) => {
            vector.iter_mut().zip(centre).for_each(|(x, mean)| *x -= mean);
            normalise(vector)
        }
    }
}
