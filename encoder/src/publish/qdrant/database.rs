//! Requests to the database, repeated while their errors may pass.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use qdrant_client::{Qdrant, QdrantError};
use slag_common::retry::{Backoff, Retries};

use super::error::PushError;
use super::options::PushOptions;

/// Longest pause between two attempts.
const MAX_RETRY_DELAY: Duration = Duration::from_secs(30);

/// The client of a database.
pub(super) struct Database<'a> {
    pub(super) client: Qdrant,
    /// For requests that take as long as their collection is large.
    pub(super) patient_client: Qdrant,
    options: &'a PushOptions,
    n_retries: AtomicU64,
}

impl<'a> Database<'a> {
    pub(super) fn new(options: &'a PushOptions) -> Result<Self, PushError> {
        let client = |timeout| {
            Qdrant::from_url(&options.url)
                .api_key(options.api_key.as_deref())
                .timeout(timeout)
                .connect_timeout(options.timeout)
                // The check prints to standard output.
                .skip_compatibility_check()
                .build()
                .map_err(|cause| database_error(options, "set up the client", cause))
        };
        Ok(Self {
            client: client(options.timeout)?,
            patient_client: client(options.snapshot_timeout)?,
            options,
            n_retries: AtomicU64::new(0),
        })
    }

    /// Returns the names of all collections.
    pub(super) async fn collection_names(&self) -> Result<Vec<String>, PushError> {
        let listed = self.attempt("list the collections", || self.client.list_collections()).await?;
        Ok(listed.collections.into_iter().map(|collection| collection.name).collect())
    }

    /// Returns the number of repeated attempts.
    pub(super) fn n_retries(&self) -> u64 {
        self.n_retries.load(Ordering::Relaxed)
    }

    /// Sends a request until it succeeds, fails permanently, or no attempts are left.
    pub(super) async fn attempt<T, F>(
        &self,
        action: &'static str,
        request: impl Fn() -> F,
    ) -> Result<T, PushError>
    where
        F: Future<Output = Result<T, QdrantError>>,
    {
        let backoff = Backoff { first: self.options.retry_delay, longest: MAX_RETRY_DELAY };
        let mut retries = Retries::new(self.options.n_retries.saturating_add(1), backoff);
        loop {
            let error = match request().await {
                Ok(response) => return Ok(response),
                Err(error) => error,
            };
            let Some(pause) = retries.failed(false).filter(|_| may_pass(&error)) else {
                return Err(database_error(self.options, action, error));
            };
            self.n_retries.fetch_add(1, Ordering::Relaxed);
            let asked = match &error {
                QdrantError::ResourceExhaustedError { retry_after_seconds, .. } => {
                    Duration::from_secs(*retry_after_seconds)
                }
                _ => Duration::ZERO,
            };
            tracing::warn!("{action}: {error}; trying again");
            tokio::time::sleep(pause.max(asked).min(MAX_RETRY_DELAY)).await;
        }
    }
}

fn database_error(options: &PushOptions, action: &'static str, cause: QdrantError) -> PushError {
    PushError::Database { url: options.url.clone(), action, cause: Box::new(cause) }
}

/// gRPC status codes (`statuscodes.md` of its specification).
mod code {
    pub(super) const CANCELLED: i32 = 1;
    pub(super) const UNKNOWN: i32 = 2;
    pub(super) const DEADLINE_EXCEEDED: i32 = 4;
    pub(super) const RESOURCE_EXHAUSTED: i32 = 8;
    pub(super) const ABORTED: i32 = 10;
    pub(super) const INTERNAL: i32 = 13;
    pub(super) const UNAVAILABLE: i32 = 14;
}

/// Returns whether the same request may succeed later.
fn may_pass(error: &QdrantError) -> bool {
    match error {
        QdrantError::ResourceExhaustedError { .. } | QdrantError::Io(_) => true,
        QdrantError::ResponseError { status } => match status.code() as i32 {
            code::UNAVAILABLE | code::DEADLINE_EXCEEDED | code::RESOURCE_EXHAUSTED | code::ABORTED => true,
            // The client's own time limit, and a connection that broke during a request.
            code::CANCELLED | code::UNKNOWN => true,
            // A refused connection.
            code::INTERNAL => status.message().starts_with("Failed to connect"),
            _ => false,
        },
        _ => false,
    }
}
