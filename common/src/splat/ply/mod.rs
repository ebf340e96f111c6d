//! PLY files of trained splats, as 3DGS (Kerbl et al. 2023), gsplat, nerfstudio and brush write them, and compressed PLY
//! files of PlayCanvas. Properties may have any order and type.
//!
//! Per vertex: mean `x y z`, rotation `rot_0..3` (wxyz), scale `scale_0..2` (logarithm), `opacity`
//! (logit), colour `f_dc_0..2` (or `red green blue`), `f_rest_*` (channel by channel); other
//! properties are ignored.

mod compressed;
mod container;
mod harmonics;
mod plain;
mod points;
mod vertices;
mod write;

pub use points::{Point, PointProperties};
pub use vertices::read_vertices;
pub use write::{write, write_header, write_rows, write_to};

use super::columns::ReadOptions;
use super::error::SplatError;
use super::input::Input;
use crate::Gaussians;
use container::Ply;

/// Reads a PLY file, plain or compressed.
pub(super) fn read(input: Input, options: ReadOptions) -> Result<Gaussians, SplatError> {
    let ply = Ply::open(input)?;
    let Some(vertex) = ply.element("vertex") else {
        return Err(SplatError::Malformed {
            path: ply.input.path().into(),
            place: ply.input.place(),
            expected: "a header with an element \"vertex\"".into(),
            found: "none".into(),
            advice: plain::NOT_A_SPLAT,
        });
    };
    if ply.elements[vertex].property("packed_position").is_some() {
        return compressed::read(ply, vertex, options);
    }
    plain::read(ply, vertex, options)
}
