//! Similarities that may lie between the world of the poses and that of a splat.

use std::fmt;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde::Serialize;
use slag_common::{Similarity, View};

/// A similarity between the world of the poses and that of the splat, and why it may hold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FrameCandidate {
    /// Why.
    pub cause: FrameCause,
    /// From the world of the poses to that of the splat.
    pub splat_from_poses: Similarity,
}

/// Why a splat's world may differ from that of its poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameCause {
    /// The splat is in the world of a second set of poses.
    OtherPoses,
    /// The splat is an export of nerfstudio in its trained frame, and the file that states it is missing.
    NerfstudioDefaults,
    /// The stated frame is not that of the splat, which is in the world of the poses.
    FrameFileNotMeant,
}

impl fmt::Display for FrameCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::OtherPoses => "the splat is in the world of --also-poses, not in that of --views",
            Self::NerfstudioDefaults => {
                "the splat is in nerfstudio's trained frame (oriented, centred and scaled by its defaults); put the \
                 run's dataparser_transforms.json beside the splat"
            }
            Self::FrameFileNotMeant => {
                "the splat is in the world of the poses, not in the frame that the file states; use --splat-frame none"
            }
        })
    }
}

/// Nerfstudio's world axes from COLMAP's: x and y swapped, z negated.
const COLMAP_AXES: [i8; 3] = [2, 1, -3];

/// Returns the frames in which nerfstudio trains by default: cameras centred at their mean, the mean of their up axes
/// turned to z, scaled so that the largest coordinate of a camera is 1 (`auto_orient_and_center_poses`, methods `up` of
/// its own data sets and `none` of ScanNet), each with and without a change of axes from COLMAP's.
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
        for orients in [true, false] {
            let rotation = match up.try_normalize() {
                Some(up) if orients => DQuat::from_rotation_arc(up, DVec3::Z),
                _ if orients => continue,
                _ => DQuat::IDENTITY,
            };
            let centred = Similarity { rotation, translation: -(rotation * mean), ..Similarity::IDENTITY };
            let largest = centres
                .iter()
                .map(|c| centred.transform_point(*c).abs().max_element())
                .fold(0.0_f64, f64::max);
            if largest > 0.0 && largest.is_finite() {
                let splat_from_poses = Similarity::from_scale(1.0 / largest).after(&centred).after(&axes);
                candidates.push(FrameCandidate { cause: FrameCause::NerfstudioDefaults, splat_from_poses });
            }
        }
    }
    candidates
}

/// Returns the rotation to a world whose axis i is axis |axes[i]| of the old one, counted from 1, with its sign.
pub(super) fn from_axes(axes: [i8; 3]) -> Similarity {
    let row = |axis: i8| {
        let mut row = DVec3::ZERO;
        row[usize::from(axis.unsigned_abs().clamp(1, 3)) - 1] = f64::from(axis.signum());
        row
    };
    let matrix = DMat3::from_cols(row(axes[0]), row(axes[1]), row(axes[2])).transpose();
    Similarity::from_rotation(DQuat::from_mat3(&matrix).normalize())
}

/// Returns the 23 rotations by right angles other than the identity, as the axes of [`from_axes`].
pub(super) fn right_angles() -> Vec<[i8; 3]> {
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

/// Writes the cause of a world with these axes.
pub(super) fn write_axes(axes: [i8; 3], f: &mut fmt::Formatter<'_>) -> fmt::Result {
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
    write!(
        f,
        "the worlds of splat and cameras have other axes{cause}: the splat's x, y, z are the cameras' {x}, {y}, {z}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn right_angles_are_the_23_other_rotations_of_a_cube() {
        let all = right_angles();
        assert_eq!(all.len(), 23);
        for (at, axes) in all.iter().enumerate() {
            assert!(!all[..at].contains(axes));
            let image = |p| from_axes(*axes).transform_point(p);
            let columns = DMat3::from_cols(image(DVec3::X), image(DVec3::Y), image(DVec3::Z));
            assert!((columns.determinant() - 1.0).abs() < 1e-12);
            // The definition: coordinate i of the image is the named coordinate.
            let p = DVec3::new(2.0, 3.0, 5.0);
            for (i, axis) in axes.iter().enumerate() {
                let expected = p[usize::from(axis.unsigned_abs()) - 1] * f64::from(axis.signum());
                assert!((image(p)[i] - expected).abs() < 1e-12, "{axes:?}");
            }
        }
    }
}
