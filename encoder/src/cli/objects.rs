//! Flags of objects.

use clap::{Args, ValueEnum};

use crate::eval::EvalLevel;

/// `encode`: whether objects are found.
#[derive(Debug, Args)]
pub struct ObjectArgs {
    /// Does not look for objects: masks of different views that show the same Gaussians.
    #[arg(long)]
    pub no_objects: bool,
}

/// `eval labelled` and `query`: what is scored.
#[derive(Debug, Args)]
pub struct EvalLevelArgs {
    /// What is scored [default: objects, where the scene has them].
    #[arg(long, value_enum)]
    pub level: Option<LevelArg>,
}

/// `--level`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LevelArg {
    /// Each Gaussian by itself.
    Gaussians,
    /// Objects, and the Gaussians within them; those without by themselves.
    Objects,
}

impl From<LevelArg> for EvalLevel {
    fn from(level: LevelArg) -> Self {
        match level {
            LevelArg::Gaussians => Self::Gaussians,
            LevelArg::Objects => Self::Objects,
        }
    }
}
