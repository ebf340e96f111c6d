//! Exit codes, and errors with a kind for programs.

use std::io::{self, Write};
use std::process::ExitCode;

use crate::fetch::FetchError;
use crate::query::{QueryError, RequestError};
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

/// What ended a command.
pub struct Failure {
    exit: Exit,
    /// Names the error for programs.
    kind: &'static str,
    error: anyhow::Error,
}

impl Failure {
    pub fn new(exit: Exit, kind: &'static str, error: impl Into<anyhow::Error>) -> Self {
        Self { exit, kind, error: error.into() }
    }

    pub fn usage(error: impl Into<anyhow::Error>) -> Self {
        Self::new(Exit::Usage, "usage", error)
    }

    pub fn failed(kind: &'static str, error: impl Into<anyhow::Error>) -> Self {
        Self::new(Exit::Failed, kind, error)
    }

    pub fn text(&self) -> String {
        crate::error_line(&*self.error)
    }

    /// Reports the error on stderr, or as JSON on stdout, and returns the exit code.
    pub fn report(self, json: bool) -> Exit {
        let (kind, detail) = (self.kind, self.text());
        let is_told = match self.exit {
            // Nobody reads stdout any more.
            Exit::Done => true,
            // Its report is printed already.
            Exit::Partial => false,
            _ => {
                json && {
                    let error = serde_json::json!({ "error": { "kind": kind, "detail": detail } });
                    writeln!(io::stdout(), "{error}").is_ok()
                }
            }
        };
        if !is_told {
            // Its own lines stay lines; names within them may hold anything else.
            let lines: Vec<String> = detail.lines().map(visible).collect();
            let _ = writeln!(io::stderr(), "error: {}", lines.join("\n"));
        }
        self.exit
    }
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::BrokenPipe => Self::new(Exit::Done, "io", error),
            // Errors of files and connections name them: this one is of stdout.
            _ if error.raw_os_error().is_some() => {
                Self::failed("io", anyhow::anyhow!("the output could not be written: {error}"))
            }
            _ => Self::failed("io", error),
        }
    }
}

impl From<QueryError> for Failure {
    fn from(error: QueryError) -> Self {
        match error {
            QueryError::Request(error) => error.into(),
            other => Self::failed(other.kind(), other),
        }
    }
}

impl From<RequestError> for Failure {
    fn from(error: RequestError) -> Self {
        Self::usage(error)
    }
}

/// An empty cache has a kind of its own.
impl From<StoreError> for Failure {
    fn from(error: StoreError) -> Self {
        let kind = if matches!(error, StoreError::Empty { .. }) { "no-scene" } else { "store" };
        Self::failed(kind, error)
    }
}

impl From<FetchError> for Failure {
    fn from(error: FetchError) -> Self {
        match error {
            FetchError::Cancelled => Self::new(Exit::Interrupted, "interrupted", error),
            error => Self::failed("fetch", error),
        }
    }
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
        assert_eq!(Failure::usage(error()).report(false), Exit::Usage);
        assert_eq!(Failure::failed("io", error()).report(false), Exit::Failed);
        assert_eq!(Failure::new(Exit::Partial, "fetch", error()).report(true), Exit::Partial);
        assert_eq!(Failure::from(FetchError::Cancelled).report(false), Exit::Interrupted);
        let full = Failure::from(io::Error::from_raw_os_error(28));
        assert!(full.text().starts_with("the output could not be written: "), "{}", full.text());
        assert_eq!(Failure::from(io::Error::from(io::ErrorKind::BrokenPipe)).report(false), Exit::Done);
        assert_eq!(
            [Exit::Done, Exit::Failed, Exit::Usage, Exit::Partial, Exit::Interrupted].map(|exit| exit as u8),
            [0, 1, 2, 3, 130]
        );
    }
}
