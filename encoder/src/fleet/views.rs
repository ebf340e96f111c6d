//! Views on a worker: through the pipeline, with the bucket at both ends.

use std::sync::atomic::{AtomicUsize, Ordering};

use slag_common::View;

use super::dispatch::Dispatcher;
use super::documents::{self, FailedView};
use super::objects;
use super::prepared::Prepared;
use crate::blobs::Bucket;
use crate::encode::fleet_parts::{
    PhotoSource, RunContext, ViewRecord, ViewSink, ViewStages, ViewTools, work_off,
};
use crate::encode::{EncodeError, Engines};
use crate::lift::ViewContributions;
use crate::lift::photos::{MaskOutline, outlines_to_bytes};
use crate::raster::LoadedScene;
use crate::segment::Segmenter;

/// Concurrent fetches of photos, and puts of results: one while another is decoded or packed.
const N_AT_ONCE: usize = 2;

pub(super) struct ViewWork<'a> {
    pub(super) context: &'a RunContext<'a>,
    pub(super) bucket: &'a Bucket,
    pub(super) prepared: &'a Prepared,
    pub(super) engines: &'a Engines<'a>,
    pub(super) segmenter: &'a dyn Segmenter,
    pub(super) scene: &'a dyn LoadedScene,
    pub(super) dispatcher: &'a dyn Dispatcher,
    pub(super) n_threads: usize,
    pub(super) gpus: &'a [u32],
    pub(super) n_done: AtomicUsize,
}

impl ViewWork<'_> {
    pub(super) fn tools(&self) -> ViewTools<'_> {
        ViewTools {
            context: self.context,
            engines: self.engines,
            settings: &self.prepared.settings,
            n_threads: self.n_threads,
            gpus: self.gpus,
            segmenter: self.segmenter,
            scene: self.scene,
            split: &self.prepared.split,
            photos: Some(self),
            sink: self,
        }
    }

    /// Does the available views; ends when there are none at present.
    pub(super) fn run(&self) -> Result<(), EncodeError> {
        let prepared = self.prepared;
        let stages = ViewStages::new(self.tools());
        let source = views_to_do(self.dispatcher, &prepared.views, || self.context.is_cancelled());
        let source = source.map(|view| (true, view));
        work_off(&stages, source, |view, error| {
            // The coordinator warns of the first few.
            tracing::info!("view {} fails: {error}", view.name);
            self.fail(view, &error.to_string())
        })?;
        Ok(())
    }

    fn fail(&self, view: &View, reason: &str) -> Result<(), EncodeError> {
        let number = self.prepared.number_of[&view.name];
        let document = documents::to_bytes(&FailedView { reason: reason.to_owned() })?;
        self.bucket.put_new(&self.prepared.run.failed_key(number), document)?;
        self.finish(number);
        Ok(())
    }

    fn finish(&self, number: usize) {
        self.prepared.remove_view(number);
        self.dispatcher.done(number);
    }
}

impl PhotoSource for ViewWork<'_> {
    fn n_at_once(&self) -> usize {
        N_AT_ONCE
    }

    fn fetch(&self, view: &View) -> Result<bool, EncodeError> {
        let number = self.prepared.number_of[&view.name];
        // Another worker may have done it meanwhile.
        let key = documents::view_key(self.prepared.plan.views[number].id);
        if let Ok(Some(_)) = self.bucket.len_of(&key) {
            self.dispatcher.done(number);
            return Ok(false);
        }
        self.prepared.fetch_view(self.bucket, number)?;
        Ok(true)
    }
}

impl ViewSink for ViewWork<'_> {
    fn n_at_once(&self) -> usize {
        N_AT_ONCE
    }

    fn keep(
        &self,
        view: &View,
        contributions: &ViewContributions,
        outlines: &[MaskOutline],
        record: ViewRecord,
    ) -> Result<(), EncodeError> {
        let contributions = contributions.to_bytes(&view.image_path)?;
        let bytes = objects::pack_view(record, &outlines_to_bytes(outlines)?, &contributions)?;
        let number = self.prepared.number_of[&view.name];
        let id = self.prepared.plan.views[number].id;
        // If another worker was first, its object has the same content.
        if self.bucket.put_new(&documents::view_key(id), bytes)? {
            self.n_done.fetch_add(1, Ordering::Relaxed);
        }
        self.finish(number);
        Ok(())
    }
}

/// Yields the available views without waiting for the bucket: the fetch of the photo finds views done meanwhile.
fn views_to_do<'a>(
    dispatcher: &'a dyn Dispatcher,
    views: &'a [View],
    is_cancelled: impl Fn() -> bool,
) -> impl Iterator<Item = &'a View> {
    std::iter::from_fn(move || {
        while !is_cancelled() {
            let number = dispatcher.take()?;
            match views.get(number) {
                Some(view) => return Some(view),
                // A message that this program did not write.
                None => dispatcher.done(number),
            }
        }
        None
    })
}
