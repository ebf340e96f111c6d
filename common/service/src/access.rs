//! Access checks: `Host`, `Origin` and bearer tokens, and CORS.
//!
//! A browser on the robot's network runs pages of strangers. Such a page can send requests to the robot, and by DNS
//! rebinding (its own name then resolves to the robot's address) read the answers. Three checks stop that. The `Host`
//! must be an IP address, `localhost` or a configured name: a stranger's page always sends its own name. A foreign
//! `Origin` (RFC 6454) is refused unless configured, as is a request that the browser marks as cross-site
//! (`Sec-Fetch-Site`). Writes take JSON only ([`crate::routes`]), which a page cannot post to another origin without
//! a CORS preflight, and CORS is off unless an origin was configured.

use std::net::IpAddr;
use std::path::{Path, PathBuf};

use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use slag_common::files;

use crate::listen::Listen;
use crate::problem::Problem;

/// Least characters of a token: 128 bits take 32 hex digits or 22 of base64.
const MIN_TOKEN_CHARS: usize = 16;
const MAX_TOKEN_BYTES: u64 = 4096;
const ALLOWED_METHODS: HeaderValue = HeaderValue::from_static("GET, HEAD, POST");
const ALLOWED_HEADERS: HeaderValue = HeaderValue::from_static("authorization, content-type, x-request-id");
const EXPOSED_HEADERS: HeaderValue = HeaderValue::from_static("retry-after, x-request-id");

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct AccessSettings {
    /// Names that clients call this machine by, without port.
    pub hosts: Vec<String>,
    /// Origins whose pages may read answers, such as `https://map.example`.
    pub origins: Vec<String>,
    /// File with the bearer token for writes.
    pub token_file: Option<PathBuf>,
}

/// Settings that are refused: what, and what was expected.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct AccessError(String);

/// Accepted writes.
#[derive(Clone)]
enum Writes {
    All,
    None,
    Token(String),
}

#[derive(Clone)]
pub struct Access {
    /// Lower case. Absent: any name.
    hosts: Option<Vec<String>>,
    origins: Vec<String>,
    writes: Writes,
    /// Paths that change nothing, whatever the method.
    reads: Vec<&'static str>,
}

/// The checks on a loopback address, without settings.
impl Default for Access {
    fn default() -> Self {
        Self { hosts: Some(Vec::new()), origins: Vec::new(), writes: Writes::All, reads: Vec::new() }
    }
}

/// Keeps the token out of logs.
impl std::fmt::Debug for Access {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Access")
            .field("hosts", &self.hosts)
            .field("origins", &self.origins)
            .finish_non_exhaustive()
    }
}

impl Access {
    /// Makes the checks of a service that listens on `listen`.
    ///
    /// Writes need the token if there is one; without it they are refused from other machines.
    pub fn new(listen: &Listen, settings: AccessSettings) -> Result<Self, AccessError> {
        let writes = match settings.token_file {
            Some(path) => Writes::Token(read_token(&path)?),
            None if listen.is_local() => Writes::All,
            None => Writes::None,
        };
        let origins =
            settings.origins.iter().map(|origin| checked_origin(origin)).collect::<Result<_, _>>()?;
        // A Unix socket has no name that could be rebound.
        let hosts = matches!(listen, Listen::Tcp(_))
            .then(|| settings.hosts.iter().map(|host| host.to_ascii_lowercase()).collect());
        Ok(Self { hosts, origins, writes, reads: Vec::new() })
    }

    /// Lets clients use any host name, for a service without anything that a page could not fetch itself.
    pub fn with_any_host(self) -> Self {
        Self { hosts: None, ..self }
    }

    /// Admits requests to these paths as reads, whatever their method.
    pub fn with_reads(self, reads: Vec<&'static str>) -> Self {
        Self { reads, ..self }
    }

    pub fn takes_writes(&self) -> bool {
        !matches!(self.writes, Writes::None)
    }

