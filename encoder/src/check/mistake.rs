//! Common mistakes in poses, intrinsics and splats, and their corrections.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde::Serialize;
use slag_common::{Gaussians, Similarity, View};
use slag_math::eigen::eigen_symmetric;

use crate::raster::RasterView;

#[derive(Clone, Copy, Debug, PartialEq, Serialize, thiserror::Error)]
#[serde(rename_all = "snake_case")]
pub enum Mistake {
    /// The camera axes are OpenGL's (x right, y up, z back).
    #[error("the poses have OpenGL camera axes; negate the y and z rows of camera-from-world")]
    OpenGlAxes,
    #[error("the poses are world-from-camera; invert them")]
    WorldFromCamera,
    /// Both, as in a NeRF `transforms.json`.
    #[error("the poses are world-from-camera with OpenGL axes; invert them, then negate the y and z rows")]
    WorldFromOpenGlCamera,
    /// The matrices of a `transforms.json` are camera-from-world, with OpenCV axes.
    #[error(
        "the matrices of transforms.json are camera-from-world with OpenCV axes; invert them, then negate the y and z columns"
    )]
    CameraFromWorld,
    /// The same with OpenGL axes.
    #[error("the matrices of transforms.json are camera-from-world; invert them")]
    OpenGlCameraFromWorld,
    /// The photos are turned by 180 degrees against their cameras.
    #[error(
        "the photos are stored upside down against their cameras, perhaps with an EXIF orientation; turn their pixels \
         (exiftran -a, or mogrify -auto-orient)"
    )]
    UpsideDown,
    /// The focal lengths must be multiplied by this factor.
    #[error(
        "the focal length is {:.3} times too {}; multiply it by {}",
        if *.0 < 1.0 { 1.0 / .0 } else { *.0 },
        if *.0 < 1.0 { "long" } else { "short" },
        (.0 * 1000.0).round() / 1000.0
    )]
    FocalScale(f64),
    /// Focal lengths and centre are those of photos this many times as large.
    #[error(
        "the intrinsics belong to photos {0:.3} times as large; divide focal lengths and principal point by {0:.3}"
    )]
    IntrinsicsOfSize(f64),
    /// The centre alone is that of photos this many times as large.
    #[error(
        "the principal point belongs to photos {0:.3} times as large, the focal lengths do not; divide the principal point \
         by {0:.3}"
    )]
    CentreOfSize(f64),
    /// The principal point is at 0 instead of the middle.
    #[error("the principal point is at 0; set it to half the width and half the height")]
    CentreAtZero,
    /// Principal point, and perhaps focal lengths, are shares of the image: x and y must be multiplied by these.
    #[error(
        "the {} of the image, not pixels; multiply by width and height",
        if focal_by[0] == 1.0 { "principal point is a share" } else { "intrinsics are shares" }
    )]
    SharesOfImage { centre_by: [f64; 2], focal_by: [f64; 2] },
    /// x and y of the principal point are swapped.
    #[error("x and y of the principal point are swapped; swap them back")]
    CentreSwapped,
    /// The scene is larger than the cameras' world by this factor.
    #[error(
        "the scene is {0:.4} times as large as the cameras' world; multiply the camera positions by {0:.4}"
    )]
    SceneScale(f64),
    /// The worlds differ by right angles: axis i of the splat's is this axis of the cameras', counted from 1, with
    /// its sign.
    #[error("the worlds of splat and cameras have other axes{}", told_axes(*.0))]
    WorldAxes([i8; 3]),
    /// The worlds differ by a similarity.
    #[error("{}", .0.cause)]
    Frame(FrameCandidate),
    /// The splat is mirrored along this axis, 0 to 2.
    #[error(
        "splat and poses are mirror images along {}; export one of them with right-handed axes",
        ["x", "y", "z"][(*.0).min(2)]
    )]
    Mirrored(usize),
    /// The splat's rotations are x, y, z, w where the file's format has w first.
    #[error("the splat's rotations are x, y, z, w, and its format has w first (rot_0); convert it again")]
    RotationsXyzw,
    /// The splat's rotations turn the other way.
    #[error("the splat's rotations are inverted, world to Gaussian; convert it again")]
    RotationsInverted,
    /// The splat's harmonics above degree 0.
    #[error(
        "the splat's harmonics (f_rest) are wrong, and it fits better without them; export it again (encode with photos does \
         not use them)"
    )]
    Harmonics,
    /// The splat has scales instead of their logarithms, or opacities instead of logits.
    #[error("the splat file has {}", match (scales, opacities) {
        (true, false) => "scales instead of their logarithms; use --activated scales",
        (false, _) => "opacities instead of logits; use --activated opacities",
        (true, true) => "scales and opacities instead of logarithms and logits; use --activated scales,opacities",
    })]
    Activated { scales: bool, opacities: bool },
}

