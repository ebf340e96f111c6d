//! The API for programs, version 1: one shape of reply for every question.

mod changes;
mod events;
mod goal;
mod locate;
mod objects;
mod view;

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use slag_api::map::MapStatus;
use slag_service::problem::Problem;
use slag_service::routes::{Parameter, Routes};

use super::forms::ObjectIdText;
use super::problem::{BUDGET, FAILED, NO_PLACES, NO_SCENE, OTHER_MODEL, TIME_BUDGET, WORDS};
use super::query;
use crate::fetch::accepted;
use crate::http::app::App;
use crate::locate::MAX_PHOTO_BYTES;
use crate::query::{Ask, map_status};

pub fn routes(to: Routes<Arc<App>>) -> Routes<Arc<App>> {
    view_routes(to)
        .get(
            "/v1/query",
            "things that match texts or relations, best first, in one shape of reply",
            query::get,
        )
        .errors(&[FAILED, NO_SCENE, OTHER_MODEL, WORDS, TIME_BUDGET])
        .post::<Ask, _, _>(
            "/v1/query",
            "the same, asked in JSON: texts, vectors, phrases, areas",
            query::MAX_BODY_BYTES,
            query::post,
        )
        .reads()
        .errors(&[FAILED, NO_SCENE, OTHER_MODEL, WORDS, TIME_BUDGET])
        .get("/v1/objects", "all things on board and what they are called, in pages", objects::list)
        .errors(&[FAILED, NO_SCENE, BUDGET])
        .get("/v1/objects/{id}", "one thing on board", objects::one)
        .parameters([Parameter::of_path::<ObjectIdText>("id", "o and 16 hex digits")])
        .errors(&[FAILED, NO_SCENE, (404, "No such thing is on board."), BUDGET])
        .get("/v1/objects/{id}/thumbnail", "a small picture of a thing on board, JPEG", objects::thumbnail)
        .parameters([Parameter::of_path::<ObjectIdText>("id", "o and 16 hex digits")])
        .errors(&[FAILED, NO_SCENE, (404, "No such thing is on board, or its shards have no pictures."), BUDGET])
        .get("/v1/map", "the area on board, its age, and what is missing", map)
        .errors(&[FAILED, NO_SCENE])
        .get("/v1/changes", "things that appeared, went or moved between two generations", changes::changes)
        .errors(&[FAILED, NO_SCENE,
            (404, "The robot does not remember a generation."),
            (409, "The generations were encoded with different models, or have no objects."),
            WORDS,
        ])
        .get("/v1/goal", "places to stand near a thing: reached, clear, and in sight of it", goal::goal)
        .errors(&[FAILED, NO_SCENE, NO_PLACES, WORDS])
        .get("/v1/floor", "the ground around the robot: unknown, obstacle, ground, reached", goal::floor)
        .errors(&[FAILED, NO_SCENE, NO_PLACES, BUDGET])
        .post_bytes(
            "/v1/locate",
            "where the camera of a photo is: found, unsure with candidates, or lost",
            locate::PHOTOS,
            MAX_PHOTO_BYTES,
            locate::locate,
        )
        .reads()
        .errors(&[FAILED, NO_SCENE, (409, "The landmarks on board are of another version."), BUDGET])
        .get("/v1/events", "server-sent events: generations and fetches as they happen", events::events)
        .details(
            "At first the present state. event: generation, with scene, generation, frame, n_cells, n_objects and n_bad_cells, or null without a scene; event: following, as the member following of /status. The stream ends when the service stops.",
        )
        .errors(&[(503, "Too many clients listen to events.")])
}

fn view_routes(to: Routes<Arc<App>>) -> Routes<Arc<App>> {
    to.get(
        "/v1/view",
        "the scene on board as the page at /view draws it: cells, fetched area, robot",
        view::describe,
    )
    .errors(&[FAILED, NO_SCENE, BUDGET])
    .get("/v1/view/scores", "the score of every Gaussian on board, a byte each, in binary", view::scores)
    .details(
        "Little-endian: the bytes SLGS, version 1 (u32), least and largest score (f32 each), number of cells and generation (u32 each); for each cell its id and number of Gaussians (u32 each); then a byte b for each Gaussian: 0 if no view shows it, else its centroid's score is least + b / 255 * (largest - least). With negatives, scores are relevancies.",
    )
    .errors(&[FAILED, NO_SCENE, OTHER_MODEL, WORDS])
    .get("/v1/view/words", "words to ask for, and how many things on board each finds", view::words)
    .details(
        "Those of most things first: all that the text model knows, or of one that takes any text everyday words that find something.",
    )
    .errors(&[FAILED, NO_SCENE, OTHER_MODEL, WORDS])
    .get("/v1/view/cells/{id}", "the Gaussians of a cell, 16 bytes each, in binary", view::cell)
    .details(
        "Little-endian: the bytes SLGG, version 1 and number of Gaussians N (u32 each), origin in the world (f32 x 3), flags (u32; 1: the appearance is known), step (u32); then columns: centres less the origin (f16 x 3), colours (u8 x 3), opacities (u8), sizes and rotations (u8 x 3 each, see docs/formats.md).",
    )
    .parameters([Parameter::of_path::<u32>("id", "the cell's id").limit("maximum", u32::MAX)])
    .errors(&[FAILED, NO_SCENE,
        (404, "The cell is not on board, or another generation is."),
        BUDGET,
    ])
}

/// Answers with what is on board, how old it is, and what is missing.
async fn map(State(app): State<Arc<App>>) -> Result<Json<MapStatus>, Problem> {
    app.blocking(|app| {
        app.reload_if_stale();
        let snapshot = app.engine.snapshot()?;
        let expires_unix_secs =
            accepted(app.engine.cache()).ok().flatten().and_then(|accepted| accepted.expires_unix_secs);
        Ok(Json(map_status(&snapshot, crate::now_unix_secs(), expires_unix_secs)))
    })
    .await
}
