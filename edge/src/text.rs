//! Encodes query texts: one thread owns the text encoder, and recent vectors are cached.

use std::collections::HashMap;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use schemars::JsonSchema;
use serde::Serialize;
use slag_common::Hash32;
use slag_models::{
    InferenceError, KnownPhrases, ModelDir, ModelError, SessionOptions, TextEncoder, words_to_find,
};

/// Longest query text; every text model here truncates far below.
pub const MAX_TEXT_BYTES: usize = 512;
/// Texts that may wait for the encoder; at about 30 ms each, more would time out.
const MAX_WAITING: usize = 64;
/// Pause between attempts to reopen a text model that panicked.
const REOPEN_PAUSE: Duration = Duration::from_secs(1);
/// Cached vectors (2 MB at 512 components).
const MAX_CACHED: usize = 1024;

#[derive(Debug, thiserror::Error)]
pub enum TextError {
    #[error(transparent)]
    Encode(#[from] InferenceError),
    #[error("{MAX_WAITING} texts are already waiting for the text model; ask again in a second")]
    Busy,
    #[error("the text model has stopped, and starts again by itself if it can; the log has the cause")]
    Stopped,
}

#[derive(Debug, thiserror::Error)]
pub enum TextOpenError {
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error("the text model's thread cannot start: {0}; free memory or raise the process limit")]
    Thread(#[from] io::Error),
}

/// The text encoder in use.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct EncoderInfo {
    /// Name of the embedding space.
    pub name: String,
    /// Its id, as manifests record it.
    pub id: Hash32,
    /// Components of a vector.
    pub dim: u32,
    /// The execution provider actually in use: `cpu`, `cuda` ..., or `none` if no runtime is needed.
    pub execution_provider: &'static str,
}

struct Job {
    text: String,
    reply: SyncSender<Result<Vec<f32>, InferenceError>>,
}

pub struct TextService {
    info: EncoderInfo,
    nouns: Vec<String>,
    known: Option<Arc<KnownPhrases>>,
    jobs: Option<SyncSender<Job>>,
    thread: Option<JoinHandle<()>>,
    cache: Mutex<Cache>,
    /// Whether the encoder runs: false after a panic until it is reopened.
    is_alive: Arc<AtomicBool>,
}

type Reopen = Box<dyn FnMut() -> Result<Box<dyn TextEncoder>, ModelError> + Send>;

impl TextService {
    pub fn open(models: &ModelDir, options: &SessionOptions) -> Result<Self, TextOpenError> {
        let encoder = models.text_encoder(options)?;
        let execution_provider = encoder.placement().map_or("none", |placement| placement.provider().name());
        let id = models.encoder_id();
        let info =
            EncoderInfo { name: id.name.clone(), id: Hash32(id.hash()), dim: id.dim, execution_provider };
        let (models, options) = (models.clone(), options.clone());
        Ok(Self::start_with(info, encoder, Some(Box::new(move || models.text_encoder(&options))))?)
    }

    /// Starts the thread that owns an encoder, without a way to reopen it.
    pub fn start(info: EncoderInfo, encoder: Box<dyn TextEncoder>) -> io::Result<Self> {
        Self::start_with(info, encoder, None)
    }

    fn start_with(
        info: EncoderInfo,
        encoder: Box<dyn TextEncoder>,
        reopen: Option<Reopen>,
    ) -> io::Result<Self> {
        let (jobs, waiting) = sync_channel(MAX_WAITING);
        let nouns = encoder.nouns().unwrap_or_default().to_vec();
        let known = encoder.known_phrases().cloned();
        let is_alive = Arc::new(AtomicBool::new(true));
        let told = Arc::clone(&is_alive);
        let run = move || run(encoder, reopen, &waiting, &told);
        let thread = std::thread::Builder::new().name("text-model".into()).spawn(run)?;
        Ok(Self {
            info,
            nouns,
            known,
            jobs: Some(jobs),
            thread: Some(thread),
            cache: Mutex::default(),
            is_alive,
        })
    }

