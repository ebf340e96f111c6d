//! Times image models and Segment Anything as `encode` runs them, beside the same models in other programs.
//!
//! Squares and photos are ready before the clock starts: the crops and photos of an encode are made by its other stages.

mod kernels;
mod report;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use image::{Rgb, RgbImage};
use rayon::{ThreadPool, ThreadPoolBuilder};
use serde_json::{Value, json};
use slag_common::{Distortion, Intrinsics, View};
use slag_encoder::embed::SharedEncoders;
use slag_encoder::ingest::LoadedImage;
use slag_encoder::lanes::GpuLoad;
use slag_encoder::segment::{SamSegmenter, SamSettings, SegmentInput, Segmenter};
use slag_models::{Crop, ModelDir, SessionOptions};

use crate::bench::machine::Machine;
use kernels::Kernels;

pub use report::{InferenceReport, Measured, Rival};

/// The rivals' program.
const RIVALS: &str = include_str!("rivals.py");

/// Crops of a view, about as many as a photo has masks.
const CROPS_PER_VIEW: usize = 60;

/// The photo of the benchmark, pixels.
const PHOTO_PX: [u32; 2] = [1024, 768];

/// What to measure.
#[derive(Clone, Debug)]
pub struct InferenceOptions {
    /// Image model, or `None` to leave it out.
    pub models: Option<ModelDir>,
    /// Folder of Segment Anything, or `None` to leave it out.
    pub segmenter: Option<PathBuf>,
    /// How models run.
    pub session: SessionOptions,
    /// The GPUs; measured with the first alone, then with all.
    pub gpus: Vec<u32>,
    /// Points along each side of the grid.
    pub grids: Vec<u32>,
    /// Points per run of the decoder.
    pub points_per_batch: u32,
    /// Seconds of each measurement.
    pub secs: f64,
    /// Threads that filter masks.
    pub n_threads: usize,
    /// A Python with the rivals' packages, and the model files to give them.
    pub rivals: Option<Rivals>,
}

/// The rivals.
#[derive(Clone, Debug)]
pub struct Rivals {
    /// The interpreter.
    pub python: PathBuf,
    /// ONNX file of the image model.
    pub image: Option<PathBuf>,
    /// ONNX files of Segment Anything.
    pub sam: Option<[PathBuf; 2]>,
}

/// Measures.
///
/// # Errors
/// If a model does not open or run, or threads do not start.
pub fn run(options: &InferenceOptions) -> anyhow::Result<InferenceReport> {
    let mut report =
        InferenceReport::new(Machine::here(), &options.session.providers, options.points_per_batch);
    let mut sets = vec![&options.gpus[..1]];
    sets.extend((options.gpus.len() > 1).then_some(&options.gpus[..]));
    let pool = ThreadPoolBuilder::new().num_threads(options.n_threads).build()?;
    for gpus in sets {
        if let Some(models) = &options.models {
            report.measured.push(crops(models, gpus, options)?);
        }
        if let Some(dir) = &options.segmenter {
            for &grid in &options.grids {
                // No mask passes, so that the models' work is all there is; then all pass and are filtered.
                for predicted_iou in [f32::INFINITY, 0.0] {
                    let settings = SamSettings {
                        points_per_side: grid,
                        points_per_batch: options.points_per_batch,
                        predicted_iou,
                        ..SamSettings::default()
                    };
                    report.measured.push(photos(dir, settings, gpus, &pool, options)?);
                }
            }
        }
    }
    if let Some(rivals) = &options.rivals {
        report.rivals = rivals.measure(options)?;
    }
    Ok(report)
}

/// Runs `step` on `n_threads` threads until the time is over; returns how many items were done, and the seconds.
fn until<E: Send>(
    secs: f64,
    n_threads: usize,
    step: impl Fn() -> Result<usize, E> + Sync,
) -> Result<(usize, f64), E> {
    let (done, start) = (AtomicUsize::new(0), Instant::now());
    let end = start + Duration::from_secs_f64(secs);
    let work = || {
        while Instant::now() < end {
            done.fetch_add(step()?, Ordering::Relaxed);
        }
        Ok(())
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..n_threads).map(|_| scope.spawn(work)).collect();
        threads
            .into_iter()
            .try_for_each(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    })?;
    Ok((done.into_inner(), start.elapsed().as_secs_f64()))
}

fn picture(width_px: u32, height_px: u32, seed: u32) -> RgbImage {
    RgbImage::from_fn(width_px, height_px, |x, y| {
        let noise =
            (x.wrapping_mul(2_654_435) ^ (y * 40_503) ^ (seed * 97)).wrapping_mul(2_246_822_519) >> 28;
        Rgb([0, 1, 2].map(|c| (x * (1 + c) / 5 + y * (4 - c) / 7 + noise) as u8))
    })
}

