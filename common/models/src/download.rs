//! Resumable downloads over HTTP: models from a hub, shards from a store.

use std::io::{self, Read};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use slag_common::files;
use slag_common::retry::{Backoff, Retries};
use ureq::http::{HeaderName, Method, Request, Response, StatusCode, Uri, header};
use ureq::tls::{PemItem, RootCerts, TlsConfig, parse_pem};

/// Largest file of authorities read; that of all public ones has a quarter.
const MAX_CA_BYTES: u64 = 1 << 20;
/// Longest sleep between checks of the cancel flag.
const NAP: Duration = Duration::from_millis(50);

#[derive(Clone, Debug)]
pub struct NetworkLimits {
    /// Consecutive failures without progress before a download fails.
    pub attempts: u32,
    /// Pauses after failures, scaled by 0.5..1.5.
    pub backoff: Backoff,
    /// Longest `Retry-After` accepted; it is added to the backoff.
    pub longest_retry_after: Duration,
    /// Timeout for name resolution and for connecting, each.
    pub connect_timeout: Duration,
    /// Longest time without a byte.
    pub read_timeout: Duration,
    /// Downloads slower than this on average are interrupted (and resumed).
    pub slowest_bytes_per_sec: u64,
    /// Bytes between two writes.
    pub chunk_bytes: usize,
    /// Bytes that a retry must gain to count as progress.
    pub progress_bytes: u64,
    /// Most redirects; never from an encrypted connection to a plain one.
    pub redirects: usize,
}

impl Default for NetworkLimits {
    fn default() -> Self {
        Self {
            attempts: 6,
            backoff: Backoff { first: Duration::from_millis(500), longest: Duration::from_secs(30) },
            longest_retry_after: Duration::from_secs(120),
            connect_timeout: Duration::from_secs(10),
            read_timeout: Duration::from_secs(20),
            slowest_bytes_per_sec: 4096,
            chunk_bytes: 256 << 10,
            progress_bytes: 256 << 10,
            redirects: 0,
        }
    }
}

/// Watches a download, from any of its threads.
pub trait Watch: Sync {
    /// Whether to stop; the next download resumes what arrived.
    fn is_cancelled(&self) -> bool {
        false
    }
    /// Called with the number of bytes received since the last call.
    fn received(&self, _bytes: u64) {}
    /// Called when an attempt failed and another follows.
    fn retried(&self, _url: &str, _failure: &DownloadFailure) {}
    /// A number within 0..1, to spread retries.
    fn random(&self) -> f64 {
        0.5
    }
}

#[derive(Debug, thiserror::Error)]
pub enum DownloadFailure {
    #[error("{0}")]
    Transport(#[from] Box<ureq::Error>),
    #[error("TLS failed: {what}; {advice}")]
    Tls { what: String, advice: &'static str },
    /// The answer to a request without TLS.
    #[error("the answer is no HTTP ({what}); if the server speaks TLS there, give its address with https://")]
    NotHttp { what: String },
    #[error("the body ended at byte {found_bytes} of {expected_bytes}")]
    Cut { expected_bytes: u64, found_bytes: u64 },
    /// The server refuses. `retry_after`: when to ask again (429 and 503).
    #[error("the server answered with status {status}")]
    Status { status: u16, retry_after: Option<Duration> },
    #[error(
        "the server redirects to {location:?}, which is not followed; if that is the right place, give that address"
    )]
    Redirect { location: String },
    #[error("the server sends {found}, expected {expected}")]
    Length { expected: String, found: String },
    #[error("the content has hash {found}, expected {expected}")]
    Hash { expected: String, found: String },
}

impl From<ureq::Error> for DownloadFailure {
    fn from(e: ureq::Error) -> Self {
        match &e {
            ureq::Error::Rustls(tls) => Self::of_tls(tls.to_string()),
            // Errors of rustls while reading and writing.
            ureq::Error::Io(io) if io.kind() == io::ErrorKind::InvalidData => Self::of_tls(io.to_string()),
            _ => Self::Transport(Box::new(e)),
        }
    }
}

