//! Names of the things on board. Words are encoded once per text model and scored once per generation.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use slag_api::objects::Name;
use slag_common::Hash32;
use slag_models::names::{Confidence, Naming, Spread, words_of};

use super::scene::Scene;
use crate::score::{Budget, Question, ScoreError, score_objects};
use crate::store::EdgeCache;
use crate::store::words::{self, WordVector};
use crate::text::{TextError, TextService};

/// Words scored at a time: bounds the scores in memory.
const WORDS_TOGETHER: usize = 16;
/// Scores are measured over one in so many words.
const MEASURED: usize = 4;
/// Pause after the text model refused a word.
const BUSY_PAUSE: Duration = Duration::from_millis(100);
/// Words encoded faster are not kept on disk.
const WORTH_KEEPING: Duration = Duration::from_secs(2);

pub struct Names {
    words: Arc<[WordVector]>,
    /// By object, in index order: words and confidences, best first.
    of_object: Vec<Vec<(u32, f32)>>,
}

impl Names {
    /// Returns the words of an object with their confidences, best first.
    pub fn of(&self, object: usize) -> impl ExactSizeIterator<Item = (&str, f32)> {
        self.of_object[object].iter().map(|(word, confidence)| (&*self.words[*word as usize].0, *confidence))
    }

    pub fn describe(&self, object: usize) -> Vec<Name> {
        let digits = |confidence: f32| (f64::from(confidence) * 1e4).round() / 1e4;
        self.of(object).map(|(name, of)| Name { name: name.to_owned(), confidence: digits(of) }).collect()
    }

    pub fn len(&self) -> usize {
        self.of_object.len()
    }

    pub fn new(words: Arc<[WordVector]>, scene: &Scene<'_>, budget: &Budget) -> Result<Self, ScoreError> {
        let n_objects = scene.index.len();
        let scores_bytes = WORDS_TOGETHER * size_of::<f32>();
        budget.take(n_objects * (size_of::<Naming>() + size_of::<Vec<(u32, f32)>>() + scores_bytes));
        let mut of_object = vec![Naming::default(); n_objects];
        let together = || (0..).step_by(WORDS_TOGETHER).zip(words.chunks(WORDS_TOGETHER));
        let scores = |together: &[WordVector]| {
            budget.check()?;
            let question = |(_, vector): &WordVector| Question::new(Arc::clone(vector));
            let questions: Vec<Question> = together.iter().map(question).collect();
            score_objects(&scene.shards, &scene.objects, scene.index, &questions)
        };
        let mut spread = Spread::default();
        for (_, words) in together().step_by(MEASURED) {
            scores(words)?.iter().for_each(|scored| spread.add(&scored.scores));
        }
        let confidence = Confidence::new(&scene.manifest.encoder.name, spread);
        for (first, words) in together() {
            for (word, scored) in (first..).zip(&scores(words)?) {
                let scores = of_object.iter_mut().zip(&scored.scores);
                scores.for_each(|(naming, score)| naming.add(word, *score, &confidence));
            }
        }
        let of_object = of_object.iter().map(|naming| naming.names(&confidence).collect()).collect();
        Ok(Self { words, of_object })
    }
}

/// Words for naming things, possibly still being encoded.
pub struct Words {
    encoder_id: Hash32,
    state: Mutex<Progress>,
    is_over: Condvar,
}

#[derive(Clone)]
enum Progress {
    Encoding,
    Ready(Arc<[WordVector]>),
    /// The text model stopped.
    Failed,
}

impl Words {
    /// Starts encoding a text model's words on a separate thread.
    pub fn begin(cache: &EdgeCache, text: &Arc<TextService>) -> Arc<Self> {
        let (state, is_over) = (Mutex::new(Progress::Encoding), Condvar::new());
        let words = Arc::new(Self { encoder_id: text.info().id, state, is_over });
        let (cache, text, encoding) = (cache.clone(), Arc::clone(text), Arc::clone(&words));
        let encode = move || encoding.become_ready(encode(&cache, &text));
        if let Err(error) = std::thread::Builder::new().name("words".into()).spawn(encode) {
            tracing::warn!("the words that things are named by cannot be encoded: {error}");
            words.become_ready(None);
        }
        words
    }

    pub fn are_of(&self, encoder_id: Hash32) -> bool {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        self.encoder_id == encoder_id && !matches!(*state, Progress::Failed)
    }

    /// Waits for the words; `None` on timeout.
    pub fn wait(&self, longest: Duration) -> Option<Arc<[WordVector]>> {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let waiting = |state: &mut Progress| matches!(state, Progress::Encoding);
        let waited = self.is_over.wait_timeout_while(state, longest, waiting);
        match &*waited.unwrap_or_else(PoisonError::into_inner).0 {
            Progress::Ready(words) => Some(Arc::clone(words)),
            Progress::Encoding | Progress::Failed => None,
        }
    }

    fn become_ready(&self, words: Option<Vec<WordVector>>) {
        let state = words.map_or(Progress::Failed, |words| Progress::Ready(words.into()));
        *self.state.lock().unwrap_or_else(PoisonError::into_inner) = state;
        self.is_over.notify_all();
    }
}

/// Encodes the words that a text model knows, or reads them from disk.
fn encode(cache: &EdgeCache, text: &TextService) -> Option<Vec<WordVector>> {
    let nouns = Some(text.nouns()).filter(|nouns| !nouns.is_empty());
    let (asked, info) = (words_of(nouns), text.info());
    if let Some(kept) = words::read(cache, info.id, info.dim as usize, &asked) {
        return Some(kept);
    }
    let (started, mut known) = (Instant::now(), Vec::new());
    for word in &asked {
        let vector = loop {
            match text.run(word.clone()) {
                Err(TextError::Busy) => std::thread::sleep(BUSY_PAUSE),
                other => break other,
            }
        };
        match vector {
            Ok(vector) => known.push((word.clone(), vector.into())),
            Err(TextError::Encode(_)) => {}
            Err(_) => return None,
        }
    }
    if started.elapsed() >= WORTH_KEEPING
        && let Err(error) = words::write(cache, info.id, &asked, &known)
    {
        tracing::warn!("the words that things are named by are encoded again next time: {error}");
    }
    Some(known)
}
