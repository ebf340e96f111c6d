//! What comes in and goes out where an encode is spread over machines: photos and contributions.

use serde::{Deserialize, Serialize};
use slag_common::View;

use super::error::EncodeError;
use crate::lift::ViewContributions;
use crate::lift::photos::MaskOutline;
use crate::segment::Segmenter;

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewRecord {
    /// Width at which its weights were rasterised.
    pub(crate) raster_width_px: u32,
    /// Seconds in its stages before this record.
    pub(crate) secs: f32,
}

pub(crate) trait PhotoSource: Sync {
    fn n_at_once(&self) -> usize;

    /// Fetches a view's files to its paths; returns whether the view is still to be done.
    fn fetch(&self, view: &View) -> Result<bool, EncodeError>;
}

pub(crate) trait ViewSink: Sync {
    fn n_at_once(&self) -> usize;

    /// Refuses a view whose photo or masks changed since planning; those fetched by hash cannot have.
    fn check_unchanged(&self, _view: &View, _segmenter: &dyn Segmenter) -> Result<(), EncodeError> {
        Ok(())
    }

    /// Keeps a view's contributions and outlines; they are durable on return.
    fn keep(
        &self,
        view: &View,
        contributions: &ViewContributions,
        outlines: &[MaskOutline],
        record: ViewRecord,
    ) -> Result<(), EncodeError>;
}
