//! Encodes query texts: one thread owns the text encoder, and recent vectors are cached.

use std::collections::HashMap;
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use schemars::JsonSchema;
use serde::Serialize;
use slag_common::Hash32;
use slag_models::{InferenceError, ModelDir, ModelError, SessionOptions, TextEncoder};

/// Longest query text; every text model here truncates far below.
pub const MAX_TEXT_BYTES: usize = 512;
/// Texts that may wait for the encoder; at about 30 ms each, more would time out anyway.
const MAX_WAITING: usize = 64;
/// Cached vectors (2 MB at 512 components).
const MAX_CACHED: usize = 1024;

/// Reasons for which a text cannot be encoded.
#[derive(Debug, thiserror::Error)]
pub enum TextError {
    /// The encoder refuses the text, or fails.
    #[error(transparent)]
    Encode(#[from] InferenceError),
    /// Too many texts wait.
    #[error("{MAX_WAITING} texts are already waiting for the text model; ask again in a second")]
    Busy,
    /// The encoder's thread has stopped.
    #[error("the text model has stopped; see the log and restart the program")]
    Stopped,
}

/// Reasons for which a text encoder cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum TextOpenError {
    /// The model does not open.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The thread does not start.
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

/// A text encoder owned by one thread, with a cache of recent vectors.
pub struct TextService {
    info: EncoderInfo,
    vocabulary: Vec<String>,
    jobs: Option<SyncSender<Job>>,
    thread: Option<JoinHandle<()>>,
    cache: Mutex<Cache>,
    has_stopped: AtomicBool,
}

impl TextService {
    /// Opens the text encoder of a model folder.
    pub fn open(models: &ModelDir, options: &SessionOptions) -> Result<Self, TextOpenError> {
        let encoder = models.text_encoder(options)?;
        let execution_provider = encoder.placement().map_or("none", |placement| placement.provider().name());
        let id = models.encoder_id();
        let info =
            EncoderInfo { name: id.name.clone(), id: Hash32(id.hash()), dim: id.dim, execution_provider };
        Ok(Self::start(info, encoder)?)
    }

    /// Starts the thread that owns an encoder.
    ///
    /// # Errors
    /// The thread does not start.
    pub fn start(info: EncoderInfo, encoder: Box<dyn TextEncoder>) -> io::Result<Self> {
        let (jobs, waiting) = sync_channel(MAX_WAITING);
        let vocabulary = encoder.vocabulary().unwrap_or_default().to_vec();
        let thread = std::thread::Builder::new().name("text-model".into()).spawn(|| run(encoder, waiting))?;
        Ok(Self {
            info,
            vocabulary,
            jobs: Some(jobs),
            thread: Some(thread),
            cache: Mutex::default(),
            has_stopped: AtomicBool::new(false),
        })
    }

    /// Returns the encoder in use.
    pub fn info(&self) -> &EncoderInfo {
        &self.info
    }

    /// Returns the phrases or words that it accepts; none if it accepts any text.
    pub fn vocabulary(&self) -> &[String] {
        &self.vocabulary
    }

    /// Returns whether the encoder's thread has answered every request.
    pub fn is_alive(&self) -> bool {
        !self.has_stopped.load(Ordering::Relaxed)
    }

    fn stopped(&self) -> TextError {
        self.has_stopped.store(true, Ordering::Relaxed);
        TextError::Stopped
    }

    /// Returns a text's vector, `[dim]`, unit length. Blocks while other texts are encoded.
    pub fn encode(&self, text: &str) -> Result<Arc<[f32]>, TextError> {
        let key = text.split_whitespace().collect::<Vec<_>>().join(" ");
        if let Some(vector) = self.cache().get(&key) {
            return Ok(vector);
        }
        let (reply, answer) = sync_channel(1);
        let jobs = self.jobs.as_ref().ok_or(TextError::Stopped)?;
        jobs.try_send(Job { text: key.clone(), reply }).map_err(|e| match e {
            TrySendError::Full(_) => TextError::Busy,
            TrySendError::Disconnected(_) => self.stopped(),
        })?;
        let vector: Arc<[f32]> = answer.recv().map_err(|_| self.stopped())??.into();
        self.cache().put(key, Arc::clone(&vector));
        Ok(vector)
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

fn run(mut encoder: Box<dyn TextEncoder>, jobs: Receiver<Job>) {
    for job in jobs {
        // The asker may have given up meanwhile.
        drop(job.reply.send(encoder.encode(&job.text)));
    }
}

/// The vectors of recent texts.
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
    use std::path::Path;

    use slag_test_support::needs_shared;

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

    /// One text more than the queue and the encoder can hold: one of them is refused, at once.
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

    #[test]
    fn built_in_models_open() {
        let options = SessionOptions::new("no-runtime-needed".into());
        let built_in = TextService::open(&ModelDir::colours(), &options).expect("built in");
        assert_eq!(built_in.encode("a red thing").expect("known").len(), built_in.info().dim as usize);
        assert!(matches!(
            built_in.encode("sofa"),
            Err(TextError::Encode(InferenceError::UnknownWords { .. }))
        ));
    }

    #[needs_shared]
    #[test]
    fn described_phrase_lists_open() {
        let options = SessionOptions::new("no-runtime-needed".into());
        let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/models/conse");
        let phrases =
            TextService::open(&ModelDir::open(&models).expect("described"), &options).expect("described");
        let (chair, stool, tree) =
            (phrases.encode("a chair"), phrases.encode("stool"), phrases.encode("tree"));
        let (chair, stool, tree) = (chair.expect("known"), stool.expect("known"), tree.expect("known"));
        let cosine = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
        assert!(
            (cosine(&chair, &chair) - 1.0).abs() < 1e-4 && cosine(&chair, &stool) > cosine(&chair, &tree)
        );
        assert_eq!(phrases.info().execution_provider, "none");
    }

    /// A model that panics stops the service; every later call fails at once.
    #[test]
    fn a_dead_model_is_an_error() {
        let service = TextService::start(Axes::info(2), Box::new(Axes::new(2))).expect("a thread");
        assert!(matches!(service.encode("panic"), Err(TextError::Stopped)));
        assert!(matches!(service.encode("1"), Err(TextError::Stopped)));
        assert!(!service.is_alive());
    }
}
