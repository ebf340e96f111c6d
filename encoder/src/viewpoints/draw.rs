//! Images of a splat, and the poses file that says that they are drawings.

use std::f32::consts::SQRT_2;
use std::io::{self, BufReader, Cursor};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DAffine3, DMat3, DVec3};
use image::{DynamicImage, ImageFormat, Rgb, RgbImage};
use rayon::prelude::*;
use serde_json::{Value, json};
use slag_common::photo;
use slag_common::{Gaussians, Intrinsics, durable, npy};

use super::looks::pinhole;
use super::plan::{Viewpoint, ViewpointError, ViewpointPlan};
use crate::ingest;
use crate::progress::Progress;
use crate::raster::{Drawing, LoadedScene, RasterView, Rasterizer, check_near_plane};
use crate::store::remove_files;

pub const POSES_FILE: &str = "transforms.json";
/// Size of drawings, pixels: that of the photos that the segmenter learnt on, enlarged little.
const SIZE_PX: [u32; 2] = [800, 600];
/// Shows through holes: grey is no thing's outline.
const BACKGROUND: [f32; 3] = [0.5; 3];
/// Distance of the pixels that bound a sharpened pixel's colour.
const REACH_PX: i64 = 3;

/// A view to draw, with its file name below `images/`.
#[derive(Clone, Debug)]
pub struct DrawnView {
    pub name: String,
    pub view: RasterView,
    /// Further members of its frame in the poses file.
    pub about: Value,
}

/// Views of a plan, named in its order.
pub(crate) fn views_of(plan: &ViewpointPlan) -> Vec<DrawnView> {
    let intrinsics = pinhole(SIZE_PX);
    let view = |(number, viewpoint): (usize, &Viewpoint)| DrawnView {
        name: format!("drawn-{number:04}.png"),
        view: RasterView { camera_from_world: viewpoint.camera_from_world, intrinsics },
        about: json!({ "verdict": viewpoint.verdict }),
    };
    plan.views.iter().enumerate().map(view).collect()
}

/// Refuses a folder with poses or images that were not drawn, as the poses file says.
pub(crate) fn check_folder(folder: &Path) -> Result<(), ViewpointError> {
    let poses = folder.join(POSES_FILE);
    if ingest::drawn_from(&poses).is_some() {
        return Ok(());
    }
    let has_files = |path: &PathBuf| fs_err::read_dir(path).is_ok_and(|mut found| found.next().is_some());
    let images = ["images", "depth", "coverage"].map(|name| folder.join(name)).into_iter().find(has_files);
    match images.or_else(|| poses.exists().then_some(poses)) {
        Some(path) => Err(ViewpointError::Refused(format!(
            "{}: this was not drawn by slag-encoder, so it is not replaced; name another folder, or move it away",
            path.display()
        ))),
        None => Ok(()),
    }
}

/// Draws views into `images/` of a folder, `with_depth` also their arrays, then writes the poses file. Returns the
/// number of views that show nothing. `drawn_from`: the splat, as the poses file names it.
pub fn draw(
    folder: &Path,
    views: &mut [DrawnView],
    scene: &dyn LoadedScene,
    drawn_from: &str,
    with_depth: bool,
    progress: &dyn Progress,
) -> Result<usize, ViewpointError> {
    let n_empty = AtomicUsize::new(0);
    begin(folder, drawn_from)?;
    draw_images(folder, views, scene, progress, |view, drawing, _| {
        let is_empty = drawing.coverage.iter().all(|opacity| *opacity < 1.0 / 255.0);
        n_empty.fetch_add(usize::from(is_empty), Ordering::Relaxed);
        if with_depth {
            let shape = [drawing.height_px as usize, drawing.width_px as usize];
            for (of, values) in [("depth", &drawing.depth), ("coverage", &drawing.coverage)] {
                let path = folder.join(array_file(view, of));
                path.parent().map_or(Ok(()), fs_err::create_dir_all)?;
                npy::write_file(&path, &shape, values)?;
            }
        }
        Ok(drawing.image())
    })?;
    if with_depth {
        for view in &mut *views {
            // Camera z in the splat's units (nerfstudio's name), 0 where no Gaussian is; and the splat's opacity, 0 to 1.
            let [depth, coverage] = ["depth", "coverage"].map(|of| array_file(view, of));
            extend(&mut view.about, json!({ "depth_file_path": depth, "coverage_file_path": coverage }));
        }
    }
    write_poses(folder, views, drawn_from, json!({}))?;
    Ok(n_empty.into_inner())
}

