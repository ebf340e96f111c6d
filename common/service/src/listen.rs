//! A service's address: TCP, or a Unix domain socket.

use std::fmt;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, UnixListener};

use crate::tls::{Tls, TlsError, TlsFiles};

const UNIX: &str = "unix:";

/// Returns whether the service at an address of [`Listener::url`] answers `GET /healthz` over a new connection. With
/// TLS, any answer to a non-handshake suffices. Does not return while the service is silent.
pub async fn answers(url: &str) -> bool {
    ask_for_health(url).await.is_ok_and(|answer| match url.starts_with("https") {
        true => !answer.is_empty(),
        false => answer.starts_with(b"HTTP/1.1 200"),
    })
}

async fn ask_for_health(url: &str) -> io::Result<Vec<u8>> {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    let mut stream: Box<dyn Stream> = match url.strip_prefix(UNIX) {
        Some(path) => Box::new(tokio::net::UnixStream::connect(path).await?),
        None => {
            let (_, address) = url.split_once("://").unwrap_or_default();
            // A service on all addresses is reached through the loopback.
            let address = address.replace("0.0.0.0:", "127.0.0.1:").replace("[::]:", "[::1]:");
            Box::new(tokio::net::TcpStream::connect(address).await?)
        }
    };
    stream.write_all(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").await?;
    let mut answer = Vec::new();
    stream.take(1 << 12).read_to_end(&mut answer).await?;
    Ok(answer)
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Listen {
    /// With port 0 the system chooses the port.
    Tcp(SocketAddr),
    Unix(PathBuf),
}

impl Listen {
    /// Returns whether only programs of this machine can connect.
    pub fn is_local(&self) -> bool {
        match self {
            Self::Tcp(address) => address.ip().to_canonical().is_loopback(),
            Self::Unix(_) => true,
        }
    }

    /// Reads the certificate of a service that listens here, if it has one.
    pub fn tls(&self, files: Option<TlsFiles>) -> Result<Option<Tls>, TlsError> {
        match (self, files) {
            (_, None) => Ok(None),
            (Self::Unix(_), Some(_)) => {
                let advice = "TLS is for IP:PORT, not for a Unix socket; leave --tls-cert and --tls-key out";
                Err(TlsError(advice.to_owned()))
            }
            (Self::Tcp(_), Some(files)) => Tls::open(files).map(Some),
        }
    }
}

impl From<SocketAddr> for Listen {
    fn from(address: SocketAddr) -> Self {
        Self::Tcp(address)
    }
}

impl FromStr for Listen {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.strip_prefix(UNIX) {
            Some("") => Err("a path after unix:".to_owned()),
            Some(path) => Ok(Self::Unix(path.into())),
            None => text.parse().map(Self::Tcp).map_err(|_| "IP:PORT or unix:PATH".to_owned()),
        }
    }
}

/// `IP:PORT` or `unix:PATH`.
impl fmt::Display for Listen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => write!(f, "{address}"),
            Self::Unix(path) => write!(f, "{UNIX}{}", path.display()),
        }
    }
}

#[derive(Debug, thiserror::Error)]
#[error("cannot listen on {address}: {cause}; choose another address, port or path")]
pub struct ListenError {
    pub address: Listen,
    pub cause: io::Error,
}

#[derive(Debug)]
pub struct Listener {
    socket: Socket,
    /// Wraps accepted connections in TLS.
    pub(crate) tls: Option<Tls>,
}

#[derive(Debug)]
enum Socket {
    Tcp(TcpListener),
    Unix(UnixListener, PathBuf),
}

impl From<TcpListener> for Listener {
    fn from(socket: TcpListener) -> Self {
        Self { socket: Socket::Tcp(socket), tls: None }
    }
}

pub(crate) trait Stream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<S: AsyncRead + AsyncWrite + Unpin + Send> Stream for S {}

/// Starts listening. Replaces a Unix socket left by a dead process; the new one is open to this user and group only.
pub async fn bind(listen: &Listen) -> Result<Listener, ListenError> {
    let bound = match listen {
        Listen::Tcp(address) => TcpListener::bind(address).await.map(Socket::Tcp),
        Listen::Unix(path) => bind_unix(path).await,
    };
    let socket = bound.map_err(|cause| ListenError { address: listen.clone(), cause })?;
    Ok(Listener { socket, tls: None })
}