/// A similarity between the world of the poses and that of the splat, and why it may hold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FrameCandidate {
    pub cause: FrameCause,
    pub splat_from_poses: Similarity,
}

/// Why a splat's world may differ from that of its poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, thiserror::Error)]
#[serde(rename_all = "snake_case")]
pub enum FrameCause {
    /// The splat is in the world of a second set of poses.
    #[error("the splat is in the world of --also-poses, not in that of --views")]
    OtherPoses,
    /// The splat is an export of nerfstudio in its trained frame, and the file that states it is missing.
    #[error(
        "the splat is in nerfstudio's trained frame (oriented, centred and scaled by its defaults); put the run's \
         dataparser_transforms.json beside the splat"
    )]
    NerfstudioDefaults,
    /// The stated frame is not that of the splat, which is in the world of the poses.
    #[error(
        "the splat is in the world of the poses, not in the frame that the file states; use --splat-frame none"
    )]
    FrameFileNotMeant,
    /// An offset, such as that of UTM coordinates, is part of one world only.
    #[error("the splat is shifted against the poses")]
    Shifted,
}

/// Nerfstudio's world axes from COLMAP's: x and y swapped, z negated.
const COLMAP_AXES: [i8; 3] = [2, 1, -3];

/// Factors of focal lengths that are tried where drawings and photos differ; the best is refined.
const FOCAL_SCALES: [f64; 6] = [0.5, 2.0, 0.25, 4.0, 0.35, 2.8];
/// Factor between neighbouring focal lengths that are always tried, and the steps up and down from the given one, to
/// 0.7 and 1.43: the gain of the right one is lost a few per cent away from it.
const FOCAL_STEP: f64 = 1.03;
const FOCAL_STEPS: i32 = 12;

impl Mistake {
    /// Drawings still look like their photos under these.
    pub(super) const UNNOTICED: [Self; 2] = [Self::RotationsXyzw, Self::RotationsInverted];

    /// Focal lengths near the given one: drawings still look like their photos.
    pub(super) fn focal_lengths() -> impl Iterator<Item = Self> {
        let steps = (-FOCAL_STEPS..=FOCAL_STEPS).filter(|step| *step != 0);
        steps.map(|step| Self::FocalScale(FOCAL_STEP.powi(step)))
    }

    /// Mistakes to try where drawings and photos differ, beside frames.
    pub(super) fn common() -> Vec<Self> {
        let cameras = [
            Self::OpenGlAxes,
            Self::WorldFromCamera,
            Self::WorldFromOpenGlCamera,
            Self::CameraFromWorld,
            Self::OpenGlCameraFromWorld,
            Self::UpsideDown,
        ];
        let focals = FOCAL_SCALES.map(Self::FocalScale);
        let scales = [0.001, 0.01, 0.1, 10.0, 100.0, 1000.0].map(Self::SceneScale);
        let axes = right_angles().into_iter().map(Self::WorldAxes);
        let mirrored = (0..3).map(Self::Mirrored);
        cameras.into_iter().chain(focals).chain(scales).chain(axes).chain(mirrored).collect()
    }

    /// What explains the same data as well.
    pub(super) fn alternative(self) -> Option<Self> {
        match self {
            Self::IntrinsicsOfSize(factor) => Some(Self::CentreOfSize(factor)),
            _ => None,
        }
    }

    /// Returns the similarity from the world of the poses to that of the splat; `None` for other mistakes.
    pub fn splat_from_poses(self) -> Option<Similarity> {
        match self {
            Self::SceneScale(factor) => Some(Similarity::from_scale(factor)),
            Self::WorldAxes(axes) => Some(from_axes(axes)),
            Self::Frame(frame) => Some(frame.splat_from_poses),
            _ => None,
        }
    }