/// Of a view's array of 32-bit floats, `[height][width]`, below the folder.
fn array_file(view: &DrawnView, of: &str) -> PathBuf {
    Path::new(of).join(&view.name).with_extension("npy")
}

/// As [`draw`], sharpened by how much views blur as the Gaussians grow; small Gaussians change little. `about`: further
/// members of the poses file.
pub fn draw_sharpened(
    folder: &Path,
    views: &[DrawnView],
    scene: &mut Gaussians,
    rasterizer: &dyn Rasterizer,
    drawn_from: &str,
    about: Value,
    progress: &dyn Progress,
) -> Result<(), ViewpointError> {
    check_near_plane(scene, &views.iter().map(|view| view.view).collect::<Vec<_>>())?;
    begin(folder, drawn_from)?;
    // Drawings of another plan.
    remove_files(&folder.join("images"), |name| name.starts_with("drawn-"))?;
    let scales = scene.scales.clone();
    scene.scales.iter_mut().flatten().for_each(|scale| *scale *= SQRT_2);
    let blurred = rasterizer.load(scene)?;
    draw_images(folder, views, blurred.as_ref(), progress, |_, drawing, _| Ok(drawing.image()))?;
    drop(blurred);
    scene.scales = scales;
    let loaded = rasterizer.load(scene)?;
    draw_images(folder, views, loaded.as_ref(), progress, |_, drawing, path| {
        Ok(sharpened(&drawing.image(), &read(path)?))
    })?;
    write_poses(folder, views, drawn_from, about)
}

/// Marks a folder as ours, without views, so that drawing can begin anew after an interruption.
fn begin(folder: &Path, drawn_from: &str) -> Result<(), ViewpointError> {
    check_folder(folder)?;
    fs_err::create_dir_all(folder)?;
    write_poses(folder, &[], drawn_from, json!({}))
}

fn read(path: &Path) -> Result<RgbImage, ViewpointError> {
    let input = BufReader::new(fs_err::File::open(path)?);
    let read = photo::open(input).and_then(|decoder| Ok(DynamicImage::from_decoder(decoder)?.into_rgb8()));
    read.map_err(|fault| ViewpointError::Refused(format!("{}: {fault}", path.display())))
}

/// Writes each view's drawing as `finish` makes it, which gets the file to replace.
fn draw_images(
    folder: &Path,
    views: &[DrawnView],
    scene: &dyn LoadedScene,
    progress: &dyn Progress,
    finish: impl Fn(&DrawnView, Drawing, &Path) -> Result<RgbImage, ViewpointError> + Sync,
) -> Result<(), ViewpointError> {
    progress.begin("draw", "view", views.len() as u64, 0);
    let draw_one = |view: &DrawnView| {
        let failed = |source| ViewpointError::Refused(format!("view {}: {source}", view.name));
        let drawing = scene.draw(&view.view, BACKGROUND).map_err(failed)?;
        let path = folder.join("images").join(&view.name);
        path.parent().map_or(Ok(()), fs_err::create_dir_all)?;
        let mut png = Cursor::new(Vec::new());
        finish(view, drawing, &path)?.write_to(&mut png, ImageFormat::Png)?;
        durable::write(&path, png.get_ref())?;
        progress.advance(1);
        Ok(())
    };
    views
        .par_iter()
        .map(draw_one)
        .collect::<Vec<_>>()
        .into_iter()
        .collect::<Result<Vec<()>, ViewpointError>>()?;
    progress.end();
    Ok(())
}

/// Approximates a drawing of Gaussians without extent: blur grows with their squared size, so what twice the square
/// adds is subtracted once (Richardson 1911). Colours stay within those nearby, so edges get no halos.
fn sharpened(drawn: &RgbImage, blurred: &RgbImage) -> RgbImage {
    let [low, high] = [u8::min, u8::max].map(|of| extreme(drawn, of));
    let mut sharp = drawn.clone();
    for (((value, blurred), low), high) in
        sharp.iter_mut().zip(blurred.iter()).zip(low.iter()).zip(high.iter())
    {
        let straight = 2 * i16::from(*value) - i16::from(*blurred);
        *value = straight.clamp(i16::from(*low), i16::from(*high)) as u8;
    }
    sharp
}

