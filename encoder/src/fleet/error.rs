//! Why a fleet's encode or worker ends without its result.

use crate::blobs::BlobError;
use crate::encode::EncodeError;

/// The queue cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum QueueError {
    /// No connection.
    #[error(
        "{url}: {problem}; check the address, that nats-server runs with JetStream (-js), and the credentials"
    )]
    Connect {
        /// The address.
        url: String,
        /// The cause.
        problem: String,
    },
}

/// Why a coordinator or worker ends.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// The bucket.
    #[error(transparent)]
    Blob(#[from] BlobError),
    /// The queue.
    #[error(transparent)]
    Queue(#[from] QueueError),
    /// A view cannot be done on this machine.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// A file of this machine.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The run was planned by another version.
    #[error(
        "run {run} was planned by slag-encoder {planned}, this is {own}: install the same program on all machines of the fleet"
    )]
    Version {
        /// The run.
        run: u64,
        /// The coordinator's version.
        planned: String,
        /// This one's.
        own: String,
    },
    /// This machine would make other contributions.
    #[error(
        "run {run} was planned with {planned}, this worker would encode with {own} and make other contributions; give the worker the coordinator's --models, --segmenter, --provider and program"
    )]
    Identity {
        /// The run.
        run: u64,
        /// The coordinator's models, segmenter and settings.
        planned: String,
        /// This worker's.
        own: String,
    },
    /// The coordinator has died, or cannot reach the bucket.
    #[error(
        "run {run}: its coordinator has shown no heartbeat for {secs} s. What is done lies in {url}: start the same encode again, then its workers"
    )]
    Abandoned {
        /// Number of the run.
        run: u64,
        /// Time without a heartbeat.
        secs: u64,
        /// The bucket.
        url: String,
    },
    /// Another coordinator has taken the run's place.
    #[error(
        "run {run} was superseded: another `encode --blobs` uses {url}. Let one of them finish, or give the other another prefix"
    )]
    Superseded {
        /// The run.
        run: u64,
        /// The bucket.
        url: String,
    },
    /// An object is not what its name says.
    #[error("{url}/{key}: {problem}; delete it, and it is made again")]
    Damaged {
        /// The bucket.
        url: String,
        /// The object.
        key: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The memory of the worker.
    #[error(transparent)]
    Memory(#[from] crate::memory::MemoryError),
    /// A view failed, and `strict` is set.
    #[error("view {view}: {reason}")]
    View {
        /// The view.
        view: String,
        /// Why.
        reason: String,
    },
}

impl FleetError {
    /// Makes the error of a damaged object.
    pub(super) fn damaged(bucket: &crate::blobs::Bucket, key: &str, problem: impl ToString) -> Self {
        Self::Damaged { url: bucket.url().to_owned(), key: key.to_owned(), problem: problem.to_string() }
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
