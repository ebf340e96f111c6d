//! Crops of several views in common batches, for image models on GPUs.
//!
//! A GPU is quickest with hundreds of crops at once, more than one view has. Views queue their crops and sleep until
//! these are done; each lane's thread runs the next batch, with crops of any views. Nobody waits for a full batch:
//! while the lanes are at work the queue grows, and batches with it. Views are woken one by one: all at once would be
//! in the way of the threads that feed the GPUs.

use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use slag_models::{Crop, ImageEncoder, ModelError};

use super::{EmbedError, embed_crops};
use crate::lanes::{GpuLoad, Lane, Lanes};
use crate::memory::{MemoryPlan, Phase};

/// Two compute, one copies or is filled.
const LANES_PER_GPU: usize = 3;

/// Views that may wait per lane: with a usual number of masks they fill two batches.
const VIEWS_PER_LANE: usize = 12;
/// Crops reserved per lane: of that many views, or of fewer with many masks.
const CROPS_PER_LANE: u64 = 512;

pub(crate) type OpenEncoder = dyn Fn(u32) -> Result<Box<dyn ImageEncoder>, ModelError> + Send + Sync;

/// Image encoders on GPUs, shared by the crops of all views.
pub(crate) struct SharedEncoders {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

struct Shared {
    open: Box<OpenEncoder>,
    lanes: Lanes<Option<Box<dyn ImageEncoder>>>,
    queue: Mutex<Queue>,
    /// Wakes a lane's thread for new crops or the end.
    has_work: Condvar,
}

#[derive(Default)]
struct Queue {
    waiting: VecDeque<(Crop, Place)>,
    n_requests: u64,
    /// By the end, or by a batch that panicked and lost its crops.
    is_closed: bool,
}

/// Where a crop's vector goes.
struct Place {
    request: u64,
    /// Index among the request's crops.
    at: usize,
    answers: Sender<Answer>,
}

/// Vectors of consecutive crops, one after the other.
type Answer = Result<(Range<usize>, Vec<f32>), Failure>;

#[derive(Debug, thiserror::Error)]
pub(crate) enum Failure {
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error(transparent)]
    Embed(#[from] EmbedError),
}

impl SharedEncoders {
    /// `open` is called once per lane.
    pub fn new(gpus: &[u32], open: Box<OpenEncoder>) -> Self {
        Self::with_lanes(gpus, LANES_PER_GPU, open)
    }

    pub(crate) fn with_lanes(gpus: &[u32], n_lanes: usize, open: Box<OpenEncoder>) -> Self {
        let lanes = Lanes::new(gpus.iter().map(|gpu| (*gpu, (0..n_lanes).map(|_| None).collect())));
        let shared = Arc::new(Shared { open, lanes, queue: Mutex::default(), has_work: Condvar::new() });
        let work = |_| {
            let shared = Arc::clone(&shared);
            std::thread::spawn(move || shared.work())
        };
        let threads = (0..gpus.len() * n_lanes).map(work).collect();
        Self { shared, threads }
    }

    /// Number of concurrently waiting views that keeps the lanes at work.
    pub fn n_views(gpus: &[u32]) -> usize {
        gpus.len() * LANES_PER_GPU * VIEWS_PER_LANE
    }

    pub(crate) fn reserve(memory: &mut MemoryPlan, gpus: &[u32], square_bytes: u64) {
        let n = gpus.len() as u64 * LANES_PER_GPU as u64 * CROPS_PER_LANE;
        memory.reserve(Phase::Views, "crops that wait for GPUs", n * square_bytes);
    }

    pub fn loads(&self) -> Vec<GpuLoad> {
        self.shared.lanes.loads()
    }

    pub(crate) fn with_encoder<T>(
        &self,
        work: impl FnOnce(&mut dyn ImageEncoder) -> T,
    ) -> Result<T, ModelError> {
        self.shared.opened(&mut self.shared.lanes.take()).map(work)
    }