/// The time during which each GPU had work, of two readings.
fn between(before: &[GpuLoad], after: &[GpuLoad], secs: f64) -> Vec<f64> {
    before.iter().zip(after).map(|(before, after)| (after.busy_secs - before.busy_secs) / secs).collect()
}

fn crops(models: &ModelDir, gpus: &[u32], options: &InferenceOptions) -> anyhow::Result<Measured> {
    let (of_lanes, session) = (models.clone(), options.session.clone());
    let open = move |gpu| of_lanes.image_encoder(&SessionOptions { gpu, ..session.clone() });
    let encoders = SharedEncoders::new(gpus, Box::new(open));
    let size_px = models.preprocess().map_or(224, |preprocess| preprocess.size_px());
    let view: Vec<Crop> =
        (0..CROPS_PER_VIEW as u32).map(|seed| Crop::whole(picture(size_px, size_px, seed))).collect();
    let n_threads = SharedEncoders::n_views(gpus);
    let step = || encoders.embed(view.clone()).map(|_| view.len());
    // Every lane opens its model and runs it a few times.
    until(options.secs / 2.0, n_threads, step)?;
    let (before, kernels) = (encoders.loads(), Kernels::start(gpus));
    let (n, secs) = until(options.secs, n_threads, step)?;
    Ok(Measured {
        what: "crops".into(),
        gpus: gpus.to_vec(),
        per_sec: n as f64 / secs,
        n,
        secs,
        busy_shares: between(&before, &encoders.loads(), secs),
        kernel_shares: kernels.shares(),
    })
}

fn photos(
    dir: &Path,
    settings: SamSettings,
    gpus: &[u32],
    pool: &ThreadPool,
    options: &InferenceOptions,
) -> anyhow::Result<Measured> {
    let [width_px, height_px] = PHOTO_PX;
    let focal_px = f64::from(width_px);
    let view = View {
        name: "photo".into(),
        image_path: "photo.png".into(),
        intrinsics: Intrinsics {
            width_px,
            height_px,
            focal_x_px: focal_px,
            focal_y_px: focal_px,
            centre_x_px: f64::from(width_px) / 2.0,
            centre_y_px: f64::from(height_px) / 2.0,
            distortion: Distortion::None,
        },
        camera_from_world: glam::DAffine3::IDENTITY,
    };
    let image = picture(width_px, height_px, 1);
    let loaded = LoadedImage { view, image, undistorter: None, valid: None, is_rotated: false };
    let what = format!(
        "photos, grid {}{}",
        settings.points_per_side,
        if settings.predicted_iou > 1.0 { ", models alone" } else { ", all masks filtered" }
    );
    let segmenter = SamSegmenter::open(dir, settings, &options.session, gpus)?;
    let n_threads = segmenter.concurrency().unwrap_or(1);
    let step = || {
        let input = SegmentInput { pool: Some(pool), ..SegmentInput::new(&loaded, None) };
        segmenter.segment(&input).map(|_| 1)
    };
    // Every model runs once or twice.
    until(options.secs / 10.0, n_threads, step)?;
    let (before, kernels) = (segmenter.loads(), Kernels::start(gpus));
    let (n, secs) = until(options.secs, n_threads, step)?;
    Ok(Measured {
        what,
        gpus: gpus.to_vec(),
        per_sec: n as f64 / secs,
        n,
        secs,
        busy_shares: between(&before, &segmenter.loads(), secs),
        kernel_shares: kernels.shares(),
    })
}

impl Rivals {
    fn measure(&self, options: &InferenceOptions) -> anyhow::Result<Vec<Rival>> {
        let sam = self.sam.as_ref();
        let on_gpu = !options.session.is_on_cpu();
        let asked = json!({
            "image": self.image,
            "encoder": sam.map(|[encoder, _]| encoder),
            "decoder": sam.map(|[_, decoder]| decoder),
            "batch": 256,
            "grids": options.grids,
            "points_per_batch": options.points_per_batch,
            "secs": options.secs,
            "device": if on_gpu { "cuda" } else { "cpu" },
        });
        let mut command = Command::new(&self.python);
        command.args(["-c", RIVALS, &asked.to_string()]);
        let output = command.stdin(Stdio::null()).stderr(Stdio::inherit()).output()?;
        let found: Value = serde_json::from_slice(&output.stdout)?;
        if let Some(failed) = found.get("failed") {
            anyhow::bail!("{}: {failed}", self.python.display());
        }
        let rates = found.as_object().into_iter().flatten();
        Ok(rates
            .filter_map(|(what, rate)| Some(Rival { what: what.clone(), per_sec: rate.as_f64()? }))
            .collect())
    }
}
