//! The properties of view-dependent colour.

use super::container::Ply;
use crate::Gaussians;
use crate::splat::columns::MAX_SH_DEGREE;
use crate::splat::error::SplatError;

/// A degree that some trainers write; it is truncated to [`MAX_SH_DEGREE`].
const HIGHER_SH_DEGREE: u8 = MAX_SH_DEGREE + 1;

/// Returns the degree of the harmonics in `f_rest_*` and the properties in the order of [`Gaussians::sh_rest`];
/// the file stores them channel by channel.
pub(super) fn sh_rest_properties(ply: &Ply, element: usize) -> Result<(u8, Vec<usize>), SplatError> {
    let property = |i: usize| ply.elements[element].property(&format!("f_rest_{i}"));
    let in_file: Vec<_> = (0..).map_while(property).collect();
    let per_channel = in_file.len() / 3;
    let of_degree = |degree: &u8| 3 * Gaussians::sh_rest_per_channel(*degree) == in_file.len();
    let Some(degree) = (0..=HIGHER_SH_DEGREE).find(of_degree) else {
        let fault = format!("expected 0, 9, 24, 45 or 72 properties f_rest_*, found {}", in_file.len());
        let advice = "export with spherical harmonics of degree 0 to 3";
        return Err(SplatError::at(ply.input.path(), "header", format_args!("{fault}; {advice}")));
    };
    let degree = degree.min(MAX_SH_DEGREE);
    let kept = 0..Gaussians::sh_rest_per_channel(degree);
    let order = kept.flat_map(|i| (0..3).map(move |channel| channel * per_channel + i));
    Ok((degree, order.map(|i| in_file[i]).collect()))
}
