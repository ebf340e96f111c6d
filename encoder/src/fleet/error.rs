//! Why a fleet's encode or worker ends without its result.

use crate::blobs::BlobError;
use crate::encode::EncodeError;

#[derive(Debug, thiserror::Error)]
pub(crate) enum FleetError {
    #[error(transparent)]
    Blob(#[from] BlobError),
    #[error(
        "{url}: {problem}; check the address, that nats-server runs with JetStream (-js), and the credentials"
    )]
    Queue { url: String, problem: String },
    #[error(transparent)]
    Encode(#[from] EncodeError),
    #[error(transparent)]
    Io(#[from] std::io::Error),
    #[error(
        "run {run} was planned by slag-encoder {planned}, this is {own}: install the same program on all machines of the fleet"
    )]
    Version { run: u64, planned: String, own: String },
    #[error(
        "run {run} was planned with {planned}, this worker would encode with {own} and make other contributions; give the worker the coordinator's --models, --segmenter, --provider and program"
    )]
    Identity { run: u64, planned: String, own: String },
    #[error(
        "run {run}: its coordinator has shown no heartbeat for {secs} s. What is done lies in {url}: start the same encode again, then its workers"
    )]
    Abandoned { run: u64, secs: u64, url: String },
    #[error(
        "run {run} was superseded: another `encode --blobs` uses {url}. Let one of them finish, or give the other another prefix"
    )]
    Superseded { run: u64, url: String },
    #[error("{url}: no encode began within {secs:.0} s; check --blobs, or wait longer with --wait")]
    NoRun { url: String, secs: f64 },
    #[error("{url}/{key}: {problem}; delete it, and it is made again")]
    Damaged { url: String, key: String, problem: String },
    #[error(transparent)]
    Memory(#[from] crate::memory::MemoryError),
    #[error("view {view}: {reason}")]
    View { view: String, reason: String },
}

impl FleetError {
    pub(super) fn damaged(bucket: &crate::blobs::Bucket, key: &str, problem: impl ToString) -> Self {
        Self::Damaged { url: bucket.url.clone(), key: key.to_owned(), problem: problem.to_string() }
    }
}

impl From<FleetError> for EncodeError {
    fn from(error: FleetError) -> Self {
        match error {
            FleetError::Encode(error) => error,
            error => Self::Fleet(Box::new(error)),
        }
    }
}

impl From<BlobError> for EncodeError {
    fn from(error: BlobError) -> Self {
        FleetError::from(error).into()
    }
}