    pub(crate) fn corrected(self, view: &RasterView) -> RasterView {
        let mut corrected = *view;
        let (pose, camera) = (&mut corrected.camera_from_world, &mut corrected.intrinsics);
        let turned = |x, y, z| DAffine3::from_mat3(DMat3::from_diagonal(DVec3::new(x, y, z)));
        match self {
            Self::OpenGlAxes => *pose = turned(1.0, -1.0, -1.0) * *pose,
            Self::WorldFromCamera => *pose = pose.inverse(),
            Self::WorldFromOpenGlCamera => *pose = turned(1.0, -1.0, -1.0) * pose.inverse(),
            Self::CameraFromWorld => *pose = pose.inverse() * turned(1.0, -1.0, -1.0),
            Self::OpenGlCameraFromWorld => {
                *pose = turned(1.0, -1.0, -1.0) * pose.inverse() * turned(1.0, -1.0, -1.0);
            }
            Self::UpsideDown => {
                *pose = turned(-1.0, -1.0, 1.0) * *pose;
                camera.centre_x_px = f64::from(camera.width_px) - camera.centre_x_px;
                camera.centre_y_px = f64::from(camera.height_px) - camera.centre_y_px;
            }
            Self::FocalScale(factor) => {
                camera.focal_x_px *= factor;
                camera.focal_y_px *= factor;
            }
            Self::IntrinsicsOfSize(factor) => {
                camera.focal_x_px /= factor;
                camera.focal_y_px /= factor;
                camera.centre_x_px /= factor;
                camera.centre_y_px /= factor;
            }
            Self::CentreOfSize(factor) => {
                camera.centre_x_px /= factor;
                camera.centre_y_px /= factor;
            }
            Self::CentreAtZero => {
                camera.centre_x_px = f64::from(camera.width_px) / 2.0;
                camera.centre_y_px = f64::from(camera.height_px) / 2.0;
            }
            Self::SharesOfImage { centre_by, focal_by } => {
                camera.focal_x_px *= focal_by[0];
                camera.focal_y_px *= focal_by[1];
                camera.centre_x_px *= centre_by[0];
                camera.centre_y_px *= centre_by[1];
            }
            Self::CentreSwapped => std::mem::swap(&mut camera.centre_x_px, &mut camera.centre_y_px),
            Self::SceneScale(_) | Self::WorldAxes(_) | Self::Frame(_) => {
                if let Some(similarity) = self.splat_from_poses() {
                    *pose = similarity.camera_from_target(*pose);
                }
            }
            _ => {}
        }
        corrected
    }

    pub(super) fn is_of_splat(self) -> bool {
        use Mistake::{Activated, Harmonics, Mirrored, RotationsInverted, RotationsXyzw};
        matches!(self, Mirrored(_) | RotationsXyzw | RotationsInverted | Harmonics | Activated { .. })
    }

    /// The splat with the mistake corrected, with colours of degree 0; `None` for mistakes of other inputs.
    pub(crate) fn corrected_splat(self, scene: &Gaussians) -> Option<Gaussians> {
        if !self.is_of_splat() {
            return None;
        }
        let mut corrected = Gaussians {
            means_in_world: scene.means_in_world.clone(),
            rotations_wxyz: scene.rotations_wxyz.clone(),
            scales: scene.scales.clone(),
            opacities: scene.opacities.clone(),
            sh_dc: scene.sh_dc.clone(),
            ..Gaussians::default()
        };
        match self {
            Self::Mirrored(axis) => {
                corrected.means_in_world.iter_mut().for_each(|mean| mean[axis] = -mean[axis]);
                // The mirrored rotation turns the other way about the axes in the mirror's plane.
                let mirror = |wxyz: &mut [f32; 4]| {
                    (0..3).filter(|at| *at != axis).for_each(|at| wxyz[at + 1] = -wxyz[at + 1]);
                };
                corrected.rotations_wxyz.iter_mut().for_each(mirror);
            }
            Self::RotationsXyzw => corrected.rotations_wxyz.iter_mut().for_each(|xyzw| xyzw.rotate_right(1)),
            Self::RotationsInverted => {
                corrected.rotations_wxyz.iter_mut().for_each(|wxyz| wxyz[0] = -wxyz[0])
            }
            Self::Activated { scales, opacities } => corrected.deactivate(scales, opacities),
            _ => {}
        }
        Some(corrected)
    }
}

