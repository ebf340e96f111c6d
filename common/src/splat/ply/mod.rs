//! PLY files of trained splats, as 3DGS (Kerbl et al. 2023), gsplat, nerfstudio and brush write them, and
//! compressed PLY files of PlayCanvas. Properties may have any order and type.
//!
//! Per vertex: mean `x y z`, rotation `rot_0..3` (wxyz), scale `scale_0..2` (logarithm), `opacity` (logit; an unsigned
//! integer is a share of its type's largest value), colour `f_dc_0..2` (or `red green blue`), `f_rest_*` (channel by
//! channel); other properties are ignored.

mod compressed;
mod container;
mod points;
mod sh_rest;
mod write;

use std::path::Path;

use glam::DVec3;

pub use points::{Point, PointProperties};
pub use write::{write, write_header, write_rows, write_to};

use super::columns::{ReadOptions, columns};
use super::error::SplatError;
use super::input::Input;
use super::values::{dc_of_colour, sigmoid, unit_rotation};
use crate::Gaussians;
use container::Ply;
use sh_rest::sh_rest_properties;

const NOT_A_SPLAT: &str =
    "this is not a trained splat but perhaps a point cloud or mesh: give the PLY of the splat";
const VERTEX: &str = "vertex";
const GEOMETRY: &str = "x y z rot_0 rot_1 rot_2 rot_3 opacity scale_0";
/// Colours of 0 to 1 are not brighter, even where harmonics overshoot.
const BRIGHTEST: f32 = 16.0;
/// Balls lack the second and third scale.
const SECOND_SCALE: &str = "scale_1";
/// Flat Gaussians of 2DGS lack the third.
const THIRD_SCALE: &str = "scale_2";
/// Standard deviation of the blur by which Mip-Splatting draws a Gaussian; its fused exports lack it.
const BLUR: &str = "filter_3D";

pub(super) fn read(input: Input, options: ReadOptions) -> Result<Gaussians, SplatError> {
    let ply = Ply::open(input)?;
    let vertex = ply.require_element(VERTEX, NOT_A_SPLAT)?;
    match ply.elements[vertex].property("packed_position") {
        Some(_) => compressed::read(ply, vertex, options),
        None => read_plain(ply, vertex, options),
    }
}

/// Reads the rows of an uncompressed PLY.
fn read_plain(mut ply: Ply, vertex: usize, options: ReadOptions) -> Result<Gaussians, SplatError> {
    let mut wanted = ply.properties(vertex, GEOMETRY, NOT_A_SPLAT)?;
    let [second_scale, third_scale] =
        [SECOND_SCALE, THIRD_SCALE].map(|name| ply.elements[vertex].property(name));
    // A ball has one scale for all axes; a flat Gaussian's third scale is read from another property and set to 0.
    let is_ball = second_scale.is_none() && third_scale.is_none();
    if is_ball {
        wanted.extend([wanted[8]; 2]);
    } else {
        wanted.extend(ply.properties(vertex, SECOND_SCALE, NOT_A_SPLAT)?);
        wanted.push(third_scale.unwrap_or(wanted[9]));
    }
    let rgb_names = ["red", "green", "blue"];
    let rgb: Option<Vec<usize>> = rgb_names.iter().map(|name| ply.elements[vertex].property(name)).collect();
    // nerfstudio exports plain colours on request ("rgb").
    let colours = rgb.filter(|_| ply.elements[vertex].property("f_dc_0").is_none());
    match &colours {
        Some(rgb) => wanted.extend(rgb),
        None => wanted.extend(ply.properties(vertex, "f_dc_0 f_dc_1 f_dc_2", NOT_A_SPLAT)?),
    }
    let blur = ply.elements[vertex].property(BLUR);
    wanted.push(blur.unwrap_or(wanted[8]));
    let (degree, rest) = sh_rest_properties(&ply, vertex)?;
    let degree = options.kept_degree(degree);
    if degree > 0 {
        wanted.extend(rest);
    }

    // No logit is an integer: bytes are shares of 255.
    let opaque = ply.elements[vertex].largest(wanted[7]);
    ply.seek_element(vertex)?;
    let mut out = columns(ply.checked_count(vertex)?, degree);
    ply.rows(&wanted, |row| {
        let [x, y, z, w, i, j, k, logit, s0, s1, s2, r, g, b, f, rest @ ..] = row else {
            unreachable!("every row has the 15 values requested");
        };
        out.means_in_world.push(DVec3::new(*x, *y, *z));
        out.rotations_wxyz.push(unit_rotation([*w, *i, *j, *k]));
        let sharp = [s0, s1, s2].map(|s| s.exp());
        // Yu et al., Mip-Splatting, 2024, 3D smoothing filter: the Gaussian's integral stays.
        let drawn = sharp.map(|s| if blur.is_some() { s.hypot(*f) } else { s });
        let dimmed: f64 = if blur.is_some() { (0..3).map(|i| sharp[i] / drawn[i]).product() } else { 1.0 };
        let [s0, s1, s2] = drawn.map(|s| s as f32);
        out.scales.push([s0, s1, if is_ball || third_scale.is_some() { s2 } else { 0.0 }]);
        let opacity = opaque.map_or_else(|| sigmoid(*logit), |opaque| (logit / opaque) as f32);
        out.opacities.push((f64::from(opacity) * dimmed) as f32);
        out.sh_dc.push([r, g, b].map(|c| *c as f32));
        out.sh_rest.extend(rest.iter().map(|c| *c as f32));
    })?;
    let largest = colours.as_ref().and_then(|rgb| ply.elements[vertex].largest(rgb[0]));
    ply.finish()?;
    if colours.is_some() {
        let white = largest.unwrap_or_else(|| white_of(out.sh_dc.iter().flatten()));
        out.sh_dc.iter_mut().flatten().for_each(|c| *c = dc_of_colour(f64::from(*c) / white));
    }
    Ok(out)
}

/// White among colours of other types than unsigned integers: most programs write 0 to 1, some 0 to 255.
fn white_of<'a>(colours: impl Iterator<Item = &'a f32>) -> f64 {
    if colours.fold(0.0f32, |most, c| most.max(*c)) > BRIGHTEST { 255.0 } else { 1.0 }
}

/// Reads properties of a mesh or point cloud: a row per vertex, in the order of `names`.
pub fn read_vertices<const N: usize>(path: &Path, names: [&str; N]) -> Result<Vec<[f64; N]>, SplatError> {
    const NO_VERTICES: &str = "give a PLY with this property";
    let mut ply = Ply::open(Input::open(path)?)?;
    let vertex = ply.require_element(VERTEX, NO_VERTICES)?;
    let wanted = ply.properties(vertex, &names.join(" "), NO_VERTICES)?;
    ply.seek_element(vertex)?;
    let mut rows = Vec::with_capacity(ply.checked_count(vertex)?);
    ply.rows(&wanted, |row| rows.push(std::array::from_fn(|i| row[i])))?;
    ply.finish()?;
    Ok(rows)
}
