//! `.splat` files as antimatter15/splat writes them: no header, 32 bytes per Gaussian:
//! mean `3 x f32`, scale `3 x f32` (linear), colour and opacity `4 x u8`, rotation `wxyz 4 x u8`.

use glam::DVec3;

use super::columns::columns;
use super::error::SplatError;
use super::input::Input;
use super::values::{dc_of_colour, unit_rotation};
use crate::Gaussians;

const ROW_BYTES: usize = 32;

/// The format has no spherical harmonics above degree 0.
pub(super) fn read(mut input: Input) -> Result<Gaussians, SplatError> {
    let len_bytes = input.len_bytes();
    if len_bytes == 0 || !len_bytes.is_multiple_of(ROW_BYTES as u64) {
        let place = format_args!("byte {}", len_bytes - len_bytes % ROW_BYTES as u64);
        let found = format_args!("a file of {len_bytes} bytes");
        return Err(SplatError::malformed(input.path(), place, "rows of 32 bytes", found));
    }
    let count = (len_bytes / ROW_BYTES as u64) as usize;
    let mut out = columns(count, 0);
    let mut row = [0; ROW_BYTES];
    for _ in 0..count {
        input.fill(&mut row, "a row")?;
        let floats: [f32; 6] = std::array::from_fn(|i| {
            f32::from_le_bytes([row[4 * i], row[4 * i + 1], row[4 * i + 2], row[4 * i + 3]])
        });
        let bytes: [f64; 8] = std::array::from_fn(|i| f64::from(row[24 + i]));
        out.means_in_world.push(DVec3::new(floats[0].into(), floats[1].into(), floats[2].into()));
        out.scales.push([floats[3], floats[4], floats[5]]);
        out.sh_dc.push(std::array::from_fn(|i| dc_of_colour(bytes[i] / 255.0)));
        out.opacities.push((bytes[3] / 255.0) as f32);
        // The writer stores q * 128 + 128, so 128 is 0 and the identity stays exact.
        out.rotations_wxyz.push(unit_rotation(std::array::from_fn(|i| bytes[4 + i] - 128.0)));
    }
    Ok(out)
}