/// Advice on TLS failures, each by a part of rustls's message.
const TLS_ADVICE: [(&str, &str); 8] = [
    ("UnknownIssuer", "give the authority that vouches for the server with --ca FILE"),
    (
        "CaUsedAsEndEntity",
        "the server shows the certificate of an authority: make its own with basicConstraints=critical,CA:FALSE",
    ),
    (
        "InvalidContentType",
        "the server does not speak TLS there: give its address with http://, or its other port",
    ),
    ("NotValidYet", TLS_CLOCK),
    ("not valid yet", TLS_CLOCK),
    ("xpired", TLS_CLOCK),
    ("NotValidForName", TLS_NAME),
    ("not valid for name", TLS_NAME),
];
const TLS_CLOCK: &str = "check the clock of this machine, or have the server's certificate renewed";
const TLS_NAME: &str = "give the address with a name that the server's certificate is for";

impl DownloadFailure {
    fn of_tls(what: String) -> Self {
        let advice = TLS_ADVICE.iter().find(|(of, _)| what.contains(of));
        let advice = advice.map_or("check the server's certificate", |(_, advice)| advice);
        Self::Tls { what, advice }
    }

    /// Without TLS, an answer that is not HTTP may be TLS.
    fn of_request(e: ureq::Error, uri: &Uri) -> Self {
        match &e {
            ureq::Error::Protocol(what) if uri.scheme_str() == Some("http") => match what.to_string() {
                what if what.starts_with("http parse") => Self::NotHttp { what },
                _ => e.into(),
            },
            _ => e.into(),
        }
    }

    /// Whether the message already gives advice.
    pub fn has_advice(&self) -> bool {
        matches!(self, Self::Tls { .. } | Self::NotHttp { .. } | Self::Redirect { .. })
    }

    fn is_passing(&self) -> bool {
        match self {
            // A certificate does not change on another attempt.
            Self::Redirect { .. } | Self::Tls { .. } | Self::NotHttp { .. } => false,
            Self::Status { status, .. } => *status >= 500 || matches!(status, 408 | 416 | 429),
            Self::Transport(e) => !matches!(**e, ureq::Error::BadUri(_) | ureq::Error::Http(_)),
            Self::Cut { .. } | Self::Length { .. } | Self::Hash { .. } => true,
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum DownloadError {
    #[error("{failure} ({attempts} attempts)")]
    Failed { attempts: u32, failure: DownloadFailure },
    #[error("it is longer than {max_bytes} bytes, the most that is read of it")]
    TooLong { max_bytes: u64 },
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error("cancelled")]
    Cancelled,
}

pub enum Stop {
    /// Another attempt may help.
    Failed(DownloadFailure),
    /// The same, after enough bytes arrived.
    Interrupted(DownloadFailure),
    /// No further attempt.
    Fatal(DownloadError),
}

impl From<DownloadFailure> for Stop {
    fn from(failure: DownloadFailure) -> Self {
        Self::Failed(failure)
    }
}

impl From<ureq::Error> for Stop {
    fn from(e: ureq::Error) -> Self {
        Self::Failed(e.into())
    }
}

impl From<DownloadError> for Stop {
    fn from(error: DownloadError) -> Self {
        Self::Fatal(error)
    }
}

impl From<io::Error> for Stop {
    fn from(e: io::Error) -> Self {
        Self::Fatal(e.into())
    }
}

/// A local file that arrives in pieces.
pub trait Part {
    fn len_bytes(&self) -> io::Result<u64>;
    /// Strong entity tag of its content; without one nothing is resumed.
    fn etag(&self) -> Option<String>;
    /// Records the entity tag of new content, before its first byte.
    fn begin(&self, _etag: &str) -> io::Result<()> {
        Ok(())
    }
    /// Writes at an offset, and truncates the file after the new bytes.
    fn write_from(&self, offset_bytes: u64, bytes: &[u8]) -> io::Result<()>;
    fn discard(&self) -> io::Result<()>;
    /// Makes the complete file durable and checks it; the inner error is its fault.
    fn finish(&self) -> io::Result<Result<(), DownloadFailure>>;
    /// Downloads with wrong content before giving up.
    fn max_wrong(&self) -> u32;
}

#[derive(Clone, Copy, Debug)]
pub enum Expected {
    Exactly(u64),
    AtMost(u64),
}

impl Expected {
    fn most_bytes(self) -> u64 {
        let (Self::Exactly(bytes) | Self::AtMost(bytes)) = self;
        bytes
    }

    /// Refuses a file whose `total` bytes are not as expected, or whose missing `rest` is not the announced `content`;
    /// unknown lengths pass.
    fn check(
        self,
        total: Option<u64>,
        rest: Option<u64>,
        content: Option<u64>,
    ) -> Result<(), DownloadFailure> {
        let (most, is_wrong) = match self {
            Self::Exactly(bytes) => ("", total.is_some_and(|total| total != bytes)),
            Self::AtMost(bytes) => ("at most ", total.is_some_and(|total| total > bytes)),
        };
        if is_wrong || content.is_some_and(|content| rest.is_some_and(|rest| rest != content)) {
            let stated = if is_wrong { total } else { content };
            return Err(DownloadFailure::Length {
                expected: format!("{most}{}", self.most_bytes()),
                found: format!("{} bytes", stated.unwrap_or(0)),
            });
        }
        Ok(())
    }
}

/// Sends requests to one server, with retries.
pub struct Client<'a> {
    agent: ureq::Agent,
    limits: NetworkLimits,
    watch: &'a dyn Watch,
    pub resumed_bytes: AtomicU64,
    /// Attempts beyond the first.
    pub retries: AtomicU64,
}

impl<'a> Client<'a> {
    pub fn new(
        limits: NetworkLimits,
        tls: TlsConfig,
        proxy: Option<ureq::Proxy>,
        user_agent: &str,
        watch: &'a dyn Watch,
    ) -> Self {
        let agent = ureq::Agent::config_builder()
            .tls_config(tls)
            .http_status_as_error(false)
            // Redirects are followed here, where each response is seen.
            .max_redirects(0)
            .proxy(proxy)
            .timeout_resolve(Some(limits.connect_timeout))
            .timeout_connect(Some(limits.connect_timeout))
            .timeout_recv_response(Some(limits.read_timeout))
            .timeout_per_read(Some(limits.read_timeout))
            .user_agent(user_agent)
            .build()
            .new_agent();
        let (resumed_bytes, retries) = (AtomicU64::new(0), AtomicU64::new(0));
        Self { agent, limits, watch, resumed_bytes, retries }
    }

