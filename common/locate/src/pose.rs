//! Refines a pose by reprojection errors, and estimates its covariance.

use glam::{DAffine3, DQuat, DVec2, DVec3};
use slag_common::Intrinsics;

/// A point of the map and where the photo shows it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// Index of its feature.
    pub feature: usize,
    /// Index of its landmark in the map.
    pub landmark: usize,
    /// Pixels of an ideal pinhole.
    pub at: DVec2,
    pub point_in_world: DVec3,
}

/// Rounds of refinement; it converges in four or five.
const MAX_ROUNDS: usize = 12;
/// Least standard deviation of a feature's position, pixels: that of SIFT and of the map.
const MIN_SIGMA_PX: f64 = 0.5;
/// Standard deviation of a stated focal length's relative error: calibrated phones are off by 1 to 2 %.
pub(crate) const FOCAL_SIGMA: f64 = 0.02;
/// The same of an estimate, besides what the scatter of the errors shows: depths of the map are wrong together.
const MAP_FOCAL_SIGMA: f64 = 0.005;
/// Number of matches that count as one, because errors of neighbouring landmarks are alike: on 48 photos of the labelled
/// house, positions are 2.5 times as far off as independent matches would suggest.
const ALIKE: f64 = 6.0;
/// How well a lens is known before the photo is seen, as standard deviations: of the logarithm of the ratio of its
/// vertical to its horizontal focal length, and of its principal point, as a share of the stated x coordinate.
const ASPECT_SIGMA: f64 = 0.01;
const CENTRE_SIGMA: f64 = 0.02;
/// Median length of a normal vector of two components, in standard deviations: sqrt(2 ln 2).
const MEDIAN_RADIUS: f64 = 1.1774;

/// A camera without distortion; pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    pub focal: DVec2,
    pub centre: DVec2,
}

impl Pinhole {
    pub(crate) fn new(of: &Intrinsics) -> Self {
        let (focal, centre) =
            (DVec2::new(of.focal_x_px, of.focal_y_px), DVec2::new(of.centre_x_px, of.centre_y_px));
        Self { focal, centre }
    }

    /// Projects a point of the camera frame; `None` behind the camera.
    pub(crate) fn pixel(&self, in_camera: DVec3) -> Option<DVec2> {
        (in_camera.z > 1e-9).then(|| in_camera.truncate() / in_camera.z * self.focal + self.centre)
    }

    pub(crate) fn ray(&self, pixel: DVec2) -> DVec3 {
        ((pixel - self.centre) / self.focal).extend(1.0).normalize()
    }

    /// Returns the camera with a focal length `exp(log)` times as long.
    pub(crate) fn zoomed(&self, log: f64) -> Self {
        self.changed(&[log])
    }

    /// Changes the logarithms of the focal length and of its aspect, then the principal point, as far as given.
    fn changed(&self, by: &[f64]) -> Self {
        let by: [f64; 4] = std::array::from_fn(|at| by.get(at).copied().unwrap_or(0.0));
        Self {
            focal: self.focal * by[0].exp() * DVec2::new(1.0, by[1].exp()),
            centre: self.centre + DVec2::new(by[2], by[3]),
        }
    }

    /// Logarithm of the focal length's ratio to another camera's.
    pub(crate) fn log_zoom(&self, other: &Self) -> f64 {
        (self.focal.x / other.focal.x).ln()
    }

    /// Reprojection error of a match, pixels; infinite behind the camera.
    pub(crate) fn error(&self, camera_from_world: &DAffine3, one: &Match) -> f64 {
        let in_camera = camera_from_world.transform_point3(one.point_in_world);
        self.pixel(in_camera).map_or(f64::INFINITY, |pixel| pixel.distance(one.at))
    }
}

/// Parameters of a pose: a small rotation and translation of the camera frame.
pub(crate) const POSE: usize = 6;
/// The same, then the focal length's relative change.
pub(crate) const POSE_AND_FOCAL: usize = 7;
/// The same, then the change of the vertical focal length's ratio to the horizontal one, and of the principal point,
/// pixels.
pub(crate) const POSE_AND_LENS: usize = 10;

/// Normal equations of the parameters.
struct Normal<const N: usize> {
    matrix: [[f64; N]; N],
    vector: [f64; N],
}

