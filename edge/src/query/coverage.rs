//! How much of a region is on board.

use slag_api::coverage::{BadCellAnswer, Coverage};

use super::scene::Scene;
use crate::score::Region;
use crate::store::{BadCell, cell_of};

pub fn coverage(scene: &Scene<'_>, region: &Region) -> Coverage {
    let touches =
        |bad: &&BadCell| cell_of(scene.manifest, bad.cell_id).is_none_or(|cell| region.touches(&cell.bounds));
    let described =
        |bad: &BadCell| BadCellAnswer { cell_id: bad.cell_id, generation: bad.old.map(|old| old.generation) };
    let bad_cells: Vec<BadCellAnswer> = scene.bad_cells.iter().filter(touches).map(described).collect();
    // The whole region is surely on board if all of ball or box is, as their intersection counts.
    let (centre, radius) = scene.fetched;
    let ball = region.ball.map(|ball| ball.centre_in_world.distance(centre) + ball.radius <= radius);
    let bounds = region.bounds.map(|b| (b.min - centre).abs().max((b.max - centre).abs()).length() <= radius);
    let is_fetched = ball.into_iter().chain(bounds).reduce(|a, b| a || b);
    let area_fetched =
        is_fetched.map(|is_fetched| is_fetched && bad_cells.iter().all(|bad| bad.generation.is_some()));
    Coverage { area_fetched, bad_cells }
}