    pub fn info(&self) -> &EncoderInfo {
        &self.info
    }

    /// Returns the model's own words for naming; empty if everyday nouns serve.
    pub fn nouns(&self) -> &[String] {
        &self.nouns
    }

    /// Returns the replacement of a text with words unknown to the model.
    pub(crate) fn asked_as(&self, text: &str) -> Option<String> {
        self.known.as_ref()?.asked_as(&words_to_find(text).ok()?)
    }

    /// Refuses a text of several things where the model knows few words.
    pub(crate) fn check_one(&self, text: &str) -> Result<(), TextError> {
        Ok(self.known.as_ref().map_or(Ok(()), |known| known.check_one(text))?)
    }

    pub(crate) fn is_alive(&self) -> bool {
        self.is_alive.load(Ordering::Relaxed)
    }

    /// Returns a text's vector, `[dim]`, unit length. Blocks while other texts are encoded.
    pub fn encode(&self, text: &str) -> Result<Arc<[f32]>, TextError> {
        let key = words_to_find(text)?;
        if let Some(vector) = self.cache().get(&key) {
            return Ok(vector);
        }
        let vector: Arc<[f32]> = self.run(key.clone())?.into();
        self.cache().put(key, Arc::clone(&vector));
        Ok(vector)
    }

    /// As [`Self::encode`], without the cache and with its symbols.
    pub(crate) fn run(&self, text: String) -> Result<Vec<f32>, TextError> {
        let (reply, answer) = sync_channel(1);
        let jobs = self.jobs.as_ref().ok_or(TextError::Stopped)?;
        jobs.try_send(Job { text, reply }).map_err(|e| match e {
            TrySendError::Full(_) => TextError::Busy,
            TrySendError::Disconnected(_) => TextError::Stopped,
        })?;
        Ok(answer.recv().map_err(|_| TextError::Stopped)??)
    }

    fn cache(&self) -> std::sync::MutexGuard<'_, Cache> {
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for TextService {
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the text model's thread panicked");
        }
    }
}