fn normal_equations<const N: usize>(
    camera: &Pinhole,
    pose: &DAffine3,
    matches: &[Match],
    weight: impl Fn(f64) -> f64,
) -> Normal<N> {
    let mut of = Normal { matrix: [[0.0; N]; N], vector: [0.0; N] };
    for one in matches {
        let p = pose.transform_point3(one.point_in_world);
        let Some(pixel) = camera.pixel(p) else { continue };
        let error = one.at - pixel;
        let weight = weight(error.length());
        let (fx, fy) = (camera.focal.x / p.z, camera.focal.y / p.z);
        // d pixel / d p, then d p = rotation x p + translation.
        let rows = [DVec3::new(fx, 0.0, -fx * p.x / p.z), DVec3::new(0.0, fy, -fy * p.y / p.z)];
        let spread = pixel - camera.centre;
        let lens = [[spread.x, 0.0, 1.0, 0.0], [spread.y, spread.y, 0.0, 1.0]];
        for (row, error, lens) in [(rows[0], error.x, lens[0]), (rows[1], error.y, lens[1])] {
            let turned = p.cross(row);
            let [focal, aspect, centre_x, centre_y] = lens;
            let j: [f64; POSE_AND_LENS] =
                [turned.x, turned.y, turned.z, row.x, row.y, row.z, focal, aspect, centre_x, centre_y];
            for a in 0..N {
                of.vector[a] += weight * j[a] * error;
                for b in 0..N {
                    of.matrix[a][b] += weight * j[a] * j[b];
                }
            }
        }
    }
    of
}

/// Inverts a positive definite matrix (Gauss-Jordan, largest pivot); `None` if it is singular.
fn inverse<const N: usize>(mut m: [[f64; N]; N]) -> Option<[[f64; N]; N]> {
    let mut out: [[f64; N]; N] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(i == j)));
    for column in 0..N {
        let pivot = (column..N).max_by(|a, b| m[*a][column].abs().total_cmp(&m[*b][column].abs()))?;
        m.swap(column, pivot);
        out.swap(column, pivot);
        let scale = m[column][column];
        if scale.is_nan() || scale.abs() < 1e-12 {
            return None;
        }
        m[column].iter_mut().chain(&mut out[column]).for_each(|v| *v /= scale);
        let (row, out_row) = (m[column], out[column]);
        for other in (0..N).filter(|other| *other != column) {
            let factor = m[other][column];
            for k in 0..N {
                m[other][k] -= factor * row[k];
                out[other][k] -= factor * out_row[k];
            }
        }
    }
    Some(out)
}

/// Refines a pose by least squares, and the camera too with [`POSE_AND_FOCAL`] or [`POSE_AND_LENS`]; errors above
/// `soft_px` count less (Cauchy).
pub(crate) fn refine<const N: usize>(
    camera: &Pinhole,
    pose: &DAffine3,
    matches: &[Match],
    soft_px: f64,
) -> Option<(Pinhole, DAffine3)> {
    let (mut camera, mut pose) = (*camera, *pose);
    for _ in 0..MAX_ROUNDS {
        let of = normal_equations::<N>(&camera, &pose, matches, |e| (1.0 + (e / soft_px).powi(2)).recip());
        let inverse = inverse(of.matrix)?;
        let step: [f64; N] = std::array::from_fn(|a| (0..N).map(|b| inverse[a][b] * of.vector[b]).sum());
        let turn = DQuat::from_scaled_axis(DVec3::new(step[0], step[1], step[2]));
        let shift = DVec3::new(step[3], step[4], step[5]);
        pose = DAffine3::from_rotation_translation(turn, shift) * pose;
        camera = camera.changed(&step[POSE..]);
        if !pose.is_finite() || !camera.focal.is_finite() || !camera.centre.is_finite() {
            return None;
        }
        if step.iter().all(|s| s.abs() < 1e-10) {
            break;
        }
    }
    // Products of rotations drift from length 1.
    let rotation = DQuat::from_mat3(&pose.matrix3).normalize();
    Some((camera, DAffine3::from_rotation_translation(rotation, pose.translation)))
}

