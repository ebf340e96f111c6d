//! Streamable HTTP.

use std::sync::Arc;

use anyhow::Result;
use axum::Router;
use rmcp::transport::streamable_http_server::session::never::NeverSessionManager;
use rmcp::transport::streamable_http_server::{StreamableHttpServerConfig, StreamableHttpService};
use slag_service::listen::{Listen, Listener};
use slag_service::listener::{self, ConnectionLimits};

use crate::Tools;
use crate::locate::MAX_MESSAGE_BYTES;

pub const PATH: &str = "/mcp";

/// Serves until `stop` completes.
///
/// A request names one of `hosts`, this machine or the address listened on: a page that made its own name point
/// here (DNS rebinding) names itself. Requests of web pages (`Origin`) are refused. There are no sessions, so
/// nothing is kept between requests.
pub async fn serve(
    tools: Tools,
    listener: Listener,
    hosts: Vec<String>,
    stop: impl Future<Output = ()>,
) -> Result<()> {
    let config = StreamableHttpServerConfig::default()
        .with_allowed_hosts(hosts)
        .enforce_origin_validation()
        .with_legacy_session_mode(false)
        .with_json_response(true)
        .with_max_request_body_bytes(MAX_MESSAGE_BYTES);
    let sessions = Arc::<NeverSessionManager>::default();
    let service = StreamableHttpService::new(move || Ok(tools.clone()), sessions, config);
    let router = Router::new().route_service(PATH, service);
    Ok(listener::serve(router, listener, ConnectionLimits::default(), stop).await?)
}

/// Returns the names that requests may be for.
pub fn hosts(listen: &Listen, given: Vec<String>) -> Vec<String> {
    let mut hosts: Vec<String> = ["localhost", "127.0.0.1", "::1"].map(str::to_owned).into();
    if let Listen::Tcp(address) = listen {
        hosts.push(address.ip().to_string());
    }
    hosts.extend(given);
    hosts
}
