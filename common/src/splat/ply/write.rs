//! Writes PLY files.

use std::io::Write;
use std::path::Path;

use crate::Gaussians;
use crate::durable;
use crate::splat::error::SplatError;

/// Writes the layout of 3DGS: binary little-endian, zero normals, logarithms of scales, logits of opacities.
pub fn write(path: &Path, gaussians: &Gaussians) -> Result<(), SplatError> {
    Ok(durable::write_result(path, |file| write_to(file, gaussians))?)
}

/// Writes like [`write()`] to any writer, preferably a buffered one.
pub fn write_to(mut writer: impl Write, gaussians: &Gaussians) -> std::io::Result<()> {
    write_header(&mut writer, gaussians.len() as u64, gaussians.sh_degree)?;
    write_rows(writer, gaussians)
}

pub fn write_header(mut writer: impl Write, n: u64, sh_degree: u8) -> std::io::Result<()> {
    let per_channel = Gaussians::sh_rest_per_channel(sh_degree);
    let rest_names = (0..3 * per_channel).map(|i| format!("f_rest_{i}"));
    let names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from);
    let tail = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
    writeln!(writer, "ply\nformat binary_little_endian 1.0\nelement vertex {n}")?;
    for name in names.into_iter().chain(rest_names).chain(tail.map(String::from)) {
        writeln!(writer, "property float {name}")?;
    }
    writeln!(writer, "end_header")
}

pub fn write_rows(mut writer: impl Write, gaussians: &Gaussians) -> std::io::Result<()> {
    let per_channel = Gaussians::sh_rest_per_channel(gaussians.sh_degree);
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

/// Beyond these bounds exp and the sigmoid give 0 and 1 in f32; other readers reject infinities.
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
