//! The routes.

use std::io;
use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::http::{HeaderName, HeaderValue, Request, StatusCode, header};
use slag_service::listen::Listener;
use slag_service::listener;
use slag_service::request::observed;
use slag_service::routes::Routes;
use tower::ServiceExt;

use super::app::App;
use super::{params, position, query, status, v1};

/// First line of the help text.
const TITLE: &str =
    "slag-edge answers text queries about the scene around the robot. /view is a page that draws it.";
/// The description for programs. It is kept by hand, not by `utoipa`: a test compares it with every route, parameter and
/// answer, and most of its text is no doc comment of a type.
pub(super) const OPENAPI: &str = include_str!("openapi.json");
const JSON: (HeaderName, HeaderValue) = (header::CONTENT_TYPE, HeaderValue::from_static("application/json"));

/// Returns the routes.
pub(super) fn routes() -> Routes<Arc<App>> {
    v1::routes(Routes::default())
        .get("/query", "objects, clusters or Gaussians that match texts, best first", query::query)
        .parameters(params::parameters())
        .get(
            "/status",
            "scene, generation, encoder, shards, and whether the scene is past its expiry",
            status::status,
        )
        .post(
            "/position",
            "where the robot is, if it is followed; JSON: x, y, z, or lat, lon, height",
            position::MAX_BODY_BYTES,
            position::position,
        )
        .get("/healthz", "whether the process is alive", async || "alive\n")
        .get(
            "/readyz",
            "whether a scene is loaded and fits the text model, and positions are followed",
            status::ready,
        )
        .get("/metrics", "counters in Prometheus' text format", status::metrics)
        .get("/openapi.json", "description of this service for programs", async || ([JSON], OPENAPI))
}

/// Returns the service, without a listener.
pub(super) fn router(app: Arc<App>) -> Router {
    let (responses, access) = (Arc::clone(&app.metrics.responses), app.settings.access.clone());
    let (router, _) = routes().with_help(TITLE);
    observed(router.merge(slag_view::router()).with_state(app), responses, access)
}

/// Returns whether the service answers `GET /healthz` to itself: its threads, its routes and their limits work.
pub async fn is_alive(app: Arc<App>) -> bool {
    let Ok(request) = Request::get("/healthz").body(Body::empty()) else { return false };
    let answered = router(app).oneshot(request).await;
    answered.is_ok_and(|response| response.status() == StatusCode::OK)
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
    Ok(listener::serve(router(app), listener, limits, stop).await?)
}
