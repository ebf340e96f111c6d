//! The properties `f_rest_*`, which plain and compressed files share.

use super::container::Ply;
use crate::Gaussians;
use crate::splat::columns::MAX_SH_DEGREE;
use crate::splat::error::{Place, SplatError};

/// Returns the degree of the spherical harmonics in the `f_rest_*` of an element, and the properties in the order of
/// [`Gaussians::sh_rest`]; the file stores them channel by channel.
pub(super) fn sh_rest_properties(ply: &Ply, element: usize) -> Result<(u8, Vec<usize>), SplatError> {
    let property = |i: usize| ply.elements[element].property(&format!("f_rest_{i}"));
    let in_file: Vec<_> = (0..).map_while(property).collect();
    let degrees = 0..=MAX_SH_DEGREE;
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
