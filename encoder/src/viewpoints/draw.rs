//! Images of a splat, and the poses file that says that they are drawings.

use std::io::{self, Cursor};
use std::path::Path;

use glam::{DAffine3, DMat3, DVec3};
use image::ImageFormat;
use rayon::prelude::*;
use serde_json::{Value, json};
use slag_common::{Intrinsics, durable};

use super::looks::pinhole;
use super::plan::{Viewpoint, ViewpointPlan};
use crate::progress::Progress;
use crate::raster::{LoadedScene, RasterError, RasterView};

/// Name of the poses file.
pub const POSES_FILE: &str = "transforms.json";
/// Size of drawings, pixels: that of the photos that the segmenter learnt on, enlarged little.
const SIZE_PX: [u32; 2] = [800, 600];
/// What shows through holes: grey is no thing's outline.
const BACKGROUND: [f32; 3] = [0.5; 3];

#[derive(Debug, thiserror::Error)]
pub enum DrawError {
    #[error("view {view}: {source}")]
    Raster { view: String, source: RasterError },
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// A view to draw, with its file's name below `images/`.
#[derive(Clone, Debug)]
pub struct DrawnView {
    pub name: String,
    pub view: RasterView,
    /// Further members of its frame in the poses file.
    pub about: Value,
}

/// Returns the views of a plan; their names are in the plan's order.
pub(crate) fn views_of(plan: &ViewpointPlan) -> Vec<DrawnView> {
    let [width_px, height_px] = SIZE_PX;
    let intrinsics = pinhole(width_px, height_px);
    let view = |(number, viewpoint): (usize, &Viewpoint)| DrawnView {
        name: format!("drawn-{number:04}.png"),
        view: RasterView { camera_from_world: viewpoint.camera_from_world, intrinsics },
        about: json!({ "verdict": viewpoint.verdict }),
    };
    plan.views.iter().enumerate().map(view).collect()
}

/// Draws views into a folder: `images/` and, when all are there, the poses file. `drawn_from`: the splat, as the
/// poses file names it; `about`: further members of that file.
pub fn draw(
    folder: &Path,
    views: &[DrawnView],
    scene: &dyn LoadedScene,
    drawn_from: &str,
    about: Value,
    progress: &dyn Progress,
) -> Result<(), DrawError> {
    progress.begin("draw", "view", views.len() as u64, 0);
    let draw_one = |view: &DrawnView| {
        let failed = |source| DrawError::Raster { view: view.name.clone(), source };
        let drawing = scene.draw(&view.view, BACKGROUND).map_err(failed)?;
        let path = folder.join("images").join(&view.name);
        path.parent().map_or(Ok(()), fs_err::create_dir_all)?;
        let mut png = Cursor::new(Vec::new());
        drawing.image().write_to(&mut png, ImageFormat::Png).map_err(io::Error::other)?;
        durable::write(&path, png.get_ref())?;
        progress.advance(1);
        Ok::<_, DrawError>(())
    };
    views.par_iter().map(draw_one).collect::<Vec<_>>().into_iter().collect::<Result<Vec<()>, _>>()?;
    progress.end();
    let text = serde_json::to_vec_pretty(&poses(views, drawn_from, about)).map_err(io::Error::from)?;
    Ok(durable::write(&folder.join(POSES_FILE), &text)?)
}

/// Returns nerfstudio's `transforms.json` of views: world from camera, OpenGL axes.
fn poses(views: &[DrawnView], drawn_from: &str, about: Value) -> Value {
    let frame = |view: &DrawnView| {
        let mut frame = json!({
            "file_path": format!("images/{}", view.name),
            "transform_matrix": opengl_rows(view.view.camera_from_world),
        });
        extend(&mut frame, camera(&view.view.intrinsics));
        extend(&mut frame, view.about.clone());
        frame
    };
    let mut poses = json!({
        "drawn_from": drawn_from,
        "camera_model": "PINHOLE",
        "frames": views.iter().map(frame).collect::<Vec<_>>(),
    });
    extend(&mut poses, about);
    poses
}

fn camera(intrinsics: &Intrinsics) -> Value {
    json!({
        "w": intrinsics.width_px,
        "h": intrinsics.height_px,
        "fl_x": intrinsics.focal_x_px,
        "fl_y": intrinsics.focal_y_px,
        "cx": intrinsics.centre_x_px,
        "cy": intrinsics.centre_y_px,
    })
}

fn extend(object: &mut Value, with: Value) {
    if let (Value::Object(object), Value::Object(with)) = (object, with) {
        object.extend(with);
    }
}

fn opengl_rows(camera_from_world: DAffine3) -> [[f64; 4]; 4] {
    let opencv_from_opengl = DAffine3::from_mat3(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
    let DAffine3 { matrix3: m, translation: t } = camera_from_world.inverse() * opencv_from_opengl;
    let row = |i: usize| [m.x_axis[i], m.y_axis[i], m.z_axis[i], t[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}
