//! How a run ends: exit codes, and errors that name their kind.

use std::io::{self, Write};
use std::process::ExitCode;

use slag_edge::query::QueryError;
use slag_edge::store::StoreError;

use super::text::visible;

/// How a run ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// Done, even if nothing was found.
    Done = 0,
    /// Failed.
    Failed = 1,
    /// Asked for something that cannot be; clap exits with it too.
    Usage = 2,
    /// Interrupted by a signal (128 + SIGINT).
    Interrupted = 130,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// Why a run ends early.
pub enum Failure {
    /// Asked for something that cannot be.
    Usage(anyhow::Error),
    /// Failed; `kind` is for programs.
    Failed(&'static str, anyhow::Error),
    /// A signal came.
    Interrupted(anyhow::Error),
    /// Nobody reads stdout any more.
    BrokenPipe,
}

impl Failure {
    /// Wraps an error with its kind.
    pub fn of(kind: &'static str) -> impl Fn(anyhow::Error) -> Self {
        move |error| Self::Failed(kind, error)
    }

    /// Tells the error, as JSON on stdout where that was asked for, and returns the exit code.
    pub fn report(self, json: bool) -> Exit {
        let (exit, kind, error) = match self {
            Self::BrokenPipe => return Exit::Done,
            Self::Usage(error) => (Exit::Usage, "usage", error),
            Self::Failed(kind, error) => (Exit::Failed, kind, error),
            Self::Interrupted(error) => (Exit::Interrupted, "interrupted", error),
        };
        let detail = slag_edge::error_line(&*error);
        // Nothing is left to do if even this cannot be written.
        let _ = match json {
            true => writeln!(
                io::stdout(),
                "{}",
                serde_json::json!({ "error": { "kind": kind, "detail": detail } })
            ),
            false => writeln!(io::stderr(), "error: {}", visible(&detail)),
        };
        exit
    }
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::BrokenPipe => Self::BrokenPipe,
            _ => Self::Failed("io", error.into()),
        }
    }
}

impl From<QueryError> for Failure {
    fn from(error: QueryError) -> Self {
        match error {
            QueryError::Request(error) => Self::Usage(error.into()),
            other => Self::Failed(other.kind(), other.into()),
        }
    }
}

/// Tells apart that nothing is on board yet.
pub fn store_failure(error: StoreError) -> Failure {
    let kind = if matches!(error, StoreError::Empty { .. }) { "no-scene" } else { "store" };
    Failure::Failed(kind, error.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_are_told_once() {
        let io = io::Error::new(io::ErrorKind::NotFound, "no such file");
        let error = anyhow::Error::from(io).context("a: no such file; look").context("b");
        assert_eq!(slag_edge::error_line(&*error), "b: a: no such file; look");
    }

    #[test]
    fn failures_have_their_exit_codes() {
        let error = || anyhow::anyhow!("x");
        assert_eq!(Failure::Usage(error()).report(false), Exit::Usage);
        assert_eq!(Failure::Failed("io", error()).report(false), Exit::Failed);
        assert_eq!(Failure::Interrupted(error()).report(false), Exit::Interrupted);
        assert_eq!(Failure::from(io::Error::from(io::ErrorKind::BrokenPipe)).report(false), Exit::Done);
        assert_eq!(
            [Exit::Done as u8, Exit::Failed as u8, Exit::Usage as u8, Exit::Interrupted as u8],
            [0, 1, 2, 130]
        );
    }
}