/// Returns the frames in which nerfstudio trains by default: cameras centred at their mean, the mean of their up
/// axes turned to z, scaled so that the largest coordinate of a camera is 1 (`auto_orient_and_center_poses`,
/// methods `up` of its own data sets and `none` of ScanNet), each with and without a change of axes from COLMAP's.
pub fn nerfstudio_defaults(views: &[View]) -> Vec<FrameCandidate> {
    let world_from_camera: Vec<DAffine3> =
        views.iter().map(|view| view.camera_from_world.inverse()).collect();
    let mut candidates = Vec::new();
    for axes in [Similarity::IDENTITY, from_axes(COLMAP_AXES)] {
        let centres: Vec<DVec3> =
            world_from_camera.iter().map(|pose| axes.transform_point(pose.translation)).collect();
        let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        // Up is against the y axis of OpenCV's cameras.
        let up: DVec3 = world_from_camera.iter().map(|pose| -(axes.rotation * pose.matrix3.y_axis)).sum();
        let oriented = up.try_normalize().map(|up| DQuat::from_rotation_arc(up, DVec3::Z));
        for rotation in oriented.into_iter().chain([DQuat::IDENTITY]) {
            let centred = Similarity { rotation, translation: -(rotation * mean), ..Similarity::IDENTITY };
            let coordinate = |c: &DVec3| centred.transform_point(*c).abs().max_element();
            let largest = centres.iter().map(coordinate).fold(0.0_f64, f64::max);
            if largest > 0.0 && largest.is_finite() {
                let splat_from_poses = Similarity::from_scale(1.0 / largest).after(&centred).after(&axes);
                candidates.push(FrameCandidate { cause: FrameCause::NerfstudioDefaults, splat_from_poses });
            }
        }
    }
    candidates
}

/// Returns the rotation to a world whose axis i is axis |axes[i]| of the old one, counted from 1, with its sign.
fn from_axes(axes: [i8; 3]) -> Similarity {
    let row = |axis: i8| {
        let mut row = DVec3::ZERO;
        row[usize::from(axis.unsigned_abs().clamp(1, 3)) - 1] = f64::from(axis.signum());
        row
    };
    let matrix = DMat3::from_cols(row(axes[0]), row(axes[1]), row(axes[2])).transpose();
    Similarity::from_rotation(DQuat::from_mat3(&matrix).normalize())
}

/// The 23 rotations by right angles other than the identity, as axes of [`from_axes`].
fn right_angles() -> Vec<[i8; 3]> {
    let mut all = Vec::new();
    for (order, parity) in
        [([1, 2, 3], 1), ([2, 3, 1], 1), ([3, 1, 2], 1), ([2, 1, 3], -1), ([1, 3, 2], -1), ([3, 2, 1], -1)]
    {
        for signs in 0..8_u8 {
            let sign = |axis: u8| if signs >> axis & 1 == 0 { 1 } else { -1 };
            let axes: [i8; 3] = [order[0] * sign(0), order[1] * sign(1), order[2] * sign(2)];
            if parity * sign(0) * sign(1) * sign(2) == 1 && axes != [1, 2, 3] {
                all.push(axes);
            }
        }
    }
    all
}

fn told_axes(axes: [i8; 3]) -> String {
    let name = |axis: i8| {
        let letter = ["x", "y", "z"][usize::from(axis.unsigned_abs().clamp(1, 3)) - 1];
        if axis < 0 { format!("-{letter}") } else { letter.to_owned() }
    };
    let [x, y, z] = axes.map(name);
    let cause = match axes {
        COLMAP_AXES => " (nerfstudio's world against COLMAP's)",
        [1, -3, 2] => " (z up against y up)",
        [1, 3, -2] => " (y up against z up)",
        [1, -2, -3] => " (y and z negated: OpenGL's world against OpenCV's)",
        _ => "",
    };
    format!("{cause}: the splat's x, y, z are the cameras' {x}, {y}, {z}")
}

const MIN_CAMERAS: usize = 3;
/// Cameras whose second-largest spread is below this share of the largest stand on a line: the rotation about it
/// is undetermined.
const MIN_SPREAD: f64 = 1e-3;
/// Points nearer than this to their mean, relative to its distance from the origin, coincide.
const ROUNDING: f64 = 1e-12;

/// The similarity that best maps one set of camera centres to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Alignment {
    /// From the first set's world to the second's.
    pub similarity: Similarity,
    pub(crate) n_cameras: usize,
    /// RMS of the remaining distances, over the RMS distance of the second set's cameras from their mean.
    pub(crate) residual: f64,
}

#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum AlignError {
    #[error(
        "{n} photos are in both sets of poses, at least {MIN_CAMERAS} are needed; give poses of the same photos, with \
         the same file names"
    )]
    Few { n: usize },
    #[error(
        "the cameras of one set of poses stand on a line or in one point, which leaves the rotation undetermined; \
         give poses of more photos"
    )]
    Line,
}

