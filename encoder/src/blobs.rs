//! A bucket: a shared folder or an object store, with conditional puts.
//!
//! Keys are relative to the URL's prefix. All calls block; never call them from the bucket's own runtime threads.

use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use futures_util::TryStreamExt;
use object_store::client::{HttpError, HttpErrorKind};
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions};
use reqwest::Url;
use tokio::runtime::{Builder, Runtime};

/// Threads that wait for the network.
const N_THREADS: usize = 2;
/// How long a broken-off request is retried, and the pause between tries.
const PATIENCE: Duration = Duration::from_secs(60);
const RETRY_PAUSE: Duration = Duration::from_millis(300);

#[derive(Debug, thiserror::Error)]
pub enum BlobError {
    /// A message that says what to do.
    #[error("{0}")]
    Failed(String),
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

#[derive(Clone, Debug)]
pub(crate) struct Bucket {
    store: Arc<dyn ObjectStore>,
    prefix: Key,
    pub(crate) url: String,
    /// Whether it is a folder, which answers at once.
    pub(crate) is_local: bool,
    pub(crate) runtime: Arc<Runtime>,
}

impl Bucket {
    /// Opens a bucket by URL or path of a folder. `variables`: the environment, with the credentials of object stores.
    ///
    /// # Errors
    /// [`BlobError`] for a wrong address; the bucket itself is first asked by a request.
    pub(crate) fn open(
        address: &str,
        variables: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Self, BlobError> {
        let refuse = |problem: String| {
            BlobError::Failed(format!(
                "{address}: {problem}; expected file:///FOLDER, s3://BUCKET/PREFIX, or gs:// and az:// where the program was \
                 built with them"
            ))
        };
        // Other users of TLS install it, too; only the first counts.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let runtime = Builder::new_multi_thread().worker_threads(N_THREADS).enable_all().build()?;
        let runtime = Arc::new(runtime);
        let folder = match address.strip_prefix("file://") {
            Some(path) => Some(PathBuf::from(path)),
            None if address.contains("://") => None,
            None => Some(std::path::absolute(address)?),
        };
        if let Some(folder) = folder {
            if !folder.is_absolute() {
                return Err(refuse("the path is not absolute".into()));
            }
            fs_err::create_dir_all(&folder)?;
            let store = LocalFileSystem::new_with_prefix(&folder).map_err(|e| refuse(e.to_string()))?;
            let store: Arc<dyn ObjectStore> = Arc::new(store.with_fsync(true));
            let url = format!("file://{}", folder.display());
            return Ok(Self { store, prefix: Key::default(), url, is_local: true, runtime });
        }
        let url = Url::parse(address).map_err(|e| refuse(e.to_string()))?;
        let (store, prefix) =
            object_store::parse_url_opts(&url, variables).map_err(|e| refuse(e.to_string()))?;
        let url = address.trim_end_matches('/').to_owned();
        Ok(Self { store: Arc::from(store), prefix, url, is_local: false, runtime })
    }

    fn ask<T, F>(&self, request: impl Fn() -> F) -> object_store::Result<T>
    where
        F: Future<Output = object_store::Result<T>>,
    {
        self.runtime.block_on(answered(request))
    }

    fn key(&self, key: &str) -> Key {
        self.prefix.parts().chain(Key::from(key).parts()).map(|part| part.as_ref().to_owned()).collect()
    }

    fn failed(&self, key: &str, source: object_store::Error) -> BlobError {
        BlobError::Failed(format!(
            "{}/{key}: {source}; check the address, the credentials (for S3 AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, \
             AWS_REGION, AWS_ENDPOINT) and the free space",
            self.url
        ))
    }

    pub(crate) fn get(&self, key: &str) -> Result<Option<Bytes>, BlobError> {
        let at = self.key(key);
        self.if_there(key, self.ask(|| async { self.store.get(&at).await?.bytes().await }))
    }

    pub(crate) fn require(&self, key: &str) -> Result<Bytes, BlobError> {
        let missing =
            || format!("{}/{key} is missing; was the prefix emptied while it was in use?", self.url);
        self.get(key)?.ok_or_else(|| BlobError::Failed(missing()))
    }

    pub(crate) fn len_of(&self, key: &str) -> Result<Option<u64>, BlobError> {
        let at = self.key(key);
        Ok(self.if_there(key, self.ask(|| self.store.head(&at)))?.map(|found| found.size))
    }

    fn if_there<T>(&self, key: &str, answer: object_store::Result<T>) -> Result<Option<T>, BlobError> {
        match answer {
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            answer => answer.map(Some).map_err(|source| self.failed(key, source)),
        }
    }

    fn put_with(&self, key: &str, bytes: Bytes, mode: PutMode) -> Result<bool, BlobError> {
        let options = PutOptions { mode, ..PutOptions::default() };
        let at = self.key(key);
        match self.ask(|| self.store.put_opts(&at, bytes.clone().into(), options.clone())) {
            Ok(_) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. } | object_store::Error::Precondition { .. }) => {
                Ok(false)
            }
            Err(source) => Err(self.failed(key, source)),
        }
    }