/// Least or greatest of each colour around each pixel.
fn extreme(image: &RgbImage, of: fn(u8, u8) -> u8) -> RgbImage {
    let along = |from: &RgbImage, [dx, dy]: [i64; 2]| {
        let (width, height) = from.dimensions();
        RgbImage::from_fn(width, height, |x, y| {
            let at =
                |x: u32, step: i64, size: u32| (i64::from(x) + step).clamp(0, i64::from(size) - 1) as u32;
            let around =
                (-REACH_PX..=REACH_PX).map(|k| *from.get_pixel(at(x, k * dx, width), at(y, k * dy, height)));
            around.fold(*from.get_pixel(x, y), |a, b| Rgb([0, 1, 2].map(|c| of(a.0[c], b.0[c]))))
        })
    };
    along(&along(image, [1, 0]), [0, 1])
}

fn write_poses(
    folder: &Path,
    views: &[DrawnView],
    drawn_from: &str,
    about: Value,
) -> Result<(), ViewpointError> {
    let text = serde_json::to_vec_pretty(&poses(views, drawn_from, about)).map_err(io::Error::from)?;
    Ok(durable::write(&folder.join(POSES_FILE), &text)?)
}

/// Nerfstudio's `transforms.json`: world from camera, OpenGL axes.
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

#[cfg(test)]
mod tests {
    use super::*;
    use slag_math::random::Random;

    /// Oracle: blurred edges of Gaussians of one size, and of twice its square, in closed form.
    #[test]
    fn edges_are_sharpened_without_halos() {
        let sigma_px = 2.0;
        // A logistic curve is within 1 % of a blurred edge.
        let edge = |sigma_px: f64| {
            RgbImage::from_fn(41, 8, |x, _| {
                let share = 1.0 / (1.0 + (-1.702 * (f64::from(x) - 20.0) / sigma_px).exp());
                Rgb([(40.0 + 160.0 * share).round() as u8, (200.0 - 160.0 * share).round() as u8, 90])
            })
        };
        let (drawn, blurred) = (edge(sigma_px), edge(sigma_px * std::f64::consts::SQRT_2));
        let sharp = sharpened(&drawn, &blurred);
        let slope = |image: &RgbImage| {
            i32::from(image.get_pixel(21, 4).0[0]) - i32::from(image.get_pixel(19, 4).0[0])
        };
        assert!(
            f64::from(slope(&sharp)) > 1.2 * f64::from(slope(&drawn)),
            "{} {}",
            slope(&sharp),
            slope(&drawn)
        );
        for (pixel, [red, green, blue]) in sharp.pixels().map(|pixel| pixel.0).enumerate() {
            assert!((40..=200).contains(&red) && (40..=200).contains(&green) && blue == 90, "{pixel}");
        }
    }

    /// Oracle: the definition, pixel by pixel.
    #[test]
    fn a_sharpened_colour_is_one_that_is_near() {
        let mut random = Random::new(48);
        let mut noise =
            || RgbImage::from_fn(19, 11, |_, _| Rgb([0; 3].map(|_| random.between(0.0, 255.0) as u8)));
        let (drawn, blurred) = (noise(), noise());
        let sharp = sharpened(&drawn, &blurred);
        for (x, y, pixel) in sharp.enumerate_pixels() {
            for c in 0..3 {
                let near =
                    drawn.enumerate_pixels().filter(|(u, v, _)| u.abs_diff(x) <= 3 && v.abs_diff(y) <= 3);
                let near: Vec<u8> = near.map(|(.., pixel)| pixel.0[c]).collect();
                let straight =
                    2 * i32::from(drawn.get_pixel(x, y).0[c]) - i32::from(blurred.get_pixel(x, y).0[c]);
                let limits =
                    [near.iter().min(), near.iter().max()].map(|limit| i32::from(*limit.expect("itself")));
                assert_eq!(i32::from(pixel.0[c]), straight.clamp(limits[0], limits[1]), "{x} {y} {c}");
            }
        }
    }
}
