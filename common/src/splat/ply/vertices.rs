//! Vertices of PLY files that are not splats.

use std::path::Path;

use super::container::Ply;
use crate::splat::error::SplatError;
use crate::splat::input::Input;

/// Reads properties of the vertices of a mesh or point cloud: a row per vertex, in the order of `names`.
///
/// # Errors
/// [`SplatError`] if the file is not a PLY, is truncated, or lacks a property.
pub fn read_vertices<const N: usize>(path: &Path, names: [&str; N]) -> Result<Vec<[f64; N]>, SplatError> {
    const NO_VERTICES: &str = "give a PLY with this property";
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
