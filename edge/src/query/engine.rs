//! Query engine: a cache and a text model, shared by the HTTP service and the command line.

use std::io;
use std::sync::{Arc, Mutex, OnceLock, PoisonError, RwLock};
use std::time::{Duration, Instant};

use slag_api::objects::OrientedBox;
use slag_common::Hash32;
use slag_common::manifest::{Manifest, TextModelRecord};
use slag_models::{InferenceError, ModelDir, SessionOptions};

use super::names::{Names, Words};
use super::request::{QueryRequest, RequestError, check_text};
use crate::score::{OverBudget, ScoreError};
use crate::store::files::Stat;
use crate::store::{EdgeCache, Snapshot, StoreError};
use crate::text::{EncoderInfo, TextError, TextOpenError, TextService};

/// Retry interval of a failed load while `current` is unchanged: disk full, too many open files.
const RETRY_AFTER: Duration = Duration::from_secs(5);

#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    #[error(transparent)]
    Request(#[from] RequestError),
    #[error(transparent)]
    Text(#[from] TextError),
    #[error("negatives: {0}")]
    Negatives(#[source] TextError),
    #[error("no scene is loaded; run `slag-edge fetch`, or see the log if you have fetched one")]
    NoScene,
    #[error(
        "the text model is {models_name} ({models_id:.12}), the scene's is {scene_name} ({scene_id:.12}); give that to --models, or publish the scene with `slag-encoder encode --text-model`"
    )]
    EncoderMismatch { models_name: String, models_id: Hash32, scene_name: String, scene_id: Hash32 },
    #[error(transparent)]
    Score(#[from] ScoreError),
    /// What is on board has nothing to answer from. `kind` and `title` are stable names.
    #[error("{detail}")]
    Unable { kind: &'static str, title: &'static str, detail: String },
}

impl From<OverBudget> for QueryError {
    fn from(error: OverBudget) -> Self {
        Self::Score(error.into())
    }
}

impl QueryError {
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Request(_) => "bad-parameter",
            Self::Text(error) | Self::Negatives(error) => match error {
                TextError::Encode(InferenceError::EmptyText | InferenceError::SeveralThings(_)) => {
                    "bad-parameter"
                }
                TextError::Busy => "overloaded",
                TextError::Encode(
                    InferenceError::UnknownPhrase { .. } | InferenceError::UnknownWords { .. },
                ) => "unknown-words",
                _ => "text-model",
            },
            Self::NoScene => "no-scene",
            Self::EncoderMismatch { .. } => "encoder-mismatch",
            Self::Score(ScoreError::OverBudget(OverBudget::Together { .. })) => "overloaded",
            Self::Score(ScoreError::OverBudget(_)) => "over-budget",
            Self::Score(_) => "score",
            Self::Unable { kind, .. } => kind,
        }
    }
}

struct Loaded {
    /// That of the generation on board, or of one to come.
    text: Arc<TextService>,
    on_board: Option<Arc<OnBoard>>,
    /// State of `current` at the last attempt to load it.
    tried: Option<Stat>,
    failed_at: Option<Instant>,
}

/// A generation and its text model, replaced together: vectors of one model must not meet another's scene.
pub struct OnBoard {
    pub snapshot: Arc<Snapshot>,
    pub(super) text: Arc<TextService>,
    /// Names of its things, in index order.
    pub(super) names: OnceLock<Names>,
    /// Their oriented boxes.
    pub(super) boxes: OnceLock<Vec<OnceLock<OrientedBox>>>,
}

impl OnBoard {
    fn new(snapshot: Snapshot, text: &Arc<TextService>) -> Arc<Self> {
        let (snapshot, text) = (Arc::new(snapshot), Arc::clone(text));
        Arc::new(Self { snapshot, text, names: OnceLock::new(), boxes: OnceLock::new() })
    }

    /// Checks that text model and scene use the same embedding space.
    pub fn check(&self) -> Result<(), QueryError> {
        let (models, scene) = (self.text.info(), &self.snapshot.manifest.encoder);
        if models.id == scene.id {
            return Ok(());
        }
        Err(QueryError::EncoderMismatch {
            models_name: models.name.clone(),
            models_id: models.id,
            scene_name: scene.name.clone(),
            scene_id: scene.id,
        })
    }

    pub(crate) fn text_is_alive(&self) -> bool {
        self.text.is_alive()
    }

    pub(super) fn encode(&self, text: &str) -> Result<Arc<[f32]>, QueryError> {
        check_text("text", text)?;
        Ok(self.text.encode(text)?)
    }

    pub(super) fn encode_negatives(&self, request: &QueryRequest) -> Result<Vec<Arc<[f32]>>, QueryError> {
        let negatives = request.negatives.0.iter().map(|phrase| self.text.encode(phrase));
        negatives.collect::<Result<_, _>>().map_err(QueryError::Negatives)
    }
}

/// Answers questions from the newest generation of a cache.
pub struct Engine {
    cache: EdgeCache,
    /// Session options for the text models that scenes carry; absent if the text model is given.
    carried: Option<SessionOptions>,
    loaded: RwLock<Loaded>,
    pub(super) words: Mutex<Option<Arc<Words>>>,
}

impl Engine {
    pub fn new(cache: EdgeCache, text: TextService) -> Self {
        let loaded = Loaded { text: Arc::new(text), on_board: None, tried: None, failed_at: None };
        Self { cache, carried: None, loaded: RwLock::new(loaded), words: Mutex::default() }
    }

