//! A correction that was tried.

use serde::Serialize;

use super::mistake::Mistake;

/// A correction and the PSNR it leads to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Trial {
    /// The corrected mistake.
    pub mistake: Mistake,
    /// A second mistake, corrected after the first.
    pub and: Option<Mistake>,
    /// Mean PSNR with the correction, dB.
    pub psnr_db: f64,
}

impl Trial {
    /// Returns the corrections in their order.
    pub(super) fn corrections(&self) -> Vec<Mistake> {
        std::iter::once(self.mistake).chain(self.and).collect()
    }
}
