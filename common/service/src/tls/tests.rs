use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use axum::Router;
use axum::routing::get;
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use rustls::pki_types::ServerName;
use rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};

use super::*;
use crate::listen::{Listen, bind};
use crate::listener::{ConnectionLimits, serve};

struct Authority {
    issuer: Issuer<'static, KeyPair>,
    certificate: CertificateDer<'static>,
}

impl Authority {
    fn new(name: &str) -> Self {
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().expect("a key");
        let certificate = params.self_signed(&key).expect("signed").der().clone();
        Self { issuer: Issuer::new(params, key), certificate }
    }

    fn issue(&self, name: &str, files: &TlsFiles) {
        let key = KeyPair::generate().expect("a key");
        let params = CertificateParams::new([name.to_owned()]).expect("a name");
        let certificate = params.signed_by(&key, &self.issuer).expect("signed");
        std::fs::write(&files.key, key.serialize_pem()).expect("written");
        std::fs::write(&files.cert, certificate.pem()).expect("written");
    }

    /// Sends a request over TLS; returns the server's certificate, and the answer.
    fn ask(&self, address: &str, name: &str) -> Result<(Vec<u8>, String), io::Error> {
        let mut roots = RootCertStore::empty();
        roots.add(self.certificate.clone()).expect("a root");
        let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .expect("TLS")
            .with_root_certificates(roots)
            .with_no_client_auth();
        let name = ServerName::try_from(name.to_owned()).expect("a name");
        let connection = ClientConnection::new(Arc::new(config), name).expect("begins");
        let socket = TcpStream::connect(address)?;
        socket.set_read_timeout(Some(Duration::from_secs(10)))?;
        let mut stream = StreamOwned::new(connection, socket);
        stream.write_all(b"GET /quick HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        let shown = stream.conn.peer_certificates().expect("shown")[0].to_vec();
        Ok((shown, answer))
    }
}

fn folder() -> (tempfile::TempDir, TlsFiles) {
    let dir = tempfile::tempdir().expect("a folder");
    let [cert, key] = ["cert.pem", "key.pem"].map(|name| dir.path().join(name));
    (dir, TlsFiles { cert, key })
}

async fn start(files: &TlsFiles, limits: ConnectionLimits) -> String {
    let any_port: Listen = "127.0.0.1:0".parse().expect("an address");
    let listener = bind(&any_port).await.expect("binds");
    let listener = listener.with_tls(Some(Tls::open(files.clone()).expect("a certificate")));
    let url = listener.url().expect("bound");
    // Longer than a TLS record.
    let router = Router::new().route("/quick", get(async || "done".repeat(20_000)));
    tokio::spawn(serve(router, listener, limits, std::future::pending()));
    url.strip_prefix("https://").expect("TLS").to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_renewed_certificate_is_used_and_half_a_renewal_is_not() {
    let (_folder, files) = folder();
    let (authority, other) = (Authority::new("one"), Authority::new("other"));
    authority.issue("localhost", &files);
    let address = start(&files, ConnectionLimits::default()).await;
    let (first, answer) = authority.ask(&address, "localhost").expect("trusted");
    assert!(answer.starts_with("HTTP/1.1 200") && answer.ends_with(&"done".repeat(20_000)));
    let refused = other.ask(&address, "localhost").expect_err("another authority");
    assert!(refused.to_string().contains("UnknownIssuer"), "{refused}");
    let refused = authority.ask(&address, "elsewhere").expect_err("another name");
    assert!(refused.to_string().contains("not valid for name"), "{refused}");

    // A new certificate with the old key: not a pair.
    let old_key = std::fs::read(&files.key).expect("there");
    authority.issue("localhost", &files);
    let new_key = std::fs::read(&files.key).expect("there");
    std::fs::write(&files.key, old_key).expect("written");
    assert_eq!(authority.ask(&address, "localhost").expect("the first is used on").0, first);
    std::fs::write(&files.key, new_key).expect("written");
    // Lengths may be equal, and the file system's clock coarse.
    let later = SystemTime::now() + Duration::from_secs(5);
    std::fs::File::options()
        .write(true)
        .open(&files.key)
        .and_then(|f| f.set_modified(later))
        .expect("touched");
    let (second, _) = authority.ask(&address, "localhost").expect("trusted");
    assert_ne!(second, first);
    std::fs::remove_file(&files.cert).expect("there");
    assert_eq!(authority.ask(&address, "localhost").expect("used on").0, second);
}

#[tokio::test(flavor = "multi_thread")]
async fn plain_and_silent_clients_are_let_go() {
    let (_folder, files) = folder();
    let authority = Authority::new("one");
    authority.issue("localhost", &files);
    let limits = ConnectionLimits { head_timeout: Duration::from_millis(300), ..ConnectionLimits::default() };
    let address = start(&files, limits).await;
    for text in ["", "GET /quick HTTP/1.1\r\nHost: localhost\r\n\r\n"] {
        let mut stream = TcpStream::connect(&address).expect("listens");
        stream.set_read_timeout(Some(Duration::from_secs(10))).expect("set");
        stream.write_all(text.as_bytes()).expect("sent");
        let mut received = Vec::new();
        // A reset is an end, too; a time-out is none.
        let ended = stream.read_to_end(&mut received);
        assert!(!matches!(&ended, Err(e) if e.kind() == io::ErrorKind::WouldBlock), "{text}: {ended:?}");
        assert!(!String::from_utf8_lossy(&received).contains("200 OK"));
    }
    authority.ask(&address, "localhost").expect("answers on");
}

#[test]
fn files_without_a_pair_are_named() {
    let (_folder, files) = folder();
    let refused = |files: &TlsFiles| Tls::open(files.clone()).expect_err("no pair").to_string();
    assert!(refused(&files).contains("cert.pem: ") && refused(&files).contains("expected a certificate"));
    Authority::new("one").issue("localhost", &files);
    Tls::open(files.clone()).expect("a pair");
    let socket = Listen::Unix("s".into()).tls(Some(files.clone()));
    assert!(socket.expect_err("no TLS").to_string().contains("not for a Unix socket"));
    let swapped = TlsFiles { cert: files.key.clone(), key: files.cert.clone() };
    assert!(refused(&swapped).contains("none is there, expected a certificate"), "{}", refused(&swapped));
    let key = KeyPair::generate().expect("a key");
    std::fs::write(&files.key, key.serialize_pem()).expect("written");
    assert!(refused(&files).contains("expected a certificate and its own key"), "{}", refused(&files));
}