    /// `None` if the server does not have it.
    pub fn small(&self, url: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, DownloadError> {
        self.retrying(url, || {
            let response = self.request(Method::GET, url, max_bytes, &[], &mut |_, _| {})?;
            match response.status() {
                StatusCode::NOT_FOUND => return Ok(None),
                StatusCode::OK => {}
                _ => return Err(refusal(&response).into()),
            }
            if response.body().content_length().is_some_and(|stated| stated > max_bytes) {
                return Err(DownloadError::TooLong { max_bytes }.into());
            }
            let mut body = response.into_body().into_reader().take(max_bytes.saturating_add(1));
            let mut bytes = Vec::new();
            let mut chunk = vec![0; self.limits.chunk_bytes.max(1)];
            loop {
                self.check_cancelled()?;
                match body.read(&mut chunk).map_err(ureq::Error::from)? {
                    0 => break,
                    n => bytes.extend_from_slice(&chunk[..n]),
                }
            }
            match bytes.len() as u64 > max_bytes {
                true => Err(DownloadError::TooLong { max_bytes }.into()),
                false => Ok(Some(bytes)),
            }
        })
    }

    /// Downloads a file piece by piece, resuming an earlier attempt. Once a server or proxy answers a range
    /// wrongly, the complete file is requested.
    pub fn large(&self, url: &str, part: &dyn Part, expected: Expected) -> Result<(), DownloadError> {
        if matches!(expected, Expected::Exactly(bytes) if part.len_bytes()? > bytes) {
            part.discard()?;
        }
        let mut furthest = part.len_bytes()?;
        self.resumed_bytes.fetch_add(furthest, Ordering::Relaxed);
        let (mut n_wrong, mut may_resume) = (0, true);
        self.retrying(url, || {
            let received = self.receive(url, part, expected, &mut may_resume);
            let reached = part.len_bytes()?;
            if let Err(Stop::Failed(failure)) = received {
                let is_progress = reached.saturating_sub(furthest) >= self.limits.progress_bytes.max(1);
                furthest = furthest.max(reached);
                return Err(if is_progress { Stop::Interrupted(failure) } else { Stop::Failed(failure) });
            }
            received?;
            let Err(failure) = part.finish()? else { return Ok(()) };
            part.discard()?;
            n_wrong += 1;
            Err(match n_wrong < part.max_wrong() {
                true => Stop::Failed(failure),
                false => Stop::Fatal(DownloadError::Failed { attempts: n_wrong, failure }),
            })
        })
    }

    /// Receives the missing bytes, or all if they cannot be resumed.
    fn receive(
        &self,
        url: &str,
        part: &dyn Part,
        expected: Expected,
        may_resume: &mut bool,
    ) -> Result<(), Stop> {
        if matches!(expected, Expected::Exactly(0)) {
            return Ok(part.write_from(0, &[])?);
        }
        let here_bytes = part.len_bytes()?;
        let etag = part.etag().filter(|_| *may_resume && here_bytes > 0);
        if etag.is_some() && matches!(expected, Expected::Exactly(bytes) if bytes == here_bytes) {
            return Ok(());
        }
        let mut offset = if etag.is_some() { here_bytes } else { 0 };
        let range = |etag| [(header::RANGE, format!("bytes={offset}-")), (header::IF_RANGE, etag)];
        let ranges: Vec<_> = etag.into_iter().flat_map(range).collect();
        let response = self.request(Method::GET, url, expected.most_bytes(), &ranges, &mut |_, _| {})?;
        let content_range = header_text(&response, header::CONTENT_RANGE);
        let content_bytes = response.body().content_length();
        let total = match response.status() {
            StatusCode::PARTIAL_CONTENT if offset > 0 => total_of_rest(&content_range, offset),
            StatusCode::OK if content_range.is_empty() => {
                offset = 0;
                content_bytes
            }
            // A range sent as if it were the complete file.
            StatusCode::OK => None,
            StatusCode::RANGE_NOT_SATISFIABLE => {
                part.discard()?;
                return Err(refusal(&response).into());
            }
            // Some proxies refuse ranges only: request the complete file. Ask busy ones again.
            status if offset > 0 && !matches!(status.as_u16(), 408 | 429 | 502..=504) => {
                *may_resume = false;
                return self.receive(url, part, expected, may_resume);
            }
            _ => return Err(refusal(&response).into()),
        };
        if total.is_none() && !content_range.is_empty() {
            *may_resume = false;
            part.discard()?;
            let expected = format!("bytes from {offset} to the end");
            return Err(DownloadFailure::Length { expected, found: format!("{content_range:?}") }.into());
        }
        if let Err(failure) = expected.check(total, total.map(|total| total - offset), content_bytes) {
            part.discard()?;
            return Err(failure.into());
        }
        if offset == 0 {
            // Only a strong validator proves that two parts belong together.
            let etag = header_text(&response, header::ETAG);
            part.begin(if etag.starts_with('"') { &etag } else { "" })?;
            part.write_from(0, &[])?;
        }
        let end = if let Expected::Exactly(bytes) = expected { Some(bytes) } else { total };
        self.write_body(response, part, offset, end, expected.most_bytes())
    }

    /// Writes a body that ends at `end`, if known; never more than `most_bytes`.
    fn write_body(
        &self,
        response: Response<ureq::Body>,
        part: &dyn Part,
        mut offset: u64,
        end: Option<u64>,
        most_bytes: u64,
    ) -> Result<(), Stop> {
        let limit = end.unwrap_or(most_bytes.saturating_add(1)) - offset;
        let mut body = response.into_body().into_reader().take(limit);
        let mut chunk = vec![0; (self.limits.chunk_bytes as u64).clamp(1, limit.max(1)) as usize];
        let mut n_filled = 0;
        while end != Some(offset) {
            self.check_cancelled()?;
            let read = body.read(&mut chunk[n_filled..]);
            let n_read = *read.as_ref().unwrap_or(&0);
            n_filled += n_read;
            self.watch.received(n_read as u64);
            // Also writes what arrived before a failure: the next attempt resumes there.
            if n_filled == chunk.len() || n_read == 0 || end == Some(offset + n_filled as u64) {
                part.write_from(offset, &chunk[..n_filled])?;
                offset += n_filled as u64;
                n_filled = 0;
            }
            read.map_err(ureq::Error::from)?;
            if offset > most_bytes {
                part.discard()?;
                return Err(DownloadError::TooLong { max_bytes: most_bytes }.into());
            }
            match end {
                Some(expected_bytes) if n_read == 0 && offset < expected_bytes => {
                    return Err(DownloadFailure::Cut { expected_bytes, found_bytes: offset }.into());
                }
                None if n_read == 0 => break,
                _ => {}
            }
        }
        Ok(())
    }

    /// Sends a request and follows redirects; `seen` gets each response with its address.
    pub(crate) fn request(
        &self,
        method: Method,
        url: &str,
        expected_bytes: u64,
        headers: &[(HeaderName, String)],
        seen: &mut dyn FnMut(&Uri, &Response<ureq::Body>),
    ) -> Result<Response<ureq::Body>, Stop> {
        let body_secs = expected_bytes / self.limits.slowest_bytes_per_sec.max(1);
        let body_timeout = self.limits.read_timeout.saturating_add(Duration::from_secs(body_secs));
        // A timeout beyond the clock's range is none.
        let body_timeout = Instant::now().checked_add(body_timeout).is_some().then_some(body_timeout);
        let mut uri: Uri = url.parse().map_err(|_| ureq::Error::BadUri(url.to_owned()))?;
        for n_followed in 0.. {
            let mut request = Request::builder().method(method.clone()).uri(uri.clone());
            for (name, value) in headers {
                request = request.header(name, value);
            }
            let request = request.body(()).map_err(ureq::Error::from)?;
            let request = self.agent.configure_request(request).timeout_recv_body(body_timeout).build();
            let response = self.agent.run(request);
            let response = response.map_err(|e| DownloadFailure::of_request(e, &uri))?;
            seen(&uri, &response);
            if !response.status().is_redirection() || response.status() == StatusCode::NOT_MODIFIED {
                return Ok(response);
            }
            let location = header_text(&response, header::LOCATION);
            match redirected(&uri, &location).filter(|_| n_followed < self.limits.redirects) {
                Some(next) => uri = next,
                None if location.is_empty() => return Ok(response),
                None => return Err(DownloadFailure::Redirect { location }.into()),
            }
        }
        unreachable!("the last redirect is an error")
    }

    /// Retries until success, a permanent failure, or too many failures in a row without progress.
    pub(crate) fn retrying<T>(
        &self,
        url: &str,
        mut attempt: impl FnMut() -> Result<T, Stop>,
    ) -> Result<T, DownloadError> {
        let limits = &self.limits;
        let mut retries = Retries::new(limits.attempts, limits.backoff);
        loop {
            self.check_cancelled()?;
            let (failure, made_progress) = match attempt() {
                Ok(value) => return Ok(value),
                Err(Stop::Fatal(e)) => return Err(e),
                Err(Stop::Failed(failure)) => (failure, false),
                Err(Stop::Interrupted(failure)) => (failure, true),
            };
            let Some(pause) = retries.failed(made_progress).filter(|_| failure.is_passing()) else {
                return Err(DownloadError::Failed { attempts: retries.n_failures(), failure });
            };
            self.retries.fetch_add(1, Ordering::Relaxed);
            self.watch.retried(url, &failure);
            let asked = match &failure {
                DownloadFailure::Status { retry_after: Some(asked), .. } => {
                    (*asked).min(limits.longest_retry_after)
                }
                _ => Duration::ZERO,
            };
            // Added to the backoff, so that a fleet with the same `Retry-After` does not return in step.
            let mut left = asked.saturating_add(pause.mul_f64(0.5 + self.watch.random().clamp(0.0, 1.0)));
            while !left.is_zero() {
                self.check_cancelled()?;
                let nap = left.min(NAP);
                std::thread::sleep(nap);
                left -= nap;
            }
        }
    }

    fn check_cancelled(&self) -> Result<(), DownloadError> {
        if self.watch.is_cancelled() { Err(DownloadError::Cancelled) } else { Ok(()) }
    }
}

/// Authorities to trust: those in a file (PEM), else the public ones.
pub fn tls(ca: Option<&Path>) -> Result<TlsConfig, String> {
    let Some(path) = ca else { return Ok(TlsConfig::default()) };
    let pem = files::read_short(path, MAX_CA_BYTES).map_err(|e| e.to_string())?;
    let mut authorities = Vec::new();
    for item in parse_pem(&pem) {
        if let PemItem::Certificate(certificate) = item.map_err(|e| e.to_string())? {
            authorities.push(certificate);
        }
    }
    match authorities.is_empty() {
        true => Err("no certificate is there".to_owned()),
        false => Ok(TlsConfig::builder().root_certs(RootCerts::from(authorities)).build()),
    }
}

pub(crate) fn refusal(response: &Response<ureq::Body>) -> DownloadFailure {
    let status = response.status();
    let asked = || header_text(response, header::RETRY_AFTER).trim().parse().ok().map(Duration::from_secs);
    let may_ask = matches!(status, StatusCode::TOO_MANY_REQUESTS | StatusCode::SERVICE_UNAVAILABLE);
    DownloadFailure::Status { status: status.as_u16(), retry_after: may_ask.then(asked).flatten() }
}

/// Returns the length of the complete file, if a range is all of it from `offset` on.
fn total_of_rest(content_range: &str, offset: u64) -> Option<u64> {
    let total = content_range.rsplit_once('/')?.1.parse::<u64>().ok()?;
    (content_range == format!("bytes {offset}-{}/{total}", total.wrapping_sub(1))).then_some(total)
}

/// A header as text, cut to 200 characters; empty if it is absent or not text.
pub(crate) fn header_text(response: &Response<ureq::Body>, name: HeaderName) -> String {
    let value = response.headers().get(name).and_then(|value| value.to_str().ok());
    value.unwrap_or_default().chars().take(200).collect()
}

/// Returns the target of a redirect, unless it leads from an encrypted connection to a plain one.
fn redirected(from: &Uri, location: &str) -> Option<Uri> {
    let to: Uri = match location.starts_with('/') && !location.starts_with("//") {
        true => format!("{}://{}{location}", from.scheme_str()?, from.authority()?).parse().ok()?,
        false => location.parse().ok()?,
    };
    let is_kept = to.scheme_str() == Some("https")
        || (to.scheme_str() == Some("http") && from.scheme_str() == Some("http"));
    is_kept.then_some(to)
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Nobody;

    impl Watch for Nobody {}

    /// Answers each connection with the same bytes.
    fn answering(bytes: &'static [u8]) -> u16 {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let port = listener.local_addr().expect("bound").port();
        std::thread::spawn(move || {
            for mut stream in listener.incoming().flatten() {
                let mut asked = [0; 4096];
                let _ = stream.read(&mut asked).and_then(|_| io::Write::write_all(&mut stream, bytes));
            }
        });
        port
    }

    #[test]
    fn tls_on_one_side_alone_is_told() {
        let client = Client::new(NetworkLimits::default(), TlsConfig::default(), None, "test", &Nobody);
        let failed = |url: &str| client.small(url, 100).expect_err("not both speak TLS").to_string();
        let plain = answering(b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n");
        let error = failed(&format!("https://127.0.0.1:{plain}/x"));
        assert!(error.contains("with http://") && error.contains("(1 attempts)"), "{error}");
        // The alert "protocol version" of TLS 1.2.
        let encrypted = answering(&[21, 3, 3, 0, 2, 2, 70]);
        let error = failed(&format!("http://127.0.0.1:{encrypted}/x"));
        assert!(error.contains("with https://") && error.contains("(1 attempts)"), "{error}");
    }

    #[test]
    fn failures_of_tls_have_their_own_advice() {
        let advice = |what: &str| match DownloadFailure::of_tls(what.to_owned()) {
            DownloadFailure::Tls { advice, .. } => advice,
            other => panic!("{other}"),
        };
        let of_authority = advice("invalid peer certificate: Other(OtherError(CaUsedAsEndEntity))");
        assert!(of_authority.contains("CA:FALSE") && !of_authority.contains("--ca"), "{of_authority}");
        assert!(advice("invalid peer certificate: UnknownIssuer").contains("--ca"));
        assert!(
            advice("invalid peer certificate: certificate expired: verification time 1").contains("clock")
        );
        assert_eq!(advice("something new"), "check the server's certificate");
    }

    #[test]
    fn redirects_keep_encryption() {
        let from = |scheme: &str| format!("{scheme}://hub.example/a/b").parse::<Uri>().expect("a URL");
        let to =
            |scheme: &str, location: &str| redirected(&from(scheme), location).map(|uri| uri.to_string());
        assert_eq!(to("https", "/c?d"), Some("https://hub.example/c?d".into()));
        assert_eq!(to("https", "https://store.example/x"), Some("https://store.example/x".into()));
        assert_eq!(to("http", "http://store.example/x"), Some("http://store.example/x".into()));
        for location in ["http://store.example/x", "//store.example/x", "file:///etc/passwd", "", "c"] {
            assert_eq!(to("https", location), None, "{location}");
        }
    }
}