    /// Returns a unit vector per crop, `[crops][dim]`.
    ///
    /// # Errors
    /// [`Failure`]; crops of other views are not affected.
    pub fn embed(&self, crops: Vec<Crop>) -> Result<Vec<f32>, Failure> {
        let mut n_left = crops.len();
        let (answers, answered) = channel();
        let mut queue = self.shared.queue();
        // The thread that panicked has printed the message.
        assert!(!queue.is_closed, "a batch of crops was lost");
        queue.n_requests += 1;
        let request = queue.n_requests;
        let waiting = |(at, crop)| (crop, Place { request, at, answers: answers.clone() });
        queue.waiting.extend(crops.into_iter().enumerate().map(waiting));
        drop(queue);
        drop(answers);
        self.shared.has_work.notify_one();
        let mut parts = BTreeMap::new();
        while n_left > 0 {
            let answer = answered.recv().expect("a batch of crops was lost");
            let (crops, vectors) = answer.inspect_err(|_| {
                self.shared.queue().waiting.retain(|(_, place)| place.request != request);
            })?;
            n_left -= crops.len();
            parts.insert(crops.start, vectors);
        }
        Ok(parts.into_values().flatten().collect())
    }
}

impl Drop for SharedEncoders {
    fn drop(&mut self) {
        self.shared.close();
        // A panic has left its message, and views that waited for the batch have panicked.
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

impl Shared {
    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Ends the lanes' threads; views that still wait get no answer.
    fn close(&self) {
        let mut queue = self.queue();
        queue.is_closed = true;
        queue.waiting.clear();
        self.has_work.notify_all();
    }

    fn work(&self) {
        let _guard = CloseAtEnd(self);
        let mut queue = self.queue();
        while !queue.is_closed {
            if queue.waiting.is_empty() {
                queue = self.has_work.wait(queue).unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            drop(queue);
            self.run_batch(&mut self.lanes.take());
            queue = self.queue();
        }
    }

    fn opened<'l>(
        &self,
        lane: &'l mut Lane<'_, Option<Box<dyn ImageEncoder>>>,
    ) -> Result<&'l mut dyn ImageEncoder, ModelError> {
        if lane.is_none() {
            **lane = Some((self.open)(lane.gpu())?);
        }
        Ok(lane.as_mut().expect("opened").as_mut())
    }

    /// Answers are sent view by view. A view that has failed does not receive any more.
    fn run_batch(&self, lane: &mut Lane<'_, Option<Box<dyn ImageEncoder>>>) {
        let encoder = match self.opened(lane) {
            Ok(encoder) => encoder,
            // The encoder cannot be opened: the first crop gets the error, and the others will, too.
            Err(error) => {
                if let Some((_, first)) = self.queue().waiting.pop_front() {
                    drop(first.answers.send(Err(error.into())));
                }
                return;
            }
        };
        let (crops, places): (Vec<Crop>, Vec<Place>) = {
            let mut queue = self.queue();
            let n = queue.waiting.len().min(encoder.preferred_batch());
            let batch = queue.waiting.drain(..n).unzip();
            if !queue.waiting.is_empty() {
                self.has_work.notify_one();
            }
            batch
        };
        if crops.is_empty() {
            return;
        }
        let dim = encoder.dim();
        let together = encoder.encode(&crops);
        let mut done = 0;
        for places in places.chunk_by(|a, b| a.request == b.request) {
            let (first, of_view) = (places[0].at, done..done + places.len());
            done = of_view.end;
            let vectors = match &together {
                Ok(vectors) => Ok(vectors[of_view.start * dim..of_view.end * dim].to_vec()),
                // One by one, so that only the bad crop's view fails.
                Err(_) => {
                    let crops = crops[of_view].chunks(1).zip(first..);
                    let alone = crops.map(|(crop, at)| embed_crops(crop, at, encoder));
                    alone.collect::<Result<Vec<_>, _>>().map(|vectors| vectors.concat())
                }
            };
            let answer = vectors.map(|vectors| (first..first + places.len(), vectors));
            drop(places[0].answers.send(answer.map_err(Failure::from)));
        }
    }
}

/// Closes the queue when a lane's thread ends, also by a panic, so that no view waits for it.
struct CloseAtEnd<'l>(&'l Shared);

impl Drop for CloseAtEnd<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use image::{Rgb, RgbImage};
    use slag_models::{ModelDir, SessionOptions};

