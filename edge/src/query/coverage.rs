//! How much of a region is on board.

use glam::DVec3;
use slag_api::coverage::{BadCellAnswer, Coverage};
use slag_common::manifest::Manifest;

use crate::score::Region;
use crate::store::{BadCell, cell_of};

/// `fetched`: centre and radius of the area on board.
pub fn coverage(
    manifest: &Manifest,
    bad_cells: &[BadCell],
    fetched: (DVec3, f64),
    region: &Region,
) -> Coverage {
    let touches =
        |bad: &&BadCell| cell_of(manifest, bad.cell_id).is_none_or(|cell| region.touches(&cell.bounds));
    let described =
        |bad: &BadCell| BadCellAnswer { cell_id: bad.cell_id, generation: bad.old.map(|old| old.generation) };
    let bad_cells: Vec<BadCellAnswer> = bad_cells.iter().filter(touches).map(described).collect();
    let area_fetched = area_fetched(fetched, region)
        .map(|is_fetched| is_fetched && bad_cells.iter().all(|bad| bad.generation.is_some()));
    Coverage { area_fetched, bad_cells }
}

/// Returns whether the whole region was fetched: surely if all of ball or box was, as their intersection counts.
fn area_fetched((centre, radius): (DVec3, f64), region: &Region) -> Option<bool> {
    let ball = region.ball.map(|ball| ball.centre_in_world.distance(centre) + ball.radius <= radius);
    let bounds = region.bounds.map(|b| (b.min - centre).abs().max((b.max - centre).abs()).length() <= radius);
    ball.into_iter().chain(bounds).reduce(|a, b| a || b)
}
