//! PLY files with a property for each number.

use glam::DVec3;

use super::container::Ply;
use super::harmonics::sh_rest_properties;
use crate::Gaussians;
use crate::splat::columns::{ReadOptions, columns};
use crate::splat::error::SplatError;
use crate::splat::values::{dc_of_colour, sigmoid, unit_rotation};

const GEOMETRY: [&str; 11] =
    ["x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2", "opacity"];
/// Advice for a PLY without the properties of a splat.
pub(super) const NOT_A_SPLAT: &str =
    "this is not a trained splat but perhaps a point cloud or mesh: give the PLY of the splat";

/// Reads the rows of a file with its header already read.
pub(super) fn read(mut ply: Ply, vertex: usize, options: ReadOptions) -> Result<Gaussians, SplatError> {
    let mut wanted = Vec::new();
    for name in GEOMETRY {
        wanted.push(ply.property(vertex, name, NOT_A_SPLAT)?);
    }
    let dc_names = ["f_dc_0", "f_dc_1", "f_dc_2"];
    let rgb_names = ["red", "green", "blue"];
    // nerfstudio exports plain colours on request ("rgb").
    let has_rgb_only = ply.elements[vertex].property(dc_names[0]).is_none()
        && rgb_names.iter().all(|name| ply.elements[vertex].property(name).is_some());
    for name in if has_rgb_only { rgb_names } else { dc_names } {
        wanted.push(ply.property(vertex, name, NOT_A_SPLAT)?);
    }
    let (degree, rest) = sh_rest_properties(&ply, vertex)?;
    let degree = options.kept_degree(degree);
    if degree > 0 {
        wanted.extend(rest);
    }

    ply.seek_element(vertex)?;
    let mut out = columns(ply.checked_count(vertex)?, degree);
    ply.rows(&wanted, |row| {
        let [x, y, z, w, i, j, k, s0, s1, s2, logit, r, g, b, rest @ ..] = row else {
            unreachable!("every row has the 14 values requested");
        };
        out.means_in_world.push(DVec3::new(*x, *y, *z));
        out.rotations_wxyz.push(unit_rotation([*w, *i, *j, *k]));
        out.scales.push([s0, s1, s2].map(|s| s.exp() as f32));
        out.opacities.push(sigmoid(*logit));
        out.sh_dc.push([r, g, b].map(|c| if has_rgb_only { dc_of_colour(c / 255.0) } else { *c as f32 }));
        out.sh_rest.extend(rest.iter().map(|c| *c as f32));
    })?;
    Ok(out)
}
