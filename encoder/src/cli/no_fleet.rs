//! Takes the place of `fleet.rs` where the program is built without the feature `fleet`: all views are done here.

use std::sync::atomic::AtomicBool;

use anyhow::Result;
use clap::Args;

use crate::encode::{self, EncodeSettings, EncodeSummary, Engines};
use crate::progress::Progress;

/// No flags.
#[derive(Clone, Debug, Args)]
pub struct CoordinatorArgs {}

impl CoordinatorArgs {
    /// Encodes on this machine.
    ///
    /// # Errors
    /// If the encode fails.
    pub(super) fn encode(
        &self,
        settings: &EncodeSettings,
        engines: &Engines<'_>,
        progress: &dyn Progress,
        cancel: &AtomicBool,
    ) -> Result<EncodeSummary> {
        Ok(encode::encode(settings, engines, progress, cancel)?)
    }
}
