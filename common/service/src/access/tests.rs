use axum::body::Body;

use super::*;

const TOKEN: &str = "0123456789abcdef0123456789abcdef";

fn local() -> Listen {
    "127.0.0.1:7734".parse().expect("an address")
}

fn access(at: &str, hosts: &[&str], origins: &[&str], token: Option<&str>) -> Result<Access, AccessError> {
    let owned = |texts: &[&str]| texts.iter().map(|text| (*text).to_owned()).collect();
    let dir = tempfile::tempdir().expect("a folder");
    let file = dir.path().join("slag-token");
    if let Some(token) = token {
        std::fs::write(&file, token).expect("writes");
    }
    let settings =
        AccessSettings { hosts: owned(hosts), origins: owned(origins), token_file: token.map(|_| file) };
    Access::new(&at.parse().expect("an address"), settings)
}

fn status(access: &Access, method: Method, headers: &[(&str, &str)]) -> u16 {
    let mut request = Request::builder().method(method).uri("/position");
    for (name, value) in headers {
        request = request.header(*name, *value);
    }
    let request = request.body(Body::empty()).expect("a request");
    access.check(&request).map_or_else(|problem| problem.into_response().status().as_u16(), |()| 200)
}

/// The attack: a page's own name resolves to this machine.
#[test]
fn a_rebound_name_is_refused() {
    let access = access("127.0.0.1:7734", &["robot.local"], &[], None).expect("sound");
    let of = |host: &str| status(&access, Method::GET, &[("host", host)]);
    let own = "127.0.0.1:7734 127.0.0.1 [::1]:7734 [::1] localhost:7734 LOCALHOST 10.1.2.3 Robot.Local:80";
    own.split(' ').for_each(|host| assert_eq!(of(host), 200, "{host}"));
    let others = "evil.example evil.example:7734 127.0.0.1.evil.example localhost.evil.example :7734 [evil] ";
    others.split(' ').for_each(|host| assert_eq!(of(host), 421, "{host}"));
    assert_eq!(status(&access.clone().with_any_host(), Method::GET, &[("host", "evil.example")]), 200);
}

/// The attack: a host hidden from the check, but not from a proxy or the handler.
#[test]
fn hosts_that_hide_are_refused() {
    let access = access("127.0.0.1:7734", &[], &[], None).expect("sound");
    let of = |uri: &str, hosts: &[&[u8]]| {
        let mut request = Request::get(uri);
        for host in hosts {
            request = request.header("host", HeaderValue::from_bytes(host).expect("a value"));
        }
        let request = request.body(Body::empty()).expect("a request");
        access.check(&request).map_or_else(|problem| problem.into_response().status().as_u16(), |()| 200)
    };
    assert_eq!(of("/", &[b"localhost"]), 200);
    assert_eq!(of("http://127.0.0.1:7734/", &[b"localhost"]), 200);
    let hidden: [&[&[u8]]; 3] =
        [&[b"evil\xe9.example"], &[b"localhost", b"evil.example"], &[b"localhost", b"localhost"]];
    for hosts in hidden {
        assert_eq!(of("/", hosts), 400, "{hosts:?}");
    }
    assert_eq!(of("http://evil.example/status", &[b"localhost"]), 421);
    assert_eq!(of("http://localhost/status", &[b"evil.example"]), 421);
    assert_eq!(of("http://evil.example/status", &[]), 421);
}

/// The attack: a page of another site sends requests from a person's browser.
#[test]
fn pages_of_others_are_refused_unless_they_are_given() {
    let access = access("127.0.0.1:7734", &[], &["https://map.example"], None).expect("sound");
    let of = |headers: &[(&str, &str)]| {
        status(&access, Method::POST, &[&[("host", "127.0.0.1:7734")], headers].concat())
    };
    assert_eq!(of(&[]), 200);
    assert_eq!(of(&[("origin", "http://127.0.0.1:7734")]), 200);
    assert_eq!(of(&[("origin", "https://map.example")]), 200);
    assert_eq!(of(&[("sec-fetch-site", "same-origin")]), 200);
    assert_eq!(of(&[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "navigate")]), 200);
    for origin in
        ["https://evil.example", "null", "", "http://127.0.0.1:7735", "https://map.example.evil.example"]
    {
        assert_eq!(of(&[("origin", origin)]), 403, "{origin}");
    }
    assert_eq!(of(&[("origin", "https://map.example"), ("origin", "https://evil.example")]), 403);
    assert_eq!(of(&[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "no-cors")]), 403);
}

#[test]
fn writes_beyond_this_machine_need_the_token() {
    let of = |access: &Access, method: Method, value: Option<&str>| {
        let header = value.map(|value| ("authorization", value));
        status(access, method, header.as_slice())
    };
    let open = access("127.0.0.1:7734", &[], &[], None).expect("sound");
    assert_eq!((open.takes_writes(), of(&open, Method::POST, None)), (true, 200));
    for beyond in ["0.0.0.0:7734", "[::]:7734", "192.168.1.4:7734"] {
        let closed = access(beyond, &[], &[], None).expect("sound");
        assert_eq!((closed.takes_writes(), of(&closed, Method::POST, None)), (false, 403));
        assert_eq!(of(&closed, Method::GET, None), 200);
    }
    for listen in ["127.0.0.1:7734", "0.0.0.0:7734", "unix:/run/slag.sock"] {
        let guarded = access(listen, &[], &[], Some(&format!("{TOKEN}\n"))).expect("sound");
        assert_eq!(of(&guarded, Method::POST, Some(&format!("Bearer {TOKEN}"))), 200);
        assert_eq!(of(&guarded, Method::POST, Some(&format!("bearer {TOKEN}"))), 200);
        for wrong in [
            None,
            Some(TOKEN),
            Some("Bearer "),
            Some("Bearer x"),
            Some(&format!("Bearer {TOKEN}0")),
            Some(&format!("Basic {TOKEN}")),
        ] {
            assert_eq!(of(&guarded, Method::POST, wrong), 401, "{wrong:?}");
        }
        assert_eq!(of(&guarded, Method::GET, None), 200);
        assert!(!format!("{guarded:?}").contains(TOKEN));
    }
}

#[test]
fn wrong_settings_are_named() {
    for token in [
        "",
        "short",
        "0123456789abcdef 0123456789abcdef",
        "0123456789abcdé0123456789abcdef",
        &"a".repeat(5000),
    ] {
        let error = access("127.0.0.1:1", &[], &[], Some(token)).expect_err(token).to_string();
        assert!(error.contains("slag-token") && (token.is_empty() || !error.contains(token)), "{error}");
    }
    let missing = AccessSettings { token_file: Some("/nowhere/token".into()), ..AccessSettings::default() };
    let error = Access::new(&local(), missing).expect_err("missing").to_string();
    assert!(error.contains("/nowhere/token"), "{error}");
    for origin in ["*", "map.example", "https://", "https://map.example/", "ftp://map.example", "https://a b"]
    {
        let error = access("127.0.0.1:1", &[], &[origin], None).expect_err(origin).to_string();
        assert!(error.contains("https://map.example"), "{error}");
    }
}
