//! The routes, and the limits around them.

use std::path::Path;
use std::sync::Arc;

use axum::error_handling::HandleErrorLayer;
use axum::extract::State;
use axum::http::{StatusCode, Uri};
use axum::response::Redirect;
use axum::routing::get;
use axum::{BoxError, Json, Router};
use schemars::JsonSchema;
use serde::Serialize;
use serde_json::json;
use slag_common::Hash32;
use slag_service::access::Access;
use slag_service::metrics::ResponseCounts;
use slag_service::openapi::About;
use slag_service::params::ParameterMembers;
use slag_service::problem::Problem;
use slag_service::request::observed;
use slag_service::routes::{Parameter, Route, Routes};
use tower::ServiceBuilder;
use tower::limit::GlobalConcurrencyLimitLayer;
use tower::load_shed::LoadShedLayer;
use tower_http::limit::RequestBodyLimitLayer;
use tower_http::timeout::TimeoutLayer;

use super::state::{AppState, Limits, Service, metrics};
use super::{cells, objects, problem};
use crate::store::StoreError;
use crate::store::metadata::TIMESTAMP_FILE;

const ABOUT: About = About {
    name: "slag-encoder serve",
    version: env!("CARGO_PKG_VERSION"),
    license: env!("CARGO_PKG_LICENSE"),
    summary: "slag-encoder serves a scene's shards to robots.",
    errors: &[(503, "Too much is asked at once, or the answer took too long.")],
};
const PAGE: &str = "/view";
const STORE: [(u16, &str); 1] = [(500, "The service failed.")];
/// No request needs a body; a few bytes do no harm.
const REQUEST_BODY_BYTES: usize = 1024;

/// A store's service with a page's routes, without a listener.
pub(crate) fn router(dir: &Path, limits: Limits, access: Access, page: Router) -> Result<Router, StoreError> {
    let service = Arc::new(Service::open(dir, &limits)?);
    let responses = Arc::clone(&service.responses);
    let (router, _) = described();
    Ok(counted(router.with_state(service).merge(page), limits, responses, access))
}

/// Wraps a page's routes in the limits, with a problem as the body of every error. Instead of a list of resources, it
/// sends browsers to the page.
pub fn bounded(routes: Router, limits: Limits, access: Access) -> Router {
    let to_page = get(async || Redirect::temporary(PAGE));
    counted(routes.route("/", to_page).fallback(nothing_there), limits, Arc::default(), access)
}

async fn nothing_there(uri: Uri) -> Problem {
    let shown: String = uri.path().chars().take(80).collect();
    let detail = format!("there is nothing at {shown:?}; the page is at {PAGE}");
    Problem::new(StatusCode::NOT_FOUND, "not-found", "Not found", detail)
}

pub(super) fn described() -> (Router<Arc<Service>>, Vec<Route>) {
    routes().described::<ParameterMembers>(ABOUT)
}

fn routes() -> Routes<Arc<Service>> {
    let name = |summary| Parameter::of_path::<String>("name", summary);
    let known = Parameter::of_header("If-None-Match", "the etag of what the client has");
    Routes::default()
        .get("/v1/manifest", "manifest of the current generation, with ETag", objects::manifest)
        .parameters([known.clone()])
        .errors(&STORE)
        .get("/v1/metadata/{name}", "TUF metadata, such as timestamp.json", objects::metadata)
        .parameters([name(
            "timestamp.json, or VERSION.root.json, VERSION.snapshot.json, VERSION.targets.json",
        )
        .limit("examples", json!([TIMESTAMP_FILE]))])
        .errors(&STORE)
        .errors(&[(404, "The store has no such metadata.")])
        .get("/v1/targets/{name}", "the TUF target SHA256.manifest", objects::target)
        .parameters([name("SHA256.manifest, as the metadata states it")])
        .errors(&STORE)
        .errors(&[(404, "It is no target of the current or the previous generation.")])
        .get("/v1/objects/{hash}", "shard of the current or previous manifest; byte ranges", objects::object)
        .parameters([
            Parameter::of_path::<Hash32>("hash", "BLAKE3 of the shard, as the manifest states it"),
            known,
            Parameter::of_header("Range", "bytes=FIRST-LAST, one range; others are ignored"),
            Parameter::of_header("If-Range", "the etag of what the client has begun to download"),
        ])
        .errors(&STORE)
        .errors(&[
            (404, "It is no shard of the current or the previous generation."),
            (416, "No byte of the range is in the shard."),
        ])
        .get("/v1/cells", "cells near a point, with distances and shards", cells::cells)
        .details("The point is x, y and z, or lat and lon.")
        .errors(&STORE)
        .get("/v1/coverage.geojson", "footprints of the cells on the earth (RFC 7946)", cells::coverage)
        .errors(&STORE)
        .errors(&[(409, "The scene is not geo-referenced.")])
        .get("/healthz", "whether the process is alive, and the generation served", health)
        .errors(&STORE)
        .get("/metrics", "counters in Prometheus' text format", metrics)
        .errors(&STORE)
}

/// Wraps routes in the limits, with a problem as the body of every error.
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
        // One count for all routes; the plain layer would count each route.
        .layer(GlobalConcurrencyLimitLayer::new(limits.n_requests))
        .layer(RequestBodyLimitLayer::new(REQUEST_BODY_BYTES))
        .layer(timeout);
    observed(routes.layer(shed), responses, access)
}

/// That the service answers.
#[derive(Serialize, JsonSchema)]
struct Health {
    /// ok.
    #[schemars(extend("const" = "ok"))]
    status: &'static str,
    /// The generation served.
    generation: u64,
}

async fn health(State(service): AppState) -> Result<Json<Health>, Problem> {
    let generation = service.with_current(|snapshot| Ok(snapshot.world().generation)).await?;
    Ok(Json(Health { status: "ok", generation }))
}
