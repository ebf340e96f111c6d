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

/// `eval labelled`: what is scored.
#[derive(Debug, Args)]
pub struct EvalLevelArgs {
    /// What is scored: each Gaussian by itself, or as the object that it belongs to.
    #[arg(long, value_enum, default_value_t)]
    pub level: LevelArg,
}

/// `--level`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum LevelArg {
    /// Each Gaussian by itself.
    #[default]
    Gaussians,
    /// As its object, those without by themselves.
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