    /// Puts an object unless it exists; returns whether it did not. If the answer is lost, the retry may find the
    /// caller's own object; where it matters who put it, use [`Self::claim`].
    pub(crate) fn put_new(&self, key: &str, bytes: impl Into<Bytes>) -> Result<bool, BlobError> {
        self.put_with(key, bytes.into(), PutMode::Create)
    }

    /// Puts an object unless it exists; returns whether the stored one has these bytes, which only the caller puts.
    pub(crate) fn claim(&self, key: &str, bytes: impl Into<Bytes>) -> Result<bool, BlobError> {
        let bytes = bytes.into();
        Ok(self.put_new(key, bytes.clone())? || self.require(key)? == bytes)
    }

    pub(crate) fn put(&self, key: &str, bytes: impl Into<Bytes>) -> Result<(), BlobError> {
        self.put_with(key, bytes.into(), PutMode::Overwrite).map(drop)
    }

    /// Names of the objects in a folder, without the folder's name, ascending.
    pub(crate) fn list(&self, folder: &str) -> Result<Vec<String>, BlobError> {
        let at = self.key(folder);
        let listed = self.ask(|| self.store.list(Some(&at)).try_collect::<Vec<_>>());
        let listed = listed.map_err(|source| self.failed(folder, source))?;
        let name = |meta: &object_store::ObjectMeta| {
            let rest = meta.location.prefix_match(&at)?;
            Some(rest.map(|part| part.as_ref().to_owned()).collect::<Vec<_>>().join("/"))
        };
        let mut names: Vec<String> = listed.iter().filter_map(name).collect();
        names.sort_unstable();
        Ok(names)
    }
}

/// Makes a request, and repeats it if the connection breaks. The client does so itself except for a conditional put,
/// which may find its own object: see [`Bucket::claim`].
async fn answered<T, F>(request: impl Fn() -> F) -> object_store::Result<T>
where
    F: Future<Output = object_store::Result<T>>,
{
    let since = Instant::now();
    loop {
        match request().await {
            Err(error) if is_broken_off(&error) && since.elapsed() < PATIENCE => {
                tracing::info!("{error}; the request is made again");
                tokio::time::sleep(RETRY_PAUSE).await;
            }
            answer => return answer,
        }
    }
}

/// Returns whether the request may have reached the server, or its answer was cut off.
fn is_broken_off(error: &object_store::Error) -> bool {
    use HttpErrorKind::{Decode, Interrupted, Request, Timeout};
    let first: &(dyn Error + 'static) = error;
    let http = std::iter::successors(Some(first), |cause| (*cause).source())
        .find_map(|cause| cause.downcast_ref::<HttpError>());
    http.is_some_and(|error| matches!(error.kind(), Decode | Interrupted | Request | Timeout))
}

#[cfg(test)]
mod tests;