    /// Checks a request.
    ///
    /// # Errors
    /// 400 for a `Host` that cannot be read or is one of several, 421 for another host's name, 403 for another origin
    /// and for writes where none are accepted, 401 without the token.
    pub(crate) fn check(&self, request: &Request) -> Result<(), Problem> {
        let headers = request.headers();
        let of_header = one_host(headers)?;
        // It precedes the header (RFC 9112, section 3.2.2), but not every proxy knows that.
        let of_uri = request.uri().authority().map(|authority| authority.as_str());
        of_header.into_iter().chain(of_uri).try_for_each(|host| self.check_host(host))?;
        let host = of_uri.or(of_header);
        self.check_origin(headers, host)?;
        let is_read = matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS);
        if is_read || self.reads.contains(&request.uri().path()) {
            return Ok(());
        }
        self.check_token(headers)
    }

    fn check_host(&self, host: &str) -> Result<(), Problem> {
        let Some(names) = &self.hosts else { return Ok(()) };
        let name = name_of(host).to_ascii_lowercase();
        let is_address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>().is_ok();
        if is_address || name == "localhost" || names.contains(&name) {
            return Ok(());
        }
        let shown: String = host.chars().take(80).collect();
        let detail = format!(
            "the request is for the host {shown:?}, expected an IP address, localhost, or a name given with --host"
        );
        Err(Problem::new(StatusCode::MISDIRECTED_REQUEST, "wrong-host", "Wrong host", detail))
    }

    fn check_origin(&self, headers: &HeaderMap, host: Option<&str>) -> Result<(), Problem> {
        let refused = |from: &str| {
            let shown: String = from.chars().take(80).collect();
            let detail = format!(
                "the request is of a page of {shown:?}; start the service with --cors ORIGIN to let it ask"
            );
            Err(Problem::new(StatusCode::FORBIDDEN, "foreign-origin", "Foreign origin", detail))
        };
        let mut origins = headers.get_all(header::ORIGIN).iter();
        if let Some(origin) = origins.next() {
            let origin = origin.to_str().unwrap_or_default();
            let own = origin.split_once("://").map(|(_, authority)| authority);
            let is_own = own.zip(host).is_some_and(|(own, host)| own.eq_ignore_ascii_case(host));
            let is_allowed = (is_own || self.is_given(origin)) && origins.next().is_none();
            return if is_allowed { Ok(()) } else { refused(origin) };
        }
        // A page's images and scripts send no origin. A followed link is a navigation.
        let marked = |name: &'static str| text(headers, HeaderName::from_static(name));
        match (marked("sec-fetch-site"), marked("sec-fetch-mode")) {
            (Some("cross-site" | "same-site"), mode) if mode != Some("navigate") => refused("another site"),
            _ => Ok(()),
        }
    }

    fn check_token(&self, headers: &HeaderMap) -> Result<(), Problem> {
        let expected = match &self.writes {
            Writes::All => return Ok(()),
            Writes::None => {
                let detail = "this service can be reached from other machines and has no token, so it takes no \
                              writes; start it with --token-file FILE, or listen on 127.0.0.1 or a Unix socket";
                return Err(Problem::new(StatusCode::FORBIDDEN, "writes-off", "Writes are off", detail));
            }
            Writes::Token(expected) => expected,
        };
        let found = text(headers, header::AUTHORIZATION).and_then(|value| value.split_once(' '));
        let found = found.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer"));
        if found.is_some_and(|(_, token)| are_equal(token.trim().as_bytes(), expected.as_bytes())) {
            return Ok(());
        }
        let detail =
            "the request needs the header \"Authorization: Bearer TOKEN\" with the token of --token-file";
        Err(Problem::new(StatusCode::UNAUTHORIZED, "token", "Token needed", detail)
            .with_header(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer")))
    }

    fn is_given(&self, origin: &str) -> bool {
        self.origins.iter().any(|given| given.eq_ignore_ascii_case(origin))
    }

    /// Answers a CORS preflight of an allowed origin.
    pub(crate) fn preflight(&self, request: &Request) -> Option<Response> {
        let is_asked = request.method() == Method::OPTIONS
            && request.headers().contains_key(header::ACCESS_CONTROL_REQUEST_METHOD);
        let is_given = text(request.headers(), header::ORIGIN).is_some_and(|origin| self.is_given(origin));
        (is_asked && is_given).then(|| {
            let allowed = [
                (header::ACCESS_CONTROL_ALLOW_METHODS, ALLOWED_METHODS),
                (header::ACCESS_CONTROL_ALLOW_HEADERS, ALLOWED_HEADERS),
                (header::ACCESS_CONTROL_MAX_AGE, HeaderValue::from_static("600")),
            ];
            (StatusCode::NO_CONTENT, allowed).into_response()
        })
    }

    /// Returns the request's origin if its pages may read the answer.
    pub(crate) fn reader(&self, headers: &HeaderMap) -> Option<HeaderValue> {
        let origin = headers.get(header::ORIGIN)?;
        origin.to_str().is_ok_and(|origin| self.is_given(origin)).then(|| origin.clone())
    }

    pub(crate) fn allow(response: &mut Response, origin: HeaderValue) {
        let headers = response.headers_mut();
        headers.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, origin);
        headers.insert(header::ACCESS_CONTROL_EXPOSE_HEADERS, EXPOSED_HEADERS);
        headers.append(header::VARY, HeaderValue::from_static("origin"));
    }
}

