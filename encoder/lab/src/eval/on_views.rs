//! Scores rendered on the held-out test views.

use slag_common::Gaussians;
use slag_common::gaussians::SH_C0;
use slag_encoder::raster::{RasterError, RasterView, Rasterizer};

use super::metrics::iou_of_sets;
use super::truth::LabelledView;

/// Views on which a thing has fewer pixels are skipped.
const MIN_PIXELS: usize = 100;

/// Renders a word's scores on the views that show its things.
///
/// Returns for each view whether the best pixel lies on one of them (1 or 0), and the intersection over union of the
/// pixels above the threshold.
pub(super) fn on_views(
    scene: &Gaussians,
    scores: &[f32],
    ids: &[u16],
    views: &[LabelledView],
    threshold: f32,
    rasterizer: &dyn Rasterizer,
) -> Result<Vec<(f32, f64)>, RasterError> {
    let mut found = Vec::new();
    if views.is_empty() {
        return Ok(found);
    }
    let mut scored = scene.clone();
    // A Gaussian without a score counts as the opposite of the query. Scores become colours of 0 to 1, so none is clamped.
    let colour = |score: f32| (if score.is_nan() { -1.0 } else { score } + 1.0) / 2.0;
    scored.sh_degree = 0;
    scored.sh_rest.clear();
    scored.sh_dc.iter_mut().zip(scores).for_each(|(sh, score)| *sh = [(colour(*score) - 0.5) / SH_C0; 3]);
    for labelled in views {
        let on_thing: Vec<bool> = labelled.ids.iter().map(|id| ids.contains(id)).collect();
        if on_thing.iter().filter(|on| **on).count() < MIN_PIXELS {
            continue;
        }
        let view = RasterView {
            camera_from_world: labelled.view.camera_from_world,
            intrinsics: labelled.view.intrinsics,
        };
        let drawing = rasterizer.draw(&scored, &view, [0.0; 3])?;
        let rendered: Vec<f32> = drawing.rgb.chunks_exact(3).map(|rgb| rgb[0]).collect();
        let best = (0..rendered.len()).max_by(|a, b| rendered[*a].total_cmp(&rendered[*b]).then(b.cmp(a)));
        let hit = best.is_some_and(|best| on_thing[best]);
        let above = rendered.iter().map(|value| *value >= colour(threshold));
        let iou = iou_of_sets(above.zip(on_thing.iter().copied())).unwrap_or(0.0);
        found.push((f32::from(u8::from(hit)), iou));
    }
    Ok(found)
}
