//! PLY files of trained splats: the layout of the original 3DGS (Kerbl et al. 2023) in any order and
//! type of properties, as gsplat, nerfstudio and brush write it too.
//!
//! Per vertex: mean `x y z`, rotation `rot_0..3` (wxyz), scale `scale_0..2` (logarithm), `opacity`
//! (logit), colour `f_dc_0..2` (or `red green blue`), `f_rest_*` (channel by channel), all else is
//! passed over.

use std::io::{BufWriter, Write};
use std::path::Path;

use glam::DVec3;

use super::input::Input;
use super::ply_container::Ply;
use super::{Place, ReadOptions, SplatError, columns, compressed_ply, dc_of_colour, sigmoid, unit_rotation};
use crate::Gaussians;

const GEOMETRY: [&str; 11] =
    ["x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2", "opacity"];
const NOT_A_SPLAT: &str = "this is no trained splat (a point cloud or mesh?): pass the splat's PLY";

/// Reads a PLY file, plain or compressed.
pub(super) fn read(input: Input, options: ReadOptions) -> Result<Gaussians, SplatError> {
    let mut ply = Ply::open(input)?;
    let Some(vertex) = ply.element("vertex") else {
        return Err(SplatError::Malformed {
            path: ply.input.path().into(),
            place: ply.input.place(),
            expected: "a header with an element \"vertex\"".into(),
            found: "none".into(),
            advice: NOT_A_SPLAT,
        });
    };
    if ply.elements[vertex].property("packed_position").is_some() {
        return compressed_ply::read(ply, vertex, options);
    }
    let mut wanted = Vec::new();
    for name in GEOMETRY {
        wanted.push(ply.property(vertex, name, NOT_A_SPLAT)?);
    }
    let dc_names = ["f_dc_0", "f_dc_1", "f_dc_2"];
    let rgb_names = ["red", "green", "blue"];
    // nerfstudio's export has plain colours when asked for "rgb".
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
            unreachable!("every row has the 14 values asked for");
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

/// Returns the degree of the spherical harmonics that `f_rest_*` of an element hold, and the
/// properties in the order of [`Gaussians::sh_rest`]: the file has channel by channel.
pub(super) fn sh_rest_properties(ply: &Ply, element: usize) -> Result<(u8, Vec<usize>), SplatError> {
    let property = |i: usize| ply.elements[element].property(&format!("f_rest_{i}"));
    let in_file: Vec<_> = (0..).map_while(property).collect();
    let degrees = 0..=super::MAX_SH_DEGREE;
    let per_channel = in_file.len() / 3;
    match degrees.into_iter().find(|d| 3 * Gaussians::sh_rest_per_channel(*d) == in_file.len()) {
        Some(degree) => {
            let order = (0..per_channel).flat_map(|i| (0..3).map(move |channel| channel * per_channel + i));
            Ok((degree, order.map(|i| in_file[i]).collect()))
        }
        None => Err(SplatError::Malformed {
            path: ply.input.path().into(),
            place: Place::Byte(0),
            expected: "0, 9, 24 or 45 properties f_rest_*".into(),
            found: in_file.len().to_string(),
            advice: "export with spherical harmonics of degree 0 to 3",
        }),
    }
}

/// Reads properties of a mesh's or point cloud's vertices: one row a vertex, in the order of `names`.
///
/// # Errors
/// [`SplatError`] for a file that is no PLY, is cut, or lacks one of them.
pub fn read_vertices<const N: usize>(path: &Path, names: [&str; N]) -> Result<Vec<[f64; N]>, SplatError> {
    const NO_VERTICES: &str = "pass a PLY whose vertices have it";
    let mut ply = Ply::open(Input::open(path)?)?;
    let Some(vertex) = ply.element("vertex") else {
        return Err(SplatError::Malformed {
            path: path.into(),
            place: ply.input.place(),
            expected: "a header with an element \"vertex\"".into(),
            found: "none".into(),
            advice: NO_VERTICES,
        });
    };
    let wanted = names.map(|name| ply.property(vertex, name, NO_VERTICES));
    let wanted = wanted.into_iter().collect::<Result<Vec<_>, _>>()?;
    ply.seek_element(vertex)?;
    let mut rows = Vec::with_capacity(ply.checked_count(vertex)?);
    ply.rows(&wanted, |row| rows.push(std::array::from_fn(|i| row[i])))?;
    Ok(rows)
}

/// Writes Gaussians as the original 3DGS does: binary little-endian, normals of zero, logarithmic
/// scales, logits of opacities.
///
/// # Errors
/// [`SplatError::Io`] if the file cannot be written.
pub fn write(path: &Path, gaussians: &Gaussians) -> Result<(), SplatError> {
    let mut writer = BufWriter::new(fs_err::File::create(path)?);
    write_to(&mut writer, gaussians)?;
    Ok(writer.flush()?)
}

/// Writes as [`write()`] does, to any writer (best a buffered one).
///
/// # Errors
/// Those of the writer.
pub fn write_to(mut writer: impl Write, gaussians: &Gaussians) -> std::io::Result<()> {
    let per_channel = Gaussians::sh_rest_per_channel(gaussians.sh_degree);
    let rest_names = (0..3 * per_channel).map(|i| format!("f_rest_{i}"));
    let names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from);
    let tail = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
    writeln!(writer, "ply\nformat binary_little_endian 1.0\nelement vertex {}", gaussians.len())?;
    for name in names.into_iter().chain(rest_names).chain(tail.map(String::from)) {
        writeln!(writer, "property float {name}")?;
    }
    writeln!(writer, "end_header")?;

    let mut row: Vec<u8> = Vec::new();
    for index in 0..gaussians.len() {
        row.clear();
        let mut put = |value: f32| row.extend_from_slice(&value.to_le_bytes());
        gaussians.means_in_world[index].to_array().into_iter().for_each(|x| put(x as f32));
        [0.0; 3].into_iter().for_each(&mut put);
        gaussians.sh_dc[index].into_iter().for_each(&mut put);
        let rest = &gaussians.sh_rest[index * 3 * per_channel..][..3 * per_channel];
        for channel in 0..3 {
            rest.iter().skip(channel).step_by(3).for_each(|c| put(*c));
        }
        put(logit(gaussians.opacities[index]));
        gaussians.scales[index].into_iter().for_each(|s| put(log_scale(s)));
        gaussians.rotations_wxyz[index].into_iter().for_each(&mut put);
        writer.write_all(&row)?;
    }
    Ok(())
}

/// Beyond these, exp and the sigmoid give 0 and 1 in f32 all the same, and other readers would not
/// take an infinity.
const MIN_LOG: f64 = -110.0;
const MAX_LOGIT: f64 = 40.0;

/// Returns the logit of an opacity, finite for 0 and 1.
fn logit(opacity: f32) -> f32 {
    let opacity = f64::from(opacity);
    (opacity / (1.0 - opacity)).ln().clamp(MIN_LOG, MAX_LOGIT) as f32
}

/// Returns the logarithm of a scale, finite for 0.
fn log_scale(scale: f32) -> f32 {
    f64::from(scale).ln().max(MIN_LOG) as f32
}
