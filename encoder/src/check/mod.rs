//! Checks that photos, poses and scene belong together, before any expensive work.
//!
//! The check draws sample views of the scene, compares each with its photo and, where they differ, looks for
//! common mistakes in poses, intrinsics and splat.

mod diagnosis;
mod mistake;
mod suspicion;
#[cfg(test)]
mod tests;
mod view;

use slag_common::{Gaussians, durable};

use crate::ingest::IngestError;
use crate::raster::{LoadedScene, Rasterizer};
use diagnosis::{ALIKE_DB, FLAWLESS_DB, Means, Samples, looks_alike};
use view::{MIN_COVERAGE, PLAIN_DB, at_width, mean, picture, picture_name};

pub(crate) use diagnosis::ViewCheck;
pub use diagnosis::{CheckOptions, CheckReport};
pub(crate) use mistake::Alignment;
pub use mistake::{FrameCandidate, FrameCause, Mistake, align, nerfstudio_defaults};
pub use suspicion::{Suspicion, suspicions};
pub use view::{CheckError, CheckView, psnr_db};

/// Width at which an encode compares views.
const QUICK_WIDTH_PX: u32 = 240;

/// A drawing of another place is 3 dB less like a photo than its mean colour: twice the variance. Half of that allows
/// for a splat without its ground's texture.
const UNLIKE_DB: f64 = 1.5;

/// A view is far below others if its squared error is six times theirs.
const FAR_BELOW_DB: f64 = 8.0;

/// Draws the views of a scene and compares them with their photos.
///
/// The scene is loaded once. Views are taken one at a time, so that one photo is in memory, plus `diagnosis_views`
/// small copies. Photos that cannot be read are left out and named in the report.
///
/// # Errors
/// [`CheckError`] if no photo can be read, a view cannot be drawn or a picture cannot be written. A scene that
/// does not fit its photos is no error; the report then has a [`Diagnosis`].
pub fn check<V>(
    scene: &Gaussians,
    views: V,
    rasterizer: &dyn Rasterizer,
    options: &CheckOptions,
) -> Result<CheckReport, CheckError>
where
    V: IntoIterator<Item = Result<CheckView, IngestError>, IntoIter: ExactSizeIterator>,
{
    let views = views.into_iter();
    let n_views = views.len();
    if n_views == 0 {
        return Err(CheckError::NoViews);
    }
    if let Some(dir) = &options.pictures_dir {
        fs_err::create_dir_all(dir)?;
    }
    let loaded = rasterizer.load(scene)?;
    let (mut checks, mut unreadable) = (Vec::with_capacity(n_views), Vec::<IngestError>::new());
    let mut unusable_gaussians = 0;
    let mut samples = Samples::new(n_views, options.diagnosis_views, options.diagnosis_width_px);
    for (index, view) in views.enumerate() {
        let view = match view {
            Ok(view) => view,
            Err(error) => {
                unreadable.push(error);
                continue;
            }
        };
        let small = at_width(&view, options.width_px)?;
        let drawing = small.draw(&*loaded)?;
        unusable_gaussians = unusable_gaussians.max(drawing.counters.unusable);
        if let Some(dir) = &options.pictures_dir {
            let picture = picture(&small, &drawing)?;
            durable::write(&dir.join(picture_name(index, &view.name)), &picture)?;
        }
        checks.push(ViewCheck {
            name: view.name.clone(),
            psnr_db: small.likeness_db(&drawing),
            flat_psnr_db: small.flat_psnr_db(),
            covered_share: mean(
                drawing.coverage.iter().map(|&alpha| f64::from(u8::from(alpha > MIN_COVERAGE))),
            ),
            visible_gaussians: drawing.counters.visible,
            is_far_below: false,
        });
        samples.add(index, &view)?;
    }
    if checks.is_empty() {
        return Err(CheckError::NoPhotos { n_views, first: unreadable.remove(0) });
    }
    mark_far_below(&mut checks);
    let means = means_of(&checks);
    let is_suspect = options.suspicions.iter().any(|suspicion| suspicion.mistake.is_some());
    let diagnosis = if means.psnr_db < FLAWLESS_DB || !means.fit() || is_suspect {
        let found = samples.diagnose(scene, &*loaded, rasterizer, &means, options)?;
        // Matching drawings: only a mistake that improves them counts.
        Some(found).filter(|found| !means.fit() || found.mistake.is_some())
    } else {
        None
    };
    let found = diagnosis.as_ref().and_then(|diagnosis| diagnosis.mistake);
    let mut suspicions: Vec<String> =
        options.suspicions.iter().filter_map(|suspicion| suspicion.after_drawing(found)).collect();
    suspicions.extend(odd_views(&checks).filter(|_| means.average_fits()));
    Ok(CheckReport {
        mean_psnr_db: means.psnr_db,
        mean_flat_psnr_db: means.flat_psnr_db,
        mean_covered_share: means.covered_share,
        views: checks,
        unreadable: unreadable.iter().map(ToString::to_string).collect(),
        unusable_gaussians,
        suspicions,
        notes: Vec::new(),
        diagnosis,
    })
}

