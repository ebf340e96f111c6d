//! Errors of measuring a grid.

use std::path::PathBuf;

/// Error of measuring a grid. Points measured before it are kept.
#[derive(Debug, thiserror::Error)]
pub enum TradeoffError {
    /// A file could not be read or written.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The grid is malformed.
    #[error("{}: {what}; expected {{\"points\": [..]}}, each with axis and name, and optionally views, lift, eval, profile; and \"ordered\": [axis, ..]", path.display())]
    Grid {
        /// The file.
        path: PathBuf,
        /// The problem.
        what: String,
    },
    /// The flags have an unknown placeholder.
    #[error("{flags:?}: unknown placeholder {word}; known are {{masks}}, {{sam}}, {{gpu:N}} and {{gpus:N}}")]
    Flags {
        /// The flags.
        flags: String,
        /// The word.
        word: String,
    },
    /// A folder is not a labelled scene.
    #[error("{}: {what}; give a folder that `generate scene` wrote", dir.display())]
    Scene {
        /// The folder.
        dir: PathBuf,
        /// What is missing.
        what: String,
    },
    /// Two scenes would share files.
    #[error("two scenes are called {name}; rename one of their folders")]
    SameName {
        /// The name.
        name: String,
    },
    /// A program failed.
    #[error("{axis} / {name} on {scene}: {command}: {message}")]
    Program {
        /// The scene.
        scene: String,
        /// The point's axis.
        axis: String,
        /// The point's name.
        name: String,
        /// Its command line.
        command: String,
        /// Its error message.
        message: String,
    },
    /// A point's file is malformed.
    #[error("{}: {source}; delete the file to measure the point again", path.display())]
    Measured {
        /// The file.
        path: PathBuf,
        /// Line, column and reason.
        source: serde_json::Error,
    },
}