    /// Makes an engine that uses each scene's own text model if it has one, else that of `otherwise`.
    ///
    /// # Errors
    /// Those of `otherwise`. A carried model that does not open is logged.
    pub(crate) fn with_carried<E>(
        cache: EdgeCache,
        options: SessionOptions,
        otherwise: impl FnOnce() -> Result<TextService, E>,
    ) -> Result<Self, E> {
        let manifest =
            cache.current().ok().flatten().map(|current| cache.read_manifest(current.manifest_hash));
        let opened =
            manifest.and_then(Result::ok).and_then(|manifest| open_carried(&cache, &manifest, &options));
        let text = opened.map_or_else(otherwise, Ok)?;
        Ok(Self { carried: Some(options), ..Self::new(cache, text) })
    }

    pub fn cache(&self) -> &EdgeCache {
        &self.cache
    }

    pub fn encoder(&self) -> EncoderInfo {
        self.text().info().clone()
    }

    fn text(&self) -> Arc<TextService> {
        Arc::clone(&self.loaded.read().unwrap_or_else(PoisonError::into_inner).text)
    }

    /// Returns whether the cache's `current` differs from the loaded one (one `stat`), or a load is to be retried.
    pub(crate) fn is_stale(&self) -> bool {
        let loaded = self.loaded.read().unwrap_or_else(PoisonError::into_inner);
        let retry = loaded.failed_at.is_some_and(|at| at.elapsed() >= RETRY_AFTER);
        retry || self.cache.current_stat().is_ok_and(|stat| stat != loaded.tried)
    }

    /// Opens the cache's current generation, with the text model it carries, and makes it current; questions in
    /// progress keep theirs. If opening fails, the previous one stays in use.
    pub fn reload(&self) -> Result<(), StoreError> {
        let tried = self.cache.current_stat().ok().flatten();
        let before = self.snapshot().ok();
        let opened = Snapshot::open_after(&self.cache, before.as_deref());
        drop(before);
        let in_use = self.text();
        let text = match (&self.carried, &opened) {
            (Some(options), Ok(snapshot)) if snapshot.manifest.encoder.id != in_use.info().id => {
                open_carried(&self.cache, &snapshot.manifest, options).map_or(in_use, Arc::new)
            }
            _ => in_use,
        };
        let mut loaded = self.loaded.write().unwrap_or_else(PoisonError::into_inner);
        match opened {
            Ok(snapshot) => {
                let (tried, failed_at) = (snapshot.current_stat, snapshot.may_recover.then(Instant::now));
                let on_board = Some(OnBoard::new(snapshot, &text));
                let fresh = Loaded { text, on_board, tried, failed_at };
                let before = std::mem::replace(&mut *loaded, fresh);
                // Unmapping many shards takes a while; others must not wait for the lock.
                drop(loaded);
                drop(before);
                Ok(())
            }
            Err(error) => {
                loaded.tried = tried;
                // An empty cache does not fill by itself.
                loaded.failed_at = (!matches!(error, StoreError::Empty { .. })).then(Instant::now);
                Err(error)
            }
        }
    }

    pub fn snapshot(&self) -> Result<Arc<Snapshot>, QueryError> {
        self.on_board().map(|on_board| Arc::clone(&on_board.snapshot))
    }

    /// Returns the loaded generation and the text model that came into use with it.
    pub fn on_board(&self) -> Result<Arc<OnBoard>, QueryError> {
        let loaded = self.loaded.read().unwrap_or_else(PoisonError::into_inner);
        loaded.on_board.clone().ok_or(QueryError::NoScene)
    }
}

/// Longest description read; those of public models take two thousand bytes.
const MAX_DESCRIPTION_BYTES: u64 = 1 << 20;

/// Opens the text model that a scene carries, if it does; failure is logged.
fn open_carried(cache: &EdgeCache, manifest: &Manifest, options: &SessionOptions) -> Option<TextService> {
    let record = manifest.encoder.text_model.as_ref()?;
    let expected = record.description.hash;
    let path = cache.shard_path(expected);
    let failed = |is_damaged: bool, error: &(dyn std::error::Error + 'static)| {
        if is_damaged {
            mark_damaged(cache, record);
        }
        tracing::warn!("the scene's text model does not open: {}", crate::error_line(error));
    };
    let read = cache.files().read(&path, MAX_DESCRIPTION_BYTES).map_err(StoreError::from);
    let read = read.and_then(|bytes| StoreError::check_hash(&path, expected, &bytes).map(|()| bytes));
    let bytes = read.inspect_err(|e| failed(e.is_damage(), e)).ok()?;
    let folder = path.parent().unwrap_or(cache.dir());
    let opened = ModelDir::carried(&bytes, &path, folder)
        .map_err(TextOpenError::Model)
        .and_then(|models| TextService::open(&models, options));
    let advice = |cause: TextOpenError| {
        let is_damaged = matches!(cause, TextOpenError::Model(_));
        let (path, cause) = (path.display(), crate::error_line(&cause));
        let told = format!("{path}: {cause}; fetch again, which replaces what is damaged");
        failed(is_damaged, &io::Error::other(told));
    };
    opened.map_err(advice).ok()
}

/// Marks the files that differ from the record; the next fetch downloads them again.
fn mark_damaged(cache: &EdgeCache, record: &TextModelRecord) {
    for object in record.objects() {
        let read = cache.files().read(&cache.shard_path(object.hash), object.len_bytes);
        if !read.is_ok_and(|bytes| Hash32::of(&bytes) == object.hash) {
            cache.mark_damaged(object.hash);
        }
    }
}
