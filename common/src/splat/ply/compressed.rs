//! Compressed PLY files of PlayCanvas: the element `chunk` has the ranges of 256 Gaussians, `vertex` has four
//! packed words per Gaussian, and the optional `sh` has bytes.

use glam::DVec3;

use super::container::Ply;
use super::sh_rest::sh_rest_properties;
use crate::Gaussians;
use crate::splat::columns::{ReadOptions, columns};
use crate::splat::error::SplatError;
use crate::splat::values::{dc_of_colour, unit_rotation, with_largest};

const GAUSSIANS_PER_CHUNK: usize = 256;
const RANGES: &str = "min_x min_y min_z max_x max_y max_z min_scale_x min_scale_y min_scale_z max_scale_x max_scale_y \
                      max_scale_z";
const COLOUR_RANGES: &str = "min_r min_g min_b max_r max_g max_b";
const PACKED: &str = "packed_position packed_rotation packed_scale packed_color";
const EXPORT_AGAIN: &str = "export the compressed PLY again";

/// Ranges of a chunk: minima and maxima of position, log scale and colour.
#[derive(Clone, Copy)]
struct Chunk([f32; 18]);

impl Chunk {
    /// Maps `unit`, 0..=1 on each axis, to the range that begins at entry `start`.
    fn lerp(&self, start: usize, unit: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|axis| {
            let (min, max) = (f64::from(self.0[start + axis]), f64::from(self.0[start + 3 + axis]));
            min * (1.0 - unit[axis]) + max * unit[axis]
        })
    }
}

/// Returns `bits` bits of `word` from bit `shift` up, as a fraction of their maximum.
fn unit(word: u32, shift: u32, bits: u32) -> f64 {
    let max = (1 << bits) - 1;
    f64::from((word >> shift) & max) / f64::from(max)
}

/// Returns three fractions packed in 11, 10 and 11 bits.
fn unit_11_10_11(word: u32) -> [f64; 3] {
    [unit(word, 21, 11), unit(word, 11, 10), unit(word, 0, 11)]
}

/// Unpacks a rotation: the index of its largest component, and 10 bits for each of the others, within +-1/sqrt(2).
fn unpack_rotation(word: u32) -> [f64; 4] {
    let others = [20, 10, 0].map(|shift| (unit(word, shift, 10) - 0.5) * std::f64::consts::SQRT_2);
    with_largest((word >> 30) as usize, others)
}

fn read_chunks(ply: &mut Ply) -> Result<Vec<Chunk>, SplatError> {
    let chunk = ply.require_element("chunk", EXPORT_AGAIN)?;
    let mut properties = ply.properties(chunk, RANGES, EXPORT_AGAIN)?;
    // Files of the first version have no colour ranges; colours span 0..=1.
    if ply.elements[chunk].property("min_r").is_some() {
        properties.extend(ply.properties(chunk, COLOUR_RANGES, EXPORT_AGAIN)?);
    }
    ply.seek_element(chunk)?;
    let mut chunks = Vec::with_capacity(ply.checked_count(chunk)?);
    ply.rows(&properties, |row| {
        let mut ranges = [0.0; 18];
        ranges[15..].fill(1.0);
        ranges.iter_mut().zip(row).for_each(|(range, value)| *range = *value as f32);
        chunks.push(Chunk(ranges));
    })?;
    Ok(chunks)
}

/// Reads the rows; the header is already read.
pub(super) fn read(mut ply: Ply, vertex: usize, options: ReadOptions) -> Result<Gaussians, SplatError> {
    let packed = ply.properties(vertex, PACKED, EXPORT_AGAIN)?;
    let chunks = read_chunks(&mut ply)?;
    ply.seek_element(vertex)?;
    let count = ply.checked_count(vertex)?;
    let n_chunks = count.div_ceil(GAUSSIANS_PER_CHUNK);
    if n_chunks != chunks.len() {
        let expected = format_args!("{n_chunks} chunks for {count} Gaussians");
        return Err(ply.input.malformed(expected, chunks.len()));
    }
    let sh = match ply.element("sh") {
        Some(sh) if options.with_sh_rest => Some((sh, sh_rest_properties(&ply, sh)?)),
        _ => None,
    }
    .filter(|(_, (degree, _))| *degree > 0);
    // Memory for the harmonics is reserved once their bytes are known to exist.
    let mut out = columns(count, 0);
    ply.rows(&packed, |row| {
        let chunk = chunks[out.means_in_world.len() / GAUSSIANS_PER_CHUNK];
        let word = |i: usize| row[i] as u32;
        out.means_in_world.push(DVec3::from_array(chunk.lerp(0, unit_11_10_11(word(0)))));
        out.rotations_wxyz.push(unit_rotation(unpack_rotation(word(1))));
        out.scales.push(chunk.lerp(6, unit_11_10_11(word(2))).map(|log| log.exp() as f32));
        let colour = [24, 16, 8].map(|shift| unit(word(3), shift, 8));
        out.sh_dc.push(chunk.lerp(12, colour).map(dc_of_colour));
        out.opacities.push(unit(word(3), 0, 8) as f32);
    })?;

    if let Some((sh, (degree, properties))) = sh {
        ply.seek_element(sh)?;
        let sh_count = ply.checked_count(sh)?;
        if sh_count != count {
            return Err(ply.input.malformed(format_args!("{count} rows of element \"sh\""), sh_count));
        }
        out.sh_degree = degree;
        out.sh_rest.reserve_exact(count * properties.len());
        ply.rows(&properties, |row| out.sh_rest.extend(row.iter().map(|byte| unpack_sh(*byte))))?;
    }
    ply.finish()?;
    Ok(out)
}

/// Returns a coefficient stored as a byte: buckets of 1/32 within +-4; the first and last stand for the ends.
fn unpack_sh(byte: f64) -> f32 {
    let unit = match byte {
        ..=0.0 => 0.0,
        255.0.. => 1.0,
        _ => (byte + 0.5) / 256.0,
    };
    ((unit - 0.5) * 8.0) as f32
}
