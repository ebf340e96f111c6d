//! Exit codes, and errors with a kind for programs.

use std::io::{self, Write};
use std::process::ExitCode;

use crate::query::QueryError;
use crate::store::StoreError;

use super::text::visible;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// Success, even if nothing was found.
    Done = 0,
    Failed = 1,
    /// Invalid request; also clap's exit code.
    Usage = 2,
    /// A fetch got some cells only.
    Partial = 3,
    /// Interrupted by a signal (128 + SIGINT).
    Interrupted = 130,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

pub enum Failure {
    Usage(anyhow::Error),
    /// The string names the error for programs.
    Failed(&'static str, anyhow::Error),
    /// A fetch got some cells only; its report is printed.
    Partial(anyhow::Error),
    Interrupted(anyhow::Error),
    /// Nobody reads stdout any more.
    BrokenPipe,
}

impl Failure {
    pub fn text(&self) -> String {
        match self {
            Self::BrokenPipe => String::new(),
            Self::Usage(error) | Self::Failed(_, error) | Self::Partial(error) | Self::Interrupted(error) => {
                crate::error_line(&**error)
            }
        }
    }

    /// Reports the error on stderr, or as JSON on stdout, and returns the exit code.
    pub fn report(self, json: bool) -> Exit {
        let (exit, kind, error) = match self {
            Self::BrokenPipe => return Exit::Done,
            Self::Partial(error) => {
                let _ = writeln!(io::stderr(), "error: {}", visible(&crate::error_line(&*error)));
                return Exit::Partial;
            }
            Self::Usage(error) => (Exit::Usage, "usage", error),
            Self::Failed(kind, error) => (Exit::Failed, kind, error),
            Self::Interrupted(error) => (Exit::Interrupted, "interrupted", error),
        };
        let detail = crate::error_line(&*error);
        let is_told = json && {
            let error = serde_json::json!({ "error": { "kind": kind, "detail": detail } });
            writeln!(io::stdout(), "{error}").is_ok()
        };
        if !is_told {
            let _ = writeln!(io::stderr(), "error: {}", visible(&detail));
        }
        exit
    }
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::BrokenPipe => Self::BrokenPipe,
            // Errors of files and connections name them: this one is of stdout.
            _ if error.raw_os_error().is_some() => {
                Self::Failed("io", anyhow::anyhow!("the output could not be written: {error}"))
            }
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

/// Wraps an error of the cache; an empty cache has a kind of its own.
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
        assert_eq!(crate::error_line(&*error), "b: a: no such file; look");
    }

    #[test]
    fn failures_have_their_exit_codes() {
        let error = || anyhow::anyhow!("x");
        assert_eq!(Failure::Usage(error()).report(false), Exit::Usage);
        assert_eq!(Failure::Failed("io", error()).report(false), Exit::Failed);
        assert_eq!(Failure::Partial(error()).report(true), Exit::Partial);
        assert_eq!(Failure::Interrupted(error()).report(false), Exit::Interrupted);
        let full = Failure::from(io::Error::from_raw_os_error(28));
        assert!(full.text().starts_with("the output could not be written: "), "{}", full.text());
        assert_eq!(Failure::from(io::Error::from(io::ErrorKind::BrokenPipe)).report(false), Exit::Done);
        assert_eq!(
            [Exit::Done, Exit::Failed, Exit::Usage, Exit::Partial, Exit::Interrupted].map(|exit| exit as u8),
            [0, 1, 2, 3, 130]
        );
    }
}
