//! The programs beside this one.

use std::path::PathBuf;

use anyhow::{Context, Result};

/// Returns the path of a program beside this one.
pub(super) fn sibling(name: &str) -> Result<PathBuf> {
    let lab = std::env::current_exe().context("cannot find the path of this program")?;
    Ok(lab.with_file_name(format!("{name}{}", std::env::consts::EXE_SUFFIX)))
}