/// Whether a drawing looks clearly less like its photo than a plain colour does, where the splat covers it; `None` of a
/// photo that has one colour there.
pub(crate) fn is_unlike(photo: CheckView, scene: &dyn LoadedScene) -> Result<Option<bool>, CheckError> {
    let mut small = at_width(&photo, QUICK_WIDTH_PX)?;
    let drawing = small.draw(scene)?;
    // A splat need not show the sky.
    small.leave_out(&drawing);
    if small.is_plain() {
        return Ok(None);
    }
    let psnr_db = small.psnr_db(|pixel, c| drawing.rgb[pixel * 3 + c]);
    Ok(Some(!looks_alike(psnr_db + UNLIKE_DB, small.flat_psnr_db())))
}

fn means_of(checks: &[ViewCheck]) -> Means {
    // A photo of one colour, as under a lens cap, tells nothing of the others.
    let mut told: Vec<&ViewCheck> = checks.iter().filter(|c| c.flat_psnr_db < PLAIN_DB).collect();
    if told.is_empty() {
        told = checks.iter().collect();
    }
    Means {
        psnr_db: mean(told.iter().map(|c| c.psnr_db)),
        flat_psnr_db: mean(told.iter().map(|c| c.flat_psnr_db)),
        covered_share: mean(checks.iter().map(|c| c.covered_share)),
        most_fit: 2 * told.iter().filter(|c| c.fits()).count() > told.len(),
    }
}

/// Marks the views that are far less like their photos than the others are, with none between: half of the poses or
/// cameras may be wrong, and the average good. Photos with little on them gain little over a plain colour, but are
/// drawn well.
fn mark_far_below(checks: &mut [ViewCheck]) {
    let gain_db = |check: &ViewCheck| check.psnr_db - check.flat_psnr_db;
    let mut told: Vec<&ViewCheck> = checks.iter().filter(|c| c.flat_psnr_db < PLAIN_DB).collect();
    told.sort_by(|a, b| gain_db(b).total_cmp(&gain_db(a)));
    // A single outstanding view says nothing against the others.
    let is_split = |(n, pair): (usize, &[&ViewCheck])| {
        4 * (n + 1) >= told.len() && gain_db(pair[0]) - gain_db(pair[1]) >= FAR_BELOW_DB
    };
    let Some(n) = told.windows(2).enumerate().position(is_split) else { return };
    let least_gain_db = gain_db(told[n]);
    let least_db = told[..=n].iter().map(|c| c.psnr_db).fold(ALIKE_DB + FAR_BELOW_DB, f64::min);
    for check in checks {
        check.is_far_below = gain_db(check) < least_gain_db && check.psnr_db + FAR_BELOW_DB <= least_db;
    }
}

fn odd_views(checks: &[ViewCheck]) -> impl Iterator<Item = String> {
    let mut odd = checks.iter().filter(|view| !view.fits());
    let first = odd.next();
    let (n, of) = (1 + odd.count(), checks.len());
    first.into_iter().map(move |first| {
        format!(
            "{n} of {of} views look less like their photos than a plain colour does, or far less than the others do, the \
             first is {} ({:.1} dB): look at the poses and intrinsics of these photos, or leave them out",
            first.name, first.psnr_db
        )
    })
}
