//! Checks that the formats share: intrinsics, rotations and translations.

use glam::{DAffine3, DMat3, DQuat, DVec3, DVec4};

use super::error::PoseProblem;
use crate::camera::{Distortion, Intrinsics};

/// Largest image side accepted, pixels: that of the largest JPEG; pixel indices fit 32 bits.
const MAX_SIDE_PX: u32 = 65_535;

/// Largest translation accepted: beyond, a 64-bit coordinate is coarser than a ten-thousandth of a unit.
const MAX_TRANSLATION: f64 = 1e12;

/// Largest deviation from unit length or orthonormality that counts as rounding; printouts with 3 decimals are below.
const ROTATION_TOLERANCE: f64 = 5e-3;

/// Largest deviation of a matrix's fourth row from 0 0 0 1 that counts as rounding, of products in 32 bits.
const LAST_ROW_TOLERANCE: f64 = 1e-5;

/// Checks intrinsics: sizes within 1..=65,535, focal lengths positive, everything finite.
pub(super) fn check_intrinsics(
    [width_px, height_px]: [f64; 2],
    [focal_x_px, focal_y_px]: [f64; 2],
    [centre_x_px, centre_y_px]: [f64; 2],
    distortion: Distortion,
) -> Result<Intrinsics, PoseProblem> {
    let check = |field: &str, value: f64, holds: bool, expected: &str| match holds {
        true => Ok(value),
        false => {
            let fault = format!("{field} is {value}, expected {expected}");
            Err(PoseProblem::new(fault, "export the poses again"))
        }
    };
    let side = |field, value: f64| {
        let holds = value.fract() == 0.0 && (1.0..=f64::from(MAX_SIDE_PX)).contains(&value);
        check(field, value, holds, "a whole number from 1 to 65535").map(|value| value as u32)
    };
    let focal = |field, value: f64| {
        check(field, value, value.is_finite() && value > 0.0, "a positive number of pixels")
    };
    let finite = |field, value: f64| check(field, value, value.is_finite(), "a finite number");
    let coefficients: &[f64] = match &distortion {
        Distortion::None => &[],
        Distortion::Brown { k, p } => &[k[0], k[1], k[2], p[0], p[1]],
        Distortion::Fisheye { k } => k,
    };
    for value in coefficients {
        finite("distortion coefficient", *value)?;
    }
    // Coefficients of zero make an ideal pinhole; a fisheye without coefficients is still equidistant.
    let distortion = match distortion {
        Distortion::Brown { k: [0.0, 0.0, 0.0], p: [0.0, 0.0] } => Distortion::None,
        other => other,
    };
    Ok(Intrinsics {
        width_px: side("width", width_px)?,
        height_px: side("height", height_px)?,
        focal_x_px: focal("focal length x", focal_x_px)?,
        focal_y_px: focal("focal length y", focal_y_px)?,
        centre_x_px: finite("principal point x", centre_x_px)?,
        centre_y_px: finite("principal point y", centre_y_px)?,
        distortion,
    })
}

/// Returns the transform of a quaternion (w, x, y, z), which is normalised first, and a translation.
pub(super) fn affine_from_wxyz(wxyz: [f64; 4], translation: [f64; 3]) -> Result<DAffine3, PoseProblem> {
    let [w, x, y, z] = wxyz;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    check_rotation((rotation.length() - 1.0).abs())?;
    let translation = check_translation(translation)?;
    Ok(DAffine3::from_rotation_translation(rotation.normalize(), translation))
}

/// Returns the transform of a rotation matrix, which is orthonormalised first, and a translation.
fn affine_from_matrix(rotation: DMat3, translation: [f64; 3]) -> Result<DAffine3, PoseProblem> {
    let gram = rotation.transpose() * rotation - DMat3::IDENTITY;
    let largest =
        gram.to_cols_array().iter().fold(0.0_f64, |m, v| if v.is_nan() { *v } else { m.max(v.abs()) });
    check_rotation(largest)?;
    // A reflection is orthonormal too, with determinant -1 instead of 1.
    if rotation.determinant() < 0.0 {
        let fault = "its matrix mirrors (its determinant is -1): the export has left-handed axes";
        let advice = "negate one axis of the world, or export with right-handed axes";
        return Err(PoseProblem::new(fault, advice));
    }
    let translation = check_translation(translation)?;
    Ok(DAffine3::from_rotation_translation(DQuat::from_mat3(&rotation).normalize(), translation))
}

/// Returns the transform of a matrix's rows; the columns of `axes` express the source's axes.
pub(super) fn affine_from_rows(rows: &[Vec<f64>], axes: DMat3) -> Result<DAffine3, PoseProblem> {
    let expected = "a matrix of 3 or 4 rows and 4 columns, the fourth row being 0 0 0 1";
    let row = |index: usize| rows.get(index).and_then(|row| <[f64; 4]>::try_from(row.as_slice()).ok());
    let ([Some(a), Some(b), Some(c)], true) = ([row(0), row(1), row(2)], matches!(rows.len(), 3 | 4)) else {
        return Err(PoseProblem::expected(expected, format!("{} rows", rows.len())));
    };
    let is_last = |row: [f64; 4]| DVec4::from(row).abs_diff_eq(DVec4::W, LAST_ROW_TOLERANCE);
    if rows.len() == 4 && !row(3).is_some_and(is_last) {
        return Err(PoseProblem::expected(expected, format!("{:?}", rows[3])));
    }
    let rotation = DMat3::from_cols_array_2d(&[0, 1, 2].map(|column| [a[column], b[column], c[column]]));
    affine_from_matrix(rotation * axes, [a[3], b[3], c[3]])
}

fn check_rotation(deviation: f64) -> Result<(), PoseProblem> {
    if deviation <= ROTATION_TOLERANCE {
        return Ok(());
    }
    let advice = "export the poses again, without scale or shear";
    Err(PoseProblem::new(format!("its rotation is off by {deviation:.3e}"), advice))
}

fn check_translation(translation: [f64; 3]) -> Result<DVec3, PoseProblem> {
    let vector = DVec3::from_array(translation);
    match translation.iter().find(|value| value.is_nan() || value.abs() > MAX_TRANSLATION) {
        None => Ok(vector),
        Some(value) => {
            Err(PoseProblem::expected("a translation of at most 1e12 along each axis", format!("{value:e}")))
        }
    }
}
