//! The command line: flags in, exit code out. Data goes to stdout, everything else to stderr.

mod args;
mod bench;
mod eval;
mod keys;
mod noise;
mod objects;
mod preset;
mod progress;
mod refine;
mod run;
mod sam;
mod tradeoff;
mod views;

use std::process::ExitCode;

pub use args::Cli;
pub use run::run;

/// How a run of the program ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// All done.
    Done,
    /// Failed; the message says why.
    Failed,
    /// Done, but some inputs were left out; the summary names them.
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
