//! Where the result of an evaluation goes: the terminal, and a page.

use std::fmt::Display;
use std::path::Path;

use anyhow::Result;
use serde::Serialize;
use slag_encoder::cli::common::print;
use slag_encoder::html::Page;

/// Where a result goes.
pub(super) struct Output<'a> {
    pub(super) json: bool,
    pub(super) html: Option<&'a Path>,
}

impl Output<'_> {
    /// Prints a result, and writes its page where one is asked for.
    pub(super) fn print(&self, result: &(impl Serialize + Display)) -> Result<()> {
        if let Some(path) = self.html {
            let mut page = Page::new("Evaluation");
            page.plain(&result.to_string());
            page.value(&serde_json::to_value(result)?);
            fs_err::write(path, page.finish())?;
        }
        print(self.json, result, result)
    }
}