async fn bind_unix(path: &std::path::Path) -> io::Result<Socket> {
    use std::os::unix::fs::{FileTypeExt, PermissionsExt};

    let is_socket = std::fs::symlink_metadata(path).is_ok_and(|found| found.file_type().is_socket());
    if is_socket && tokio::net::UnixStream::connect(path).await.is_err() {
        std::fs::remove_file(path)?;
    }
    let socket = UnixListener::bind(path)?;
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o660))?;
    Ok(Socket::Unix(socket, path.to_owned()))
}

impl Listener {
    #[must_use]
    pub fn with_tls(mut self, tls: Option<Tls>) -> Self {
        self.tls = tls;
        self
    }

    /// Returns the address to connect to: `http://IP:PORT`, with TLS `https://IP:PORT`, or `unix:PATH`.
    pub fn url(&self) -> io::Result<String> {
        match &self.socket {
            Socket::Tcp(socket) => {
                let scheme = if self.tls.is_some() { "https" } else { "http" };
                Ok(format!("{scheme}://{}", socket.local_addr()?))
            }
            Socket::Unix(_, path) => Ok(format!("{UNIX}{}", path.display())),
        }
    }

    /// Accepts a connection; returns its stream and peer address, if any.
    pub(crate) async fn accept(&self) -> io::Result<(Box<dyn Stream>, Option<IpAddr>)> {
        match &self.socket {
            Socket::Tcp(socket) => {
                let (stream, peer) = socket.accept().await?;
                // Otherwise an answer in two pieces may wait 40 ms for the first one's acknowledgement.
                if let Err(error) = stream.set_nodelay(true) {
                    tracing::debug!("TCP_NODELAY is not set on a connection: {error}");
                }
                Ok((Box::new(stream), Some(peer.ip())))
            }
            Socket::Unix(socket, _) => Ok((Box::new(socket.accept().await?.0), None)),
        }
    }
}

/// The path of a Unix socket outlives the socket.
impl Drop for Listener {
    fn drop(&mut self) {
        if let Socket::Unix(_, path) = &self.socket
            && let Err(error) = std::fs::remove_file(path)
        {
            tracing::debug!("{} is left behind: {error}", path.display());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_parse_or_say_what_they_should_be() {
        let local = |text: &str| text.parse::<Listen>().map(|listen| (listen.to_string(), listen.is_local()));
        for (text, is_local) in [
            ("127.0.0.1:7734", true),
            ("[::1]:7734", true),
            ("[::ffff:127.0.0.1]:7734", true),
            ("0.0.0.0:7734", false),
            ("192.168.1.4:0", false),
            ("[::]:1", false),
            ("unix:/run/slag.sock", true),
        ] {
            assert_eq!(local(text), Ok((text.to_owned(), is_local)));
        }
        for bad in ["", "nowhere", "127.0.0.1", "localhost:7734", "unix:", "/run/slag.sock"] {
            assert!(local(bad).is_err(), "{bad}");
        }
    }

    /// A bound address is not enough: the accept loop must answer.
    #[tokio::test]
    async fn only_a_service_that_accepts_answers() {
        let listen: Listen = "0.0.0.0:0".parse().expect("an address");
        let listener = bind(&listen).await.expect("binds");
        let url = listener.url().expect("an address");
        let wait = std::time::Duration::from_millis(200);
        assert!(tokio::time::timeout(wait, answers(&url)).await.is_err(), "nobody accepts");
        let router = axum::Router::new().route("/healthz", axum::routing::get(async || "alive"));
        let limits = crate::listener::ConnectionLimits::default();
        let served = tokio::spawn(crate::listener::serve(router, listener, limits, std::future::pending()));
        assert!(tokio::time::timeout(10 * wait, answers(&url)).await.expect("in time"));
        served.abort();
        let _ = served.await;
        assert!(!answers(&url).await, "nobody listens");
    }

    #[tokio::test]
    async fn a_dead_socket_is_replaced_and_a_living_one_is_not() {
        let dir = tempfile::tempdir().expect("a folder");
        let socket = dir.path().join("s");
        let listen = Listen::Unix(socket.clone());
        drop(std::os::unix::net::UnixListener::bind(&socket).expect("binds"));
        let living = bind(&listen).await.expect("replaces what nobody listens on");
        let refused = bind(&listen).await.expect_err("in use").to_string();
        assert!(refused.contains("/s") && refused.contains("choose another"), "{refused}");
        drop(living);
        assert!(!socket.exists());
        std::fs::write(&socket, b"a file of somebody").expect("writes");
        bind(&listen).await.expect_err("not a socket");
        assert!(socket.exists());
    }
}
