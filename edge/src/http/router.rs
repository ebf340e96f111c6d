//! The routes.

use std::io;
use std::sync::Arc;

use axum::Router;
use axum::middleware::from_fn;
use slag_service::listen::Listener;
use slag_service::listener;
use slag_service::openapi::About;
use slag_service::request::observed;
use slag_service::routes::{Route, Routes};

use super::app::App;
use super::problem::{FAILED, Members, NO_SCENE, OTHER_MODEL, TIME_BUDGET, WORDS};
use super::{ask, position, query, status, v1};
use crate::fetch::Spoken;

/// This service in its help text and description.
pub(super) const ABOUT: About = About {
    name: "slag-edge",
    version: env!("CARGO_PKG_VERSION"),
    license: env!("CARGO_PKG_LICENSE"),
    summary: "slag-edge answers text queries about the scene around the robot. /view is a page that draws it.",
    errors: &[],
};

fn routes() -> Routes<Arc<App>> {
    v1::routes(Routes::default())
        .get("/query", "objects, clusters or Gaussians that match texts, best first", query::short)
        .details(
            "The same as /v1/query, with answers that come at once, to texts as they are. Long answers are sent in chunks; a cut-off answer ends without the last chunk.",
        )
        .errors(&[FAILED, NO_SCENE, OTHER_MODEL, WORDS, TIME_BUDGET])
        .get(
            "/status",
            "scene, generation, encoder, shards, and whether the scene is past its expiry",
            status::status,
        )
        .post::<Spoken, _, _>(
            "/position",
            "where the robot is, if it is followed; JSON: x, y, z, or lat, lon, height",
            position::MAX_BODY_BYTES,
            position::position,
        )
        .errors(&[
            (409, "Positions are not followed."),
            (503, "The position is kept, but the follower has failed; it begins again by itself."),
        ])
        .get("/healthz", "whether the process is alive", async || "alive\n")
        .get(
            "/readyz",
            "whether a scene is loaded and fits the text model, and positions are followed",
            status::ready,
        )
        .errors(&[
            OTHER_MODEL,
            (500, "The text model has stopped."),
            (503, "No scene is loaded, or the follower has failed; Retry-After has the pause before the next attempt."),
        ])
        .get("/metrics", "counters in Prometheus' text format", status::metrics)
}

pub(super) fn described() -> (Router<Arc<App>>, Vec<Route>) {
    routes().described::<Members>(ABOUT)
}

pub(super) fn router(app: Arc<App>) -> Router {
    let (router, table) = described();
    let reads = table.iter().filter(|route| route.reads).map(|route| route.path).collect();
    let (responses, access) =
        (Arc::clone(&app.metrics.responses), app.settings.access.clone().with_reads(reads));
    let router = router.layer(from_fn(ask::as_in_query));
    observed(router.merge(slag_view::router()).with_state(app), responses, access)
}

/// Serves until `stop` completes, then lets requests in progress finish within the drain deadline.
///
/// # Errors
/// [`io::ErrorKind::TimedOut`] when the deadline cut requests off.
pub async fn serve(
    app: Arc<App>,
    listener: impl Into<Listener>,
    stop: impl Future<Output = ()>,
) -> io::Result<()> {
    let limits = app.settings.connections;
    let stopping = Arc::clone(&app);
    let stop = async move {
        stop.await;
        stopping.stopping.send_replace(true);
    };
    listener::serve(router(app), listener, limits, stop).await
}