/// Variance of the errors along an axis, from their median.
fn variance(camera: &Pinhole, pose: &DAffine3, matches: &[Match]) -> Option<f64> {
    let mut errors: Vec<f64> = matches.iter().map(|one| camera.error(pose, one)).collect();
    errors.sort_by(f64::total_cmp);
    Some((errors.get(errors.len() / 2)? / MEDIAN_RADIUS).max(MIN_SIGMA_PX).powi(2))
}

/// Covariance of the parameters; `prior` is that of the focal
/// length's relative error before the photo is seen.
fn covariance_in_camera(
    camera: &Pinhole,
    pose: &DAffine3,
    matches: &[Match],
    prior: f64,
) -> Option<[[f64; POSE_AND_FOCAL]; POSE_AND_FOCAL]> {
    let variance = variance(camera, pose, matches)?;
    let mut matrix = normal_equations::<POSE_AND_FOCAL>(camera, pose, matches, |_| 1.0).matrix;
    matrix[POSE][POSE] += variance / (prior * prior);
    let of = inverse(matrix)?.map(|row| row.map(|v| variance * v));
    let with_focal = of[POSE].map(|v| v / of[POSE][POSE] * MAP_FOCAL_SIGMA);
    Some(std::array::from_fn(|a| std::array::from_fn(|b| of[a][b] + with_focal[a] * with_focal[b])))
}

/// Standard deviation of the focal length's relative error, from the matches alone.
pub(crate) fn focal_sigma(camera: &Pinhole, pose: &DAffine3, matches: &[Match]) -> Option<f64> {
    Some(covariance_in_camera(camera, pose, matches, f64::INFINITY)?[POSE][POSE].sqrt())
}

/// Squared Mahalanobis distance between the stated aspect and principal point and those that the matches alone give.
pub(crate) fn lens_distance(
    stated: &Pinhole,
    (camera, pose): (&Pinhole, &DAffine3),
    matches: &[Match],
) -> Option<f64> {
    let variance = ALIKE * variance(camera, pose, matches)?;
    let of = inverse(normal_equations::<POSE_AND_LENS>(camera, pose, matches, |_| 1.0).matrix)?;
    let aspect = |of: &Pinhole| (of.focal.y / of.focal.x).ln();
    let centre = camera.centre - stated.centre;
    let off = [aspect(camera) - aspect(stated), centre.x, centre.y];
    let priors = [ASPECT_SIGMA, CENTRE_SIGMA * stated.centre.x, CENTRE_SIGMA * stated.centre.x];
    let sum: [[f64; 3]; 3] = std::array::from_fn(|a| {
        std::array::from_fn(|b| {
            let prior = if a == b { priors[a].powi(2) } else { 0.0 };
            variance * of[POSE_AND_FOCAL + a][POSE_AND_FOCAL + b] + prior
        })
    });
    let inverse = inverse(sum)?;
    Some((0..9).map(|ab| off[ab / 3] * inverse[ab / 3][ab % 3] * off[ab % 3]).sum())
}

/// Covariance of the camera's position and of a small rotation about the world's axes, row by row.
pub(crate) fn covariance(camera: &Pinhole, pose: &DAffine3, matches: &[Match]) -> Option<[f64; 36]> {
    let of_camera =
        covariance_in_camera(camera, pose, matches, FOCAL_SIGMA)?.map(|row| row.map(|v| ALIKE * v));
    // position = -R' t: d position = R' (rotation x t - d t) with t turned along, so rotation x t cancels t's part.
    let back = pose.matrix3.transpose();
    let mut jacobian = [[0.0; POSE]; POSE];
    for column in 0..3 {
        let axis = DVec3::AXES[column];
        let (moved, turned) = (-(back * axis), -(back * axis));
        for row in 0..3 {
            jacobian[row][column + 3] = moved[row];
            jacobian[row + 3][column] = turned[row];
        }
    }
    let mut out = [0.0; 36];
    for (i, out) in out.iter_mut().enumerate() {
        let (a, b) = (i / 6, i % 6);
        let product = |p: usize, q: usize| jacobian[a][p] * of_camera[p][q] * jacobian[b][q];
        *out = (0..36).map(|pq| product(pq / 6, pq % 6)).sum::<f64>();
    }
    Some(out)
}
