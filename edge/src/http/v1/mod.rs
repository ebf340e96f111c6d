//! The API for programs, version 1: one shape of reply for every question.

mod body;
mod changes;
mod events;
mod goal;
mod map;
mod objects;
mod params;
mod query;
mod reply;
mod view;

use std::sync::Arc;

use slag_service::routes::Routes;

use super::app::App;

/// Adds the routes.
pub fn routes(to: Routes<Arc<App>>) -> Routes<Arc<App>> {
    to.get("/v1/query", "things that match texts or relations, best first, in one shape of reply", query::get)
        .parameters(params::query_parameters())
        .post(
            "/v1/query",
            "the same, asked in JSON: texts, vectors, phrases, areas",
            body::MAX_BODY_BYTES,
            query::post,
        )
        .get("/v1/objects", "all things on board, by id, in pages", objects::list)
        .parameters(params::objects_parameters())
        .get("/v1/objects/{id}", "one thing on board", objects::one)
        .get("/v1/map", "the area on board, its age, and what is missing", map::map)
        .get("/v1/changes", "things that appeared, went or moved between two generations", changes::changes)
        .parameters(changes::parameters())
        .get(
            "/v1/view",
            "the scene on board as the page at /view draws it: cells, fetched area, robot",
            view::describe,
        )
        .get("/v1/view/scores", "the score of every Gaussian on board, a byte each, in binary", view::scores)
        .parameters(view::scores_parameters())
        .get(
            "/v1/view/words",
            "the words that the text model knows, and how many things on board each finds",
            view::words,
        )
        .get("/v1/view/cells/{id}", "the Gaussians of a cell, 16 bytes each, in binary", view::cell)
        .parameters(view::cell_parameters())
        .get("/v1/goal", "places to stand near a thing: reached, clear, and in sight of it", goal::goal)
        .parameters(goal::parameters())
        .get("/v1/floor", "the ground around the robot: unknown, obstacle, ground, reached", goal::floor)
        .parameters(goal::floor_parameters())
        .get("/v1/events", "server-sent events: generations and fetches as they happen", events::events)
}
