//! Where a service listens: a TCP address, or a Unix domain socket.

use std::fmt;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
#[cfg(unix)]
use tokio::net::UnixListener;

use crate::tls::{Tls, TlsError, TlsFiles};

/// What a Unix socket's address begins with.
const UNIX: &str = "unix:";

/// Where a service listens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Listen {
    /// A TCP address; with port 0 the system chooses the port.
    Tcp(SocketAddr),
    /// The path of a Unix domain socket.
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
    ///
    /// # Errors
    /// [`TlsError`].
    pub fn tls(&self, files: Option<TlsFiles>) -> Result<Option<Tls>, TlsError> {
        match (self, files) {
            (_, None) => Ok(None),
            (Self::Unix(_), Some(_)) => Err(TlsError::UnixSocket),
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
            Some(_) if cfg!(not(unix)) => Err("IP:PORT; this system has no Unix sockets".to_owned()),
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

/// The address that a service cannot listen on.
#[derive(Debug, thiserror::Error)]
#[error("cannot listen on {address}: {cause}; choose another address, port or path")]
pub struct ListenError {
    /// The address.
    pub address: Listen,
    /// The system's error.
    pub cause: io::Error,
}

/// A socket that accepts connections.
#[derive(Debug)]
pub struct Listener {
    socket: Socket,
    tls: Option<Tls>,
}

#[derive(Debug)]
enum Socket {
    Tcp(TcpListener),
    #[cfg(unix)]
    Unix(UnixListener, PathBuf),
}

impl From<TcpListener> for Listener {
    fn from(socket: TcpListener) -> Self {
        Self { socket: Socket::Tcp(socket), tls: None }
    }
}

/// A connection's bytes.
pub(crate) trait Stream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<S: AsyncRead + AsyncWrite + Unpin + Send> Stream for S {}

/// Starts listening. A Unix socket that a dead process left behind is replaced; the new one is open to this user and
/// group only.
///
/// # Errors
/// [`ListenError`].
pub async fn bind(listen: &Listen) -> Result<Listener, ListenError> {
    let bound = match listen {
        Listen::Tcp(address) => TcpListener::bind(address).await.map(Socket::Tcp),
        Listen::Unix(path) => bind_unix(path).await,
    };
    let socket = bound.map_err(|cause| ListenError { address: listen.clone(), cause })?;
    Ok(Listener { socket, tls: None })
}

#[cfg(unix)]
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

#[cfg(not(unix))]
async fn bind_unix(_: &std::path::Path) -> io::Result<Socket> {
    Err(io::ErrorKind::Unsupported.into())
}

impl Listener {
    /// Speaks TLS on the connections.
    #[must_use]
    pub fn with_tls(mut self, tls: Option<Tls>) -> Self {
        self.tls = tls;
        self
    }

    /// Returns what makes TLS connections out of the accepted ones.
    pub(crate) fn tls(&self) -> Option<Tls> {
        self.tls.clone()
    }

    /// Returns the address to connect to: `http://IP:PORT`, with TLS `https://IP:PORT`, or `unix:PATH`.
    ///
    /// # Errors
    /// The system's error.
    pub fn url(&self) -> io::Result<String> {
        match &self.socket {
            Socket::Tcp(socket) => {
                let scheme = if self.tls.is_some() { "https" } else { "http" };
                Ok(format!("{scheme}://{}", socket.local_addr()?))
            }
            #[cfg(unix)]
            Socket::Unix(_, path) => Ok(format!("{UNIX}{}", path.display())),
        }
    }

    /// Accepts a connection; returns its bytes and the address of its other end, if that has one.
    pub(crate) async fn accept(&self) -> io::Result<(Box<dyn Stream>, Option<IpAddr>)> {
        match &self.socket {
            Socket::Tcp(socket) => {
                let (stream, peer) = socket.accept().await?;
                // Otherwise an answer in two pieces may wait 40 ms for the acknowledgement of the first.
                if let Err(error) = stream.set_nodelay(true) {
                    tracing::debug!("TCP_NODELAY is not set on a connection: {error}");
                }
                Ok((Box::new(stream), Some(peer.ip())))
            }
            #[cfg(unix)]
            Socket::Unix(socket, _) => Ok((Box::new(socket.accept().await?.0), None)),
        }
    }
}

/// The path of a Unix socket outlives the socket unless it is removed.
#[cfg(unix)]
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

    #[cfg(unix)]
    #[tokio::test]
    async fn a_dead_socket_is_replaced_and_a_living_one_is_not() {
        let dir = std::env::temp_dir().join(format!("slag-listen-{}", std::process::id()));
        std::fs::create_dir_all(&dir).expect("a folder");
        let listen = Listen::Unix(dir.join("s"));
        drop(std::os::unix::net::UnixListener::bind(dir.join("s")).expect("binds"));
        let living = bind(&listen).await.expect("replaces what nobody listens on");
        let refused = bind(&listen).await.expect_err("in use").to_string();
        assert!(refused.contains("/s") && refused.contains("choose another"), "{refused}");
        drop(living);
        assert!(!dir.join("s").exists());
        std::fs::write(dir.join("s"), b"a file of somebody").expect("writes");
        bind(&listen).await.expect_err("not a socket");
        assert!(dir.join("s").exists());
        std::fs::remove_dir_all(dir).expect("removed");
    }
}
