//! TLS between the real programs, with certificates of a test authority.

use slag_tests::*;

#[test]
fn robots_and_stores_speak_tls() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| dir.path().join(name);
    let (store, cert, key) = (at("store"), at("cert.pem"), at("key.pem"));
    encoded_into(&store, &ROOM, &SITE);
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
    // The public authorities and another one do not vouch for it; a file that is no authority is named.
    refused(&mut add(&[]), "UnknownIssuer; give the authority that vouches for the server with --ca FILE");
    refused(&mut add(&ca(&other)), "UnknownIssuer");
    refused(&mut add(&["--ca".into(), text(&key).into()]), "key.pem: no certificate is there");
    run(&mut add(&ca(&authority)));
    refused(&mut fetch(&ca(&other)), "UnknownIssuer");
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
    refused(&mut fetch(&ca(&authority)), "UnknownIssuer");
    run(&mut fetch(&ca(&other)));

    // A certificate that only an authority may have, and an address with http.
    other.issue_as(rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained), &cert, &key);
    refused(&mut fetch(&ca(&other)), "basicConstraints=critical,CA:FALSE");
    let plain = service.url.replace("https://", "http://");
    refused(
        &mut edge(&["fetch", "--from", &plain, "--at", "3.5,2.7,0", "--cache", text(&at("cache"))]),
        "give its address with https://",
    );

    let serve = |flags: &[&str]| {
        let mut command = encoder(&["serve", "--store", text(&store)]);
        String::from_utf8(command.args(flags).output().expect("runs").stderr).expect("text")
    };
    assert!(serve(&["--tls-cert", text(&cert)]).contains("--tls-key <FILE>"));
    assert!(serve(&[&tls[..], &["--listen", "unix:s"]].concat()).contains("not for a Unix socket"));
}
