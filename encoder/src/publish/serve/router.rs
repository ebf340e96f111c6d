//! The routes, and the limits around them.

use std::path::Path;
use std::sync::Arc;

use axum::error_handling::HandleErrorLayer;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::{BoxError, Json, Router};
use serde_json::json;
use slag_service::access::Access;
use slag_service::metrics::ResponseCounts;
use slag_service::problem::Problem;
use slag_service::request::observed;
use slag_service::routes::{Parameter, Routes};
use tower::ServiceBuilder;
use tower::limit::GlobalConcurrencyLimitLayer;
use tower::load_shed::LoadShedLayer;
use tower_http::limit::RequestBodyLimitLayer;
use tower_http::timeout::TimeoutLayer;

use super::limits::Limits;
use super::state::{AppState, Service, metrics};
use super::{cells, metadata, objects, problem};
use crate::store::StoreError;

/// First line of the help text.
const TITLE: &str = "slag-encoder serves a scene's shards to robots.";
/// The description for programs, kept by hand; a test compares it with every route and parameter.
pub(super) const OPENAPI: &str = include_str!("openapi.json");
/// No request here needs a body; a few bytes of a careless client do no harm.
const REQUEST_BODY_BYTES: usize = 1024;

/// Returns the service of a store, without a listener.
///
/// # Errors
/// [`StoreError`] if nothing is published or the store cannot be read.
pub fn router(dir: &Path, limits: Limits, access: Access) -> Result<Router, StoreError> {
    router_with(dir, limits, access, Router::new())
}

/// As [`router`], with a page's routes beside the store's.
///
/// # Errors
/// As [`router`].
pub fn router_with(dir: &Path, limits: Limits, access: Access, page: Router) -> Result<Router, StoreError> {
    let service = Arc::new(Service::open(dir, &limits)?);
    let responses = Arc::clone(&service.responses);
    let (router, _) = routes().with_help(TITLE);
    Ok(counted(router.with_state(service).merge(page), limits, responses, access))
}

/// Puts the limits around routes of a page, and a problem as the body of every error.
pub fn bounded(routes: Router, limits: Limits, access: Access) -> Router {
    counted(routes, limits, Arc::default(), access)
}

/// Returns the routes.
pub(super) fn routes() -> Routes<Arc<Service>> {
    Routes::default()
        .get("/v1/manifest", "manifest of the current generation, with ETag", objects::manifest)
        .get("/v1/metadata/{name}", "TUF metadata, such as timestamp.json", metadata::metadata)
        .get("/v1/targets/{name}", "the TUF target SHA256.manifest", metadata::target)
        .get("/v1/objects/{hash}", "shard of the current or previous manifest; byte ranges", objects::object)
        .get("/v1/cells", "cells near a point, with distances and shards", cells::cells)
        .parameters([
            Parameter::new("x", "1", "centre in the world frame, with y and z"),
            Parameter::new("y", "2", ""),
            Parameter::new("z", "3", ""),
            Parameter::new("lat", "46.8", "or centre on the earth, degrees WGS 84, with lon"),
            Parameter::new("lon", "-92", ""),
            Parameter::new("height", "158.5", "metres above the ellipsoid (default: the scene's origin)"),
            Parameter::new("radius", "50", "distance from the centre, units of the world frame"),
        ])
        .get("/v1/coverage.geojson", "footprints of the cells on the earth", cells::coverage)
        .get("/healthz", "whether the process is alive, and the generation served", health)
        .get("/metrics", "counters in Prometheus' text format", metrics)
        .get("/openapi.json", "description of this service for programs", openapi)
}

/// Puts the limits around routes, and a problem as the body of every error.
pub(super) fn counted(
    routes: Router,
    limits: Limits,
    responses: Arc<ResponseCounts>,
    access: Access,
) -> Router {
    let timeout = TimeoutLayer::with_status_code(StatusCode::SERVICE_UNAVAILABLE, limits.answer_timeout);
    let shed = ServiceBuilder::new()
        .layer(HandleErrorLayer::new(|_: BoxError| std::future::ready(problem::busy())))
        .layer(LoadShedLayer::new())
        // One count for all routes; the plain layer would give each route its own.
        .layer(GlobalConcurrencyLimitLayer::new(limits.n_requests))
        .layer(RequestBodyLimitLayer::new(REQUEST_BODY_BYTES))
        .layer(timeout);
    observed(routes.layer(shed), responses, access)
}

async fn openapi() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], OPENAPI)
}

async fn health(State(service): AppState) -> Result<Json<serde_json::Value>, Problem> {
    let generation = service.with_current(|snapshot| Ok(snapshot.world().generation)).await?;
    Ok(Json(json!({ "status": "ok", "generation": generation })))
}
