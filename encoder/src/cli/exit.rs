//! The program's exit codes.

use std::process::ExitCode;

/// How a run of the program ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    Done,
    /// Failed; the message says why.
    Failed,
    /// Done without some inputs; the summary names them.
    Partly,
    /// Interrupted by the user; the same command resumes.
    Interrupted,
}

impl From<Exit> for ExitCode {
    /// 2 is left to clap: wrong usage.
    fn from(exit: Exit) -> Self {
        match exit {
            Exit::Done => 0,
            Exit::Failed => 1,
            Exit::Partly => 3,
            Exit::Interrupted => 130,
        }
        .into()
    }
}