fn text(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

/// Returns the only `Host`, if any.
fn one_host(headers: &HeaderMap) -> Result<Option<&str>, Problem> {
    let refused = |found: &str| {
        let detail =
            format!("the request has {found}, expected one Host header: this machine's name or address");
        Err(Problem::new(StatusCode::BAD_REQUEST, "bad-host", "Bad host", detail))
    };
    let mut values = headers.get_all(header::HOST).iter();
    let Some(host) = values.next() else { return Ok(None) };
    let others = values.count();
    if others > 0 {
        return refused(&format!("{} Host headers", others + 1));
    }
    match host.to_str() {
        Ok(host) => Ok(Some(host)),
        Err(_) => refused("a Host with other characters than visible ASCII"),
    }
}

/// Returns a `Host` without its port.
fn name_of(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|b| b.is_ascii_digit()) && !name.ends_with(':') => name,
        _ => host,
    }
}

/// Compares in time independent of where the texts differ.
fn are_equal(a: &[u8], b: &[u8]) -> bool {
    let differences = a.iter().zip(b).fold(0, |all, (a, b)| std::hint::black_box(all | (a ^ b)));
    a.len() == b.len() && differences == 0
}

fn read_token(path: &Path) -> Result<String, AccessError> {
    let unreadable = |cause| {
        AccessError(format!(
            "the token file: {cause}; it needs a token of at least {MIN_TOKEN_CHARS} characters"
        ))
    };
    let bytes = files::read_short(path, MAX_TOKEN_BYTES).map_err(unreadable)?;
    let text = String::from_utf8_lossy(&bytes);
    let token = text.trim();
    // A description, not the token.
    let found = match token.len() {
        n if n < MIN_TOKEN_CHARS => format!("{n} characters"),
        _ if token.bytes().all(|b| b.is_ascii_graphic()) => return Ok(token.to_owned()),
        _ => "several words or other characters".to_owned(),
    };
    Err(AccessError(format!(
        "the token file {} holds {found}, expected one line of at least {MIN_TOKEN_CHARS} visible ASCII characters; `openssl rand -hex 32` makes one",
        path.display()
    )))
}

fn checked_origin(text: &str) -> Result<String, AccessError> {
    let authority = text.split_once("://").filter(|(scheme, _)| matches!(*scheme, "http" | "https"));
    let is_sound = |authority: &str| {
        !authority.is_empty()
            && authority.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._:[]".contains(&b))
    };
    match authority.is_some_and(|(_, authority)| is_sound(authority)) {
        true => Ok(text.to_owned()),
        false => Err(AccessError(format!(
            "the origin {text:?} is none, expected SCHEME://HOST or SCHEME://HOST:PORT, such as https://map.example"
        ))),
    }
}

#[cfg(test)]
mod tests;
