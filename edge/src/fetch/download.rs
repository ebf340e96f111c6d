//! HTTP downloads: small files and shards arrive whole or not at all, within their lengths.

use std::io::Read;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use slag_common::Hash32;
use slag_common::retry::{Backoff, Retries};
use slag_common::tuf::TufError;
use ureq::http::{Response, StatusCode, Uri, header};
use ureq::tls::{PemItem, RootCerts, TlsConfig, parse_pem};

use super::environment::Environment;
use super::error::{DownloadFailure, FetchError};
use crate::store::files::Files;

/// Downloads of a shard with wrong content before it is given up: one for a partial file that a power cut
/// damaged, two for the network.
const MAX_WRONG_HASHES: u32 = 3;
/// Most bytes read of a file of authorities; that of all public ones has a quarter.
const MAX_CA_BYTES: u64 = 1 << 20;
/// Longest sleep between looks at the cancel flag.
const NAP: Duration = Duration::from_millis(50);

/// How an attempt failed.
enum Stop {
    /// The server or the network failed; another attempt may help.
    Failed(DownloadFailure),
    /// The same, but more bytes arrived than in any attempt before.
    Interrupted(DownloadFailure),
    /// A local failure, or a refusal: no further attempt.
    Fatal(FetchError),
}

impl From<DownloadFailure> for Stop {
    fn from(failure: DownloadFailure) -> Self {
        Self::Failed(failure)
    }
}

impl From<FetchError> for Stop {
    fn from(e: FetchError) -> Self {
        Self::Fatal(e)
    }
}

impl From<std::io::Error> for Stop {
    fn from(e: std::io::Error) -> Self {
        Self::Fatal(e.into())
    }
}

impl From<ureq::Error> for Stop {
    fn from(e: ureq::Error) -> Self {
        let failure = match &e {
            ureq::Error::Rustls(tls) => DownloadFailure::Tls(tls.to_string()),
            // What rustls finds wrong while it reads and writes.
            ureq::Error::Io(io) if io.kind() == std::io::ErrorKind::InvalidData => {
                DownloadFailure::Tls(io.to_string())
            }
            _ => DownloadFailure::Transport(Box::new(e)),
        };
        Self::Failed(failure)
    }
}

/// Downloads from one store.
pub(super) struct Client<'a> {
    agent: ureq::Agent,
    base: String,
    environment: &'a Environment<'a>,
    /// Bytes left by earlier fetches.
    pub resumed_bytes: AtomicU64,
    /// Attempts beyond the first.
    pub retries: AtomicU64,
}

impl<'a> Client<'a> {
    /// Checks the address of a store.
    pub fn new(from: &str, environment: &'a Environment<'a>) -> Result<Self, FetchError> {
        let bad = |what: &str| FetchError::Address { from: from.to_owned(), what: what.to_owned() };
        let uri: Uri = from.parse().map_err(|_| bad("it is not a URL"))?;
        if !matches!(uri.scheme_str(), Some("http" | "https")) {
            return Err(bad("it does not begin with http:// or https://"));
        }
        if uri.authority().is_none_or(|a| a.host().is_empty() || a.as_str().contains('@')) {
            return Err(bad("it has no host, or names a user"));
        }
        if uri.query().is_some() || from.contains('#') {
            return Err(bad("it has a query or a fragment"));
        }
        let limits = &environment.limits;
        let agent = ureq::Agent::config_builder()
            .tls_config(tls(environment.ca)?)
            .http_status_as_error(false)
            // Neither redirects nor a proxy from the environment: requests go to the given address only.
            .max_redirects(0)
            .proxy(None)
            .timeout_resolve(Some(limits.connect_timeout))
            .timeout_connect(Some(limits.connect_timeout))
            .timeout_recv_response(Some(limits.read_timeout))
            .timeout_per_read(Some(limits.read_timeout))
            .user_agent(concat!("slag-edge/", env!("CARGO_PKG_VERSION")))
            .build()
            .new_agent();
        let base = from.trim_end_matches('/').to_owned();
        Ok(Self { agent, base, environment, resumed_bytes: AtomicU64::new(0), retries: AtomicU64::new(0) })
    }

    /// Returns the address of the store.
    pub fn base(&self) -> &str {
        &self.base
    }