/// Encodes texts until all senders are gone. A panicked encoder is reopened; until then `is_alive` is false and
/// callers fail at once.
fn run(
    mut encoder: Box<dyn TextEncoder>,
    mut reopen: Option<Reopen>,
    jobs: &Receiver<Job>,
    is_alive: &AtomicBool,
) {
    while let Ok(Job { text, reply }) = jobs.recv() {
        // State broken by a panic is dropped with the encoder.
        if let Ok(encoded) = catch_unwind(AssertUnwindSafe(|| encoder.encode(&text))) {
            // The caller may have given up.
            drop(reply.send(encoded));
            continue;
        }
        is_alive.store(false, Ordering::Relaxed);
        tracing::error!("the text model panicked");
        drop(reply);
        let Some(reopen) = &mut reopen else { return };
        // Dropping and opening may panic, too.
        let mut broken = Some(encoder);
        encoder = loop {
            match catch_unwind(AssertUnwindSafe(|| {
                drop(broken.take());
                reopen()
            })) {
                Ok(Ok(encoder)) => break encoder,
                Ok(Err(error)) => tracing::error!("the text model does not open again: {error}"),
                Err(_) => tracing::error!("the text model panicked as it was opened again"),
            }
            // Callers in the pause fail when their jobs are dropped.
            match jobs.recv_timeout(REOPEN_PAUSE) {
                Ok(job) => drop(job),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        };
        is_alive.store(true, Ordering::Relaxed);
    }
}

#[derive(Default)]
struct Cache {
    clock: u64,
    entries: HashMap<String, (u64, Arc<[f32]>)>,
}

impl Cache {
    fn get(&mut self, text: &str) -> Option<Arc<[f32]>> {
        self.clock += 1;
        let (used, vector) = self.entries.get_mut(text)?;
        *used = self.clock;
        Some(Arc::clone(vector))
    }

    fn put(&mut self, text: String, vector: Arc<[f32]>) {
        self.clock += 1;
        self.entries.insert(text, (self.clock, vector));
        if self.entries.len() > MAX_CACHED {
            let oldest = self.entries.iter().min_by_key(|(_, (used, _))| *used).map(|(text, _)| text.clone());
            oldest.map(|text| self.entries.remove(&text));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Axes, Gate, axes_service, open_gate};

    #[test]
    fn keeps_vectors_and_survives_refusals() {
        let (service, n_encoded) = axes_service(3, Default::default());
        let first = service.encode("1").expect("known");
        assert_eq!((&*first, &*service.encode("  1 \t").expect("known")), (&[0.0, 1.0, 0.0][..], &*first));
        assert_eq!(n_encoded.load(std::sync::atomic::Ordering::SeqCst), 1);
        assert!(matches!(
            service.encode("sofa"),
            Err(TextError::Encode(InferenceError::UnknownPhrase { .. }))
        ));
        assert!(service.encode("2").is_ok() && service.is_alive());
    }

    #[test]
    fn cache_forgets_what_was_used_longest_ago() {
        let mut cache = Cache::default();
        let vector: Arc<[f32]> = Arc::new([1.0]);
        for i in 0..MAX_CACHED {
            cache.put(i.to_string(), Arc::clone(&vector));
        }
        assert!(cache.get("0").is_some());
        cache.put("new".into(), vector);
        assert_eq!(cache.entries.len(), MAX_CACHED);
        assert!(cache.get("1").is_none() && cache.get("0").is_some() && cache.get("new").is_some());
    }

    /// One text beyond the queue and the encoder: one is refused, at once.
    #[test]
    fn a_full_queue_turns_away() {
        let gate = Gate::default();
        let (service, _) = axes_service(2, Arc::clone(&gate));
        let encode = || {
            let result = service.encode("wait");
            open_gate(&gate);
            matches!(result, Err(TextError::Busy))
        };
        let n_turned_away = std::thread::scope(|scope| {
            let asking: Vec<_> = (0..MAX_WAITING + 2).map(|_| scope.spawn(encode)).collect();
            asking.into_iter().filter_map(|thread| thread.join().ok()).filter(|busy| *busy).count()
        });
        assert!(n_turned_away > 0);
        assert!(service.encode("wait").is_ok());
    }

    /// Symbols beside words are ignored; a text without words is an error.
    #[test]
    fn only_words_count() {
        let (service, n_encoded) = axes_service(3, Default::default());
        for text in ["1", " 1 ?", "\"1\"", "1!!!", "🪑 1", "1🪑", "\u{200b}1\u{feff}", "(1)..", "1 %"] {
            assert_eq!(*service.encode(text).expect(text), [0.0, 1.0, 0.0], "{text}");
        }
        assert_eq!(n_encoded.load(std::sync::atomic::Ordering::SeqCst), 1);
        for text in ["?", "the", "of"] {
            let refused = service.encode(text);
            assert!(matches!(refused, Err(TextError::Encode(InferenceError::EmptyText))), "{text}");
        }
    }

    /// A model that panics is reopened, even if opening it panics at first; meanwhile it is not alive.
    #[test]
    fn a_dead_model_is_opened_again() {
        let (opens, opened) = sync_channel::<bool>(2);
        let reopen: Reopen = Box::new(move || {
            assert!(opened.recv().expect("told"), "it does not open");
            Ok(Box::new(Axes::new(2)))
        });
        let encoder = Box::new(Axes::new(2));
        let service = TextService::start_with(Axes::info(2), encoder, Some(reopen)).expect("a thread");
        assert!(matches!(service.encode("panic"), Err(TextError::Stopped)));
        assert!(!service.is_alive());
        opens.send(false).expect("listens");
        // Dropped in the pause after that.
        assert!(matches!(service.encode("1"), Err(TextError::Stopped)));
        assert!(!service.is_alive());
        opens.send(true).expect("listens");
        assert!(service.encode("1").is_ok() && service.is_alive());
    }
}
