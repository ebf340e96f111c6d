//! Errors of a push.

use qdrant_client::QdrantError;

use super::source::SourceError;

/// Why a push ended early.
#[derive(Debug, thiserror::Error)]
pub enum PushError {
    /// The vectors of the collection have another shape.
    #[error(
        "collection {collection:?} has {found}, this scene needs {expected}; choose another collection, or delete this one"
    )]
    Collection {
        /// The collection.
        collection: String,
        /// Vectors of the collection.
        found: String,
        /// Vectors of the scene.
        expected: String,
    },
    /// The collection holds points of another scene.
    #[error(
        "collection {collection:?} holds {n_points} points of other scenes than {scene:?}, and ids would collide; choose another collection"
    )]
    OtherScene {
        /// The collection.
        collection: String,
        /// The scene to push.
        scene: String,
        /// Points of other scenes.
        n_points: u64,
    },
    /// The database refused a request, or was unreachable in all attempts.
    #[error(
        "{url}: {action}: {cause}; check address, key and the database's log, then run the push again: it continues"
    )]
    Database {
        /// Address of the database.
        url: String,
        /// The request.
        action: &'static str,
        /// The error.
        cause: Box<QdrantError>,
    },
    /// The vectors of a cell cannot be read.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The progress cannot be recorded.
    #[error("the progress of the push cannot be recorded: {0}; check the store's free space and permissions")]
    Records(sled::Error),
    /// The database counts another number of points than it acknowledged.
    #[error(
        "collection {collection:?} has {found} points, {expected} were pushed; another program may have changed it; run the push again: it starts over"
    )]
    Count {
        /// The collection.
        collection: String,
        /// Points pushed.
        expected: u64,
        /// Points in the collection.
        found: u64,
    },
    /// The database made no snapshot, and says nothing of why.
    #[error("the database describes no snapshot of collection {collection:?}; see its log")]
    NoSnapshot {
        /// The collection.
        collection: String,
    },
    /// The push was cancelled.
    #[error("the push was stopped; run the push again: it continues")]
    Cancelled,
    /// A task of the program failed.
    #[error("{0}; this is a bug, please report it")]
    Task(tokio::task::JoinError),
}

impl From<sled::Error> for PushError {
    fn from(cause: sled::Error) -> Self {
        Self::Records(cause)
    }
}

impl From<tokio::task::JoinError> for PushError {
    fn from(cause: tokio::task::JoinError) -> Self {
        Self::Task(cause)
    }
}
