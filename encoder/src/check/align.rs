//! The similarity between two sets of poses of the same photos, from their camera centres.

use glam::{DQuat, DVec3};
use slag_common::{Similarity, View};
use slag_math::eigen::eigen_symmetric;

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
