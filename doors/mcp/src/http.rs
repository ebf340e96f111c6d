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
/// Open connections, and those of one peer: together at most 0.5 GB of the longest messages. The oldest make room.
const N_CONNECTIONS: usize = 32;
const N_PER_PEER: usize = 24;

/// Serves until `stop` completes.
///
/// A request names one of `hosts`, this machine or the address listened on, which stops DNS rebinding: a page sends
/// its own name. Requests of web pages (`Origin`) are refused. Nothing is kept between requests: no sessions.
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
    let limits = ConnectionLimits {
        n_connections: N_CONNECTIONS,
        n_per_peer: N_PER_PEER,
        n_reserved: 1,
        ..ConnectionLimits::default()
    };
    Ok(listener::serve(router, listener, limits, stop).await?)
}

/// Returns the names accepted as `Host`.
pub fn hosts(listen: &Listen, given: Vec<String>) -> Vec<String> {
    let mut hosts: Vec<String> = ["localhost", "127.0.0.1", "::1"].map(str::to_owned).into();
    if let Listen::Tcp(address) = listen {
        hosts.push(address.ip().to_string());
    }
    hosts.extend(given);
    hosts
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use slag_robot::Robot;
    use slag_service::listen::bind;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;

    use super::*;

    /// Each may send a message of 16 MB: one client cannot fill the memory with them.
    #[tokio::test]
    async fn few_messages_are_held_at_a_time() {
        let listener = bind(&"127.0.0.1:0".parse().expect("an address")).await.expect("a port");
        let address = listener.url().expect("bound").replace("http://", "");
        let tools = Tools::new(Robot::new("http://127.0.0.1:9", None));
        let serving = tokio::spawn(serve(tools, listener, Vec::new(), std::future::pending()));
        let mut waiting = Vec::new();
        for _ in 0..N_PER_PEER + 2 {
            let mut client = TcpStream::connect(&address).await.expect("listens");
            client.write_all(b"POST ").await.expect("sends");
            waiting.push(client);
        }
        // The first one beyond the limit ends long before its head is due.
        let mut nothing = Vec::new();
        let ended =
            tokio::time::timeout(Duration::from_secs(5), waiting[N_PER_PEER].read_to_end(&mut nothing));
        drop(ended.await.expect("ends"));
        serving.abort();
    }
}