/// Aligns two sets of poses by the centres of views with equal names, or else equal file stems.
pub fn align(from: &[View], to: &[View]) -> Result<Alignment, AlignError> {
    let pairs_by = |key: fn(&View) -> &str| -> Vec<(DVec3, DVec3)> {
        let mut known: std::collections::BTreeMap<&str, Option<&View>> = std::collections::BTreeMap::new();
        for view in to {
            // A key shared by two views is ambiguous.
            known.entry(key(view)).and_modify(|known| *known = None).or_insert(Some(view));
        }
        let pair = |view: &View| {
            let other = (*known.get(key(view))?)?;
            Some((view.position_in_world(), other.position_in_world()))
        };
        from.iter().filter_map(pair).collect()
    };
    let by_name = pairs_by(|view| &view.name);
    if by_name.len() >= MIN_CAMERAS { similarity(&by_name) } else { similarity(&pairs_by(stem)) }
}

fn stem(view: &View) -> &str {
    let file = view.name.rsplit('/').next().unwrap_or(&view.name);
    file.rsplit_once('.').map_or(file, |(stem, _)| stem)
}

/// Least-squares similarity from the first points to the second: Umeyama (1991), equations 34 to 43, with the rotation
/// by Horn's quaternion (1987), which is never a reflection.
fn similarity(pairs: &[(DVec3, DVec3)]) -> Result<Alignment, AlignError> {
    let n = pairs.len();
    if n < MIN_CAMERAS {
        return Err(AlignError::Few { n });
    }
    let mean = |point: fn(&(DVec3, DVec3)) -> DVec3| pairs.iter().map(point).sum::<DVec3>() / n as f64;
    let (from_mean, to_mean) = (mean(|pair| pair.0), mean(|pair| pair.1));
    let centred: Vec<(DVec3, DVec3)> = pairs.iter().map(|(a, b)| (*a - from_mean, *b - to_mean)).collect();
    type Side = fn(&(DVec3, DVec3)) -> DVec3;
    let sides: [(Side, DVec3); 2] = [(|pair| pair.0, from_mean), (|pair| pair.1, to_mean)];
    for (side, mean) in sides {
        // Equal points differ from their mean by rounding.
        let rounding = n as f64 * (ROUNDING * mean.length()).powi(2);
        let mut covariance = vec![0.0; 9];
        for point in centred.iter().map(side) {
            for (at, entry) in covariance.iter_mut().enumerate() {
                *entry += point[at / 3] * point[at % 3];
            }
        }
        let (values, _) = eigen_symmetric(covariance, 3);
        if !(values[0] > rounding && values[1] > MIN_SPREAD * MIN_SPREAD * values[0]) {
            return Err(AlignError::Line);
        }
    }
    // sums[i][j]: the sum of from_i to_j.
    let mut sums = [[0.0; 3]; 3];
    for (a, b) in &centred {
        for (i, row) in sums.iter_mut().enumerate() {
            for (j, sum) in row.iter_mut().enumerate() {
                *sum += a[i] * b[j];
            }
        }
    }
    let [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = sums;
    #[rustfmt::skip]
    let quaternion_form = vec![
        xx + yy + zz, yz - zy,       zx - xz,       xy - yx,
        yz - zy,      xx - yy - zz,  xy + yx,       zx + xz,
        zx - xz,      xy + yx,       yy - xx - zz,  yz + zy,
        xy - yx,      zx + xz,       yz + zy,       zz - xx - yy,
    ];
    let (_, vectors) = eigen_symmetric(quaternion_form, 4);
    let rotation = DQuat::from_xyzw(vectors[1], vectors[2], vectors[3], vectors[0]).normalize();
    let (mut along, mut from_squares, mut to_squares) = (0.0, 0.0, 0.0);
    for (a, b) in &centred {
        along += b.dot(rotation * *a);
        from_squares += a.length_squared();
        to_squares += b.length_squared();
    }
    let scale = along / from_squares;
    if !(scale > 0.0 && scale.is_finite()) {
        return Err(AlignError::Line);
    }
    let found = Similarity { scale, rotation, translation: to_mean - rotation * from_mean * scale };
    let squares: f64 = pairs.iter().map(|(a, b)| found.transform_point(*a).distance_squared(*b)).sum();
    Ok(Alignment { similarity: found, n_cameras: n, residual: (squares / to_squares).sqrt() })
}
