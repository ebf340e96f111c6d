//! Weighs views more evenly: a view's weight for a Gaussian is its projected area, which falls with distance and slant.

use super::views::ViewEntries;

/// Returns a factor for each view of a Gaussian, such that each view contributes weight^(1 - `equalisation`) and the
/// total weight stays.
pub(super) fn factors(views: &[ViewEntries], equalisation: f32) -> Vec<f32> {
    let factors: Vec<f32> =
        views.iter().map(|view| view.weight.max(f32::MIN_POSITIVE).powf(-equalisation)).collect();
    let total: f32 = views.iter().map(|view| view.weight).sum();
    let equalised: f32 = views.iter().zip(&factors).map(|(view, factor)| view.weight * factor).sum();
    factors.into_iter().map(|factor| factor * total / equalised).collect()
}