    /// Downloads a file of at most `max_bytes`; `None` if the store does not have it.
    pub fn file(&self, path: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, FetchError> {
        let url = format!("{}/v1/{path}", self.base);
        self.retrying(&url, || self.try_file(&url, path, max_bytes))
    }

    fn try_file(&self, url: &str, path: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, Stop> {
        let too_long = || FetchError::from(TufError::TooLong { what: path.to_owned(), max_bytes });
        let response = self.get(url, max_bytes, None)?;
        match response.status() {
            StatusCode::NOT_FOUND => return Ok(None),
            StatusCode::OK => {}
            _ => return Err(refusal(&response).into()),
        }
        let stated = response.body().content_length();
        if stated.is_some_and(|len_bytes| len_bytes > max_bytes) {
            return Err(too_long().into());
        }
        let mut body = response.into_body().into_reader().take(max_bytes.saturating_add(1));
        let mut bytes = Vec::new();
        let mut chunk = vec![0; self.environment.limits.chunk_bytes.max(1)];
        loop {
            self.check_cancelled()?;
            match body.read(&mut chunk).map_err(ureq::Error::from)? {
                0 => break,
                n => bytes.extend_from_slice(&chunk[..n]),
            }
        }
        match bytes.len() as u64 > max_bytes {
            true => Err(too_long().into()),
            false => Ok(Some(bytes)),
        }
    }

    /// Downloads an object into a staged file, resuming an earlier attempt, and makes it durable. Checks its
    /// hash.
    pub fn object(
        &self,
        files: &dyn Files,
        hash: Hash32,
        len_bytes: u64,
        part: &Path,
    ) -> Result<(), FetchError> {
        let url = format!("{}/v1/objects/{hash}", self.base);
        let staged_bytes = || Ok::<_, FetchError>(files.stat(part)?.map_or(0, |stat| stat.len_bytes));
        if staged_bytes()? > len_bytes {
            files.remove(part)?;
        }
        let mut furthest = staged_bytes()?;
        self.resumed_bytes.fetch_add(furthest, Ordering::Relaxed);
        let mut n_wrong_hashes = 0;
        self.retrying(&url, || {
            let offset = staged_bytes()?;
            let received = self.receive(files, &url, hash, offset, len_bytes, part);
            let reached = staged_bytes()?;
            if let Err(Stop::Failed(failure)) = received {
                let is_progress =
                    reached - furthest.min(reached) >= self.environment.limits.chunk_bytes as u64;
                furthest = furthest.max(reached);
                return Err(if is_progress { Stop::Interrupted(failure) } else { Stop::Failed(failure) });
            }
            received?;
            files.sync(part)?;
            let found = Hash32::of(&files.map(part)?);
            if found == hash {
                return Ok(());
            }
            files.remove(part)?;
            n_wrong_hashes += 1;
            let failure = DownloadFailure::Hash { expected: hash, found };
            match n_wrong_hashes < MAX_WRONG_HASHES {
                true => Err(Stop::Failed(failure)),
                false => {
                    let url = url.clone();
                    Err(Stop::Fatal(FetchError::Download { url, attempts: n_wrong_hashes, failure }))
                }
            }
        })
    }

    /// Receives bytes `offset..len_bytes` of an object, or all of it if the server ignores the range.
    fn receive(
        &self,
        files: &dyn Files,
        url: &str,
        hash: Hash32,
        mut offset: u64,
        len_bytes: u64,
        part: &Path,
    ) -> Result<(), Stop> {
        if offset == len_bytes {
            // An empty object has no partial file yet.
            return if len_bytes == 0 { Ok(files.write_from(part, 0, &[])?) } else { Ok(()) };
        }
        let mut ranges = Vec::new();
        if offset > 0 {
            ranges.push((header::RANGE, format!("bytes={offset}-")));
            ranges.push((header::IF_RANGE, format!("\"{hash}\"")));
        }
        let response = self.get(url, len_bytes, ranges)?;
        match response.status() {
            StatusCode::PARTIAL_CONTENT if offset > 0 => {
                let found = header_text(&response, header::CONTENT_RANGE);
                let expected = format!("bytes {offset}-{}/{len_bytes}", len_bytes - 1);
                if found != expected {
                    return Err(DownloadFailure::Length { expected, found }.into());
                }
            }
            StatusCode::OK => offset = 0,
            _ => {
                if response.status() == StatusCode::RANGE_NOT_SATISFIABLE {
                    files.remove(part)?;
                }
                return Err(refusal(&response).into());
            }
        }
        let left_bytes = len_bytes - offset;
        if let Some(stated) = response.body().content_length().filter(|stated| *stated != left_bytes) {
            let (expected, found) = (format!("{left_bytes} bytes"), format!("{stated} bytes"));
            return Err(DownloadFailure::Length { expected, found }.into());
        }
        // Never more than the manifest's length, however long the body is.
        let mut body = response.into_body().into_reader().take(left_bytes);
        let mut chunk = vec![0; (self.environment.limits.chunk_bytes as u64).clamp(1, left_bytes) as usize];
        let mut n_filled = 0;
        loop {
            self.check_cancelled()?;
            let read = body.read(&mut chunk[n_filled..]);
            let n_read = *read.as_ref().unwrap_or(&0);
            n_filled += n_read;
            self.environment.progress.received(n_read as u64);
            // Also writes what arrived before a break: the next attempt resumes there.
            if n_filled == chunk.len() || n_read == 0 || n_filled as u64 == len_bytes - offset {
                files.write_from(part, offset, &chunk[..n_filled])?;
                offset += n_filled as u64;
                n_filled = 0;
            }
            read.map_err(ureq::Error::from)?;
            if offset == len_bytes {
                return Ok(());
            }
            if n_read == 0 {
                return Err(DownloadFailure::Cut { expected_bytes: len_bytes, found_bytes: offset }.into());
            }
        }
    }

    fn get(
        &self,
        url: &str,
        expected_bytes: u64,
        headers: impl IntoIterator<Item = (header::HeaderName, String)>,
    ) -> Result<Response<ureq::Body>, Stop> {
        let limits = &self.environment.limits;
        let body_secs = expected_bytes / limits.slowest_bytes_per_sec.max(1);
        let body_timeout = limits.read_timeout.saturating_add(Duration::from_secs(body_secs));
        // A time limit beyond the clock's range is no limit.
        let body_timeout = Instant::now().checked_add(body_timeout).is_some().then_some(body_timeout);
        let mut request = self.agent.get(url);
        for (name, value) in headers {
            request = request.header(name, value);
        }
        Ok(request.config().timeout_recv_body(body_timeout).build().call()?)
    }

    /// Retries until an attempt succeeds or fails for good, or too many fail in a row without progress.
    fn retrying<T>(&self, url: &str, mut attempt: impl FnMut() -> Result<T, Stop>) -> Result<T, FetchError> {
        let limits = &self.environment.limits;
        let backoff = Backoff { first: limits.first_backoff, longest: limits.longest_backoff };
        let mut retries = Retries::new(limits.attempts, backoff);
        loop {
            self.check_cancelled()?;
            let (failure, made_progress) = match attempt() {
                Ok(value) => return Ok(value),
                Err(Stop::Fatal(e)) => return Err(e),
                Err(Stop::Failed(failure)) => (failure, false),
                Err(Stop::Interrupted(failure)) => (failure, true),
            };
            let Some(pause) = retries.failed(made_progress).filter(|_| failure.is_passing()) else {
                return Err(FetchError::Download {
                    url: url.to_owned(),
                    attempts: retries.n_failures(),
                    failure,
                });
            };
            self.retries.fetch_add(1, Ordering::Relaxed);
            self.environment.progress.retried(url, &failure);
            let spread = 0.5 + (self.environment.random)().clamp(0.0, 1.0);
            let asked = match &failure {
                DownloadFailure::Status { retry_after: Some(asked), .. } => {
                    (*asked).min(limits.longest_retry_after)
                }
                _ => Duration::ZERO,
            };
            // Added to the backoff, so that a fleet that got the same `Retry-After` does not return in step.
            self.sleep(asked.saturating_add(pause.mul_f64(spread)))?;
        }
    }

    fn sleep(&self, mut left: Duration) -> Result<(), FetchError> {
        while !left.is_zero() {
            self.check_cancelled()?;
            let nap = left.min(NAP);
            std::thread::sleep(nap);
            left -= nap;
        }
        Ok(())
    }

    fn check_cancelled(&self) -> Result<(), FetchError> {
        match self.environment.cancel.load(Ordering::Relaxed) {
            true => Err(FetchError::Cancelled),
            false => Ok(()),
        }
    }
}

/// Returns whose certificates count.
fn tls(ca: Option<&Path>) -> Result<TlsConfig, FetchError> {
    let Some(path) = ca else { return Ok(TlsConfig::default()) };
    let unfit = |what: String| FetchError::Ca { path: path.to_owned(), what };
    let mut pem = Vec::new();
    let read = std::fs::File::open(path).and_then(|file| file.take(MAX_CA_BYTES).read_to_end(&mut pem));
    read.map_err(|e| unfit(e.to_string()))?;
    let mut authorities = Vec::new();
    for item in parse_pem(&pem) {
        if let PemItem::Certificate(certificate) = item.map_err(|e| unfit(e.to_string()))? {
            authorities.push(certificate);
        }
    }
    match authorities.is_empty() {
        true => Err(unfit("no certificate is there".to_owned())),
        false => Ok(TlsConfig::builder().root_certs(RootCerts::from(authorities)).build()),
    }
}

fn refusal(response: &Response<ureq::Body>) -> DownloadFailure {
    if response.status().is_redirection() && response.status() != StatusCode::NOT_MODIFIED {
        let location = header_text(response, header::LOCATION);
        return DownloadFailure::Redirect { location };
    }
    let status = response.status();
    let retry_after = match status {
        StatusCode::TOO_MANY_REQUESTS | StatusCode::SERVICE_UNAVAILABLE => {
            header_text(response, header::RETRY_AFTER).trim().parse().ok().map(Duration::from_secs)
        }
        _ => None,
    };
    DownloadFailure::Status { status: status.as_u16(), retry_after }
}

/// Returns a header as text, cut to 200 characters; empty if it is absent or not text.
fn header_text(response: &Response<ureq::Body>, name: header::HeaderName) -> String {
    let value = response.headers().get(name).and_then(|value| value.to_str().ok());
    value.unwrap_or_default().chars().take(200).collect()
}