    use super::*;

    fn crop(seed: usize) -> Crop {
        Crop::whole(RgbImage::from_fn(64, 64, |x, y| {
            Rgb([0, 1, 2].map(|c| ((x as usize + c * 40) * (seed % 13 + 1) + y as usize * (seed % 7)) as u8))
        }))
    }

    /// Views of 1 to 29 crops get the vectors of an encoder of their own, for any number of GPUs and lanes.
    #[test]
    fn views_that_share_batches_get_the_vectors_of_their_own() {
        let models = ModelDir::embedded().expect("opens");
        let session = SessionOptions::new(slag_test_support::onnx_runtime());
        let views: Vec<Vec<Crop>> =
            (0..12).map(|view| (0..1 + view * 17 % 29).map(|k| crop(view * 31 + k)).collect()).collect();
        let mut own = models.image_encoder(&session).expect("opens");
        let expected: Vec<Vec<f32>> = views.iter().map(|crops| own.encode(crops).expect("runs")).collect();
        for (gpus, n_lanes) in [(&[0][..], 1), (&[0], 3), (&[0, 1], 2)] {
            let n_opened = Arc::new(AtomicUsize::new(0));
            let (opened, models, session) = (Arc::clone(&n_opened), models.clone(), session.clone());
            let open = move |_| {
                opened.fetch_add(1, Ordering::SeqCst);
                models.image_encoder(&session)
            };
            let shared = SharedEncoders::with_lanes(gpus, n_lanes, Box::new(open));
            std::thread::scope(|scope| {
                for (crops, expected) in views.iter().zip(&expected) {
                    let shared = &shared;
                    scope.spawn(move || {
                        let found = shared.embed(crops.clone()).expect("runs");
                        assert!(&found == expected, "{} crops", crops.len());
                    });
                }
            });
            assert!((1..=gpus.len() * n_lanes).contains(&n_opened.load(Ordering::SeqCst)));
            assert!(shared.shared.queue().waiting.is_empty());
        }
    }

    /// An empty crop fails with its own view; others of the same batch get their vectors.
    #[test]
    fn a_bad_crop_fails_with_its_view_alone() {
        let models = ModelDir::embedded().expect("opens");
        let session = SessionOptions::new(slag_test_support::onnx_runtime());
        let expected = models.image_encoder(&session).expect("opens").encode(&[crop(1)]).expect("runs");
        let open = move |_| models.image_encoder(&session);
        let shared = SharedEncoders::with_lanes(&[0], 1, Box::new(open));
        let all_began = std::sync::Barrier::new(8);
        std::thread::scope(|scope| {
            for view in 0..8 {
                let (shared, all_began, expected) = (&shared, &all_began, &expected);
                scope.spawn(move || {
                    all_began.wait();
                    let bad = Crop::whole(RgbImage::new(0, 0));
                    match shared.embed(if view % 4 == 3 { vec![crop(0), bad] } else { vec![crop(1)] }) {
                        Ok(found) => assert!(view % 4 != 3 && &found == expected),
                        Err(Failure::Embed(EmbedError::Encode { first: 1, last: 1, .. })) => {
                            assert_eq!(view % 4, 3)
                        }
                        Err(error) => panic!("{error}"),
                    }
                });
            }
        });
    }

    #[test]
    fn a_model_that_does_not_open_is_an_error_for_all() {
        let models = ModelDir::embedded().expect("opens");
        let absent = SessionOptions::new("/absent/libonnxruntime.so".into());
        let shared = SharedEncoders::with_lanes(&[0], 2, Box::new(move |_| models.image_encoder(&absent)));
        std::thread::scope(|scope| {
            for view in 0..4 {
                let shared = &shared;
                scope.spawn(move || {
                    let failed = shared.embed((0..=view).map(crop).collect());
                    assert!(matches!(failed, Err(Failure::Model(_))), "{failed:?}");
                });
            }
        });
    }
}
