//! TLS between the real programs, with certificates of an authority of our own.

use std::path::{Path, PathBuf};
use std::process::Command;

use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use slag_tests::*;

/// A certificate authority, and the file of its certificate.
struct Authority {
    issuer: Issuer<'static, KeyPair>,
    file: PathBuf,
}

impl Authority {
    fn new(file: PathBuf) -> Self {
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, text(&file));
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().expect("a key");
        fs_err::write(&file, params.self_signed(&key).expect("signed").pem()).expect("written");
        Self { issuer: Issuer::new(params, key), file }
    }

    /// Writes a certificate for this machine, and its key.
    fn issue(&self, cert: &Path, key: &Path) {
        let own = KeyPair::generate().expect("a key");
        let params = CertificateParams::new(["127.0.0.1".to_owned()]).expect("an address");
        fs_err::write(key, own.serialize_pem()).expect("written");
        fs_err::write(cert, params.signed_by(&own, &self.issuer).expect("signed").pem()).expect("written");
    }

    /// Asks a service, as a client that knows this authority alone.
    fn get(&self, url: &str) -> Result<String, ureq::Error> {
        let pem = fs_err::read(&self.file).expect("there");
        let root = ureq::tls::Certificate::from_pem(&pem).expect("a certificate");
        let roots = ureq::tls::RootCerts::new_with_certs(&[root]);
        let tls = ureq::tls::TlsConfig::builder().root_certs(roots).build();
        let agent = ureq::Agent::config_builder().tls_config(tls).build().new_agent();
        agent.get(url).call()?.body_mut().read_to_string()
    }
}

#[test]
fn robots_and_stores_speak_tls() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| dir.path().join(name);
    let (room, store, cert, key) = (at("room"), at("store"), at("cert.pem"), at("key.pem"));
    run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", "3"]));
    run(encode_room(&room, &store).args(["--models", "colours"]));
    let (authority, other) = (Authority::new(at("ca.pem")), Authority::new(at("other.pem")));
    authority.issue(&cert, &key);
    let tls = ["--tls-cert", text(&cert), "--tls-key", text(&key)];
    let service = Service::start(encoder(&["serve", "--store", text(&store)]).args(tls));
    assert!(service.url.starts_with("https://"), "{}", service.url);

    let ca = |authority: &Authority| ["--ca".to_owned(), text(&authority.file).to_owned()];
    let add = |args: &[String]| {
        let mut command =
            edge(&["trust", "add", &service.url, "--trust-first", "--cache", text(&at("cache"))]);
        command.args(args);
        command
    };
    let fetch = |args: &[String]| {
        let mut command =
            edge(&["fetch", "--from", &service.url, "--at", "3.5,2.7,0", "--cache", text(&at("cache"))]);
        command.args(args);
        command
    };
    let refused = |mut command: Command, expected: &str| {
        let output = command.output().expect("runs");
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && error.contains(expected), "{error}");
    };
    // Neither the public authorities nor another one vouch for it, and what is no authority is named.
    refused(add(&[]), "UnknownIssuer; give the authority that vouches for the server with --ca FILE");
    refused(add(&ca(&other)), "UnknownIssuer");
    refused(add(&["--ca".into(), text(&key).into()]), "key.pem: no certificate is there");
    run(&mut add(&ca(&authority)));
    refused(fetch(&ca(&other)), "UnknownIssuer");
    assert_eq!(run_json(&mut fetch(&ca(&authority)))["bad_cells"], serde_json::json!([]));

    // The robot's own service, which follows the store.
    let robot = Service::start(
        edge(&["serve", "--models", "colours", "--cache", text(&at("cache")), "--follow", &service.url])
            .args(tls)
            .args(ca(&authority)),
    );
    assert!(authority.get(&format!("{}/query?text=blue", robot.url)).expect("answers").contains("blue"));
    assert!(other.get(&format!("{}/healthz", robot.url)).is_err());

    // A renewed certificate by another authority, without a restart.
    other.issue(&cert, &key);
    assert!(other.get(&format!("{}/healthz", robot.url)).is_ok());
    refused(fetch(&ca(&authority)), "UnknownIssuer");
    run(&mut fetch(&ca(&other)));

    let half = encoder(&["serve", "--store", text(&store), "--tls-cert", text(&cert)]);
    refused(half, "--tls-key <FILE>");
    let mut socket = encoder(&["serve", "--store", text(&store), "--listen", "unix:s"]);
    socket.args(tls);
    refused(socket, "not for a Unix socket");
}
