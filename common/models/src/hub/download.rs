//! Downloads one file from the hub: its metadata, then its bytes, resuming interrupted downloads.

use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::time::Duration;

use slag_common::retry::{Backoff, Retries};
use ureq::http::{HeaderName, Method, Request, Response, StatusCode, Uri, header};

use super::options::HubOptions;
use crate::description::Sha256;

/// Limit on the size of a file: ONNX files of 2 GiB and more are split.
pub const MAX_FILE_BYTES: u64 = 2 << 30;

/// Limit on redirects of a request; the hub redirects large files to its store.
const MAX_REDIRECTS: usize = 5;
/// Limit on consecutive attempts without progress.
const MAX_ATTEMPTS: u32 = 5;
const CHUNK_BYTES: usize = 1 << 18;

/// Error of a download.
#[derive(Debug, thiserror::Error)]
pub enum Failure {
    /// No connection, or it was lost.
    #[error("{0}")]
    Transport(#[from] Box<ureq::Error>),
    /// The server answers with an error status.
    #[error("the server answers {0}")]
    Status(u16),
    /// The server redirects to an address that is not followed.
    #[error("the server redirects to {0:?}, which is not followed (too many redirects, or unencrypted)")]
    Redirect(String),
    /// The body ends early.
    #[error("the body ends at byte {found_bytes} of {expected_bytes}")]
    Cut {
        /// Length announced.
        expected_bytes: u64,
        /// Bytes received.
        found_bytes: u64,
    },
    /// The length is not the expected one, or too large.
    #[error("it has {found_bytes} bytes, expected {expected}")]
    Length {
        /// Bytes announced or received.
        found_bytes: u64,
        /// The length expected.
        expected: String,
    },
    /// A local file cannot be read or written.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

impl From<ureq::Error> for Failure {
    fn from(error: ureq::Error) -> Self {
        Self::Transport(Box::new(error))
    }
}

impl Failure {
    /// Returns whether another attempt may succeed.
    fn is_transient(&self) -> bool {
        match self {
            Self::Transport(e) => !matches!(**e, ureq::Error::BadUri(_) | ureq::Error::Http(_)),
            Self::Status(status) => *status >= 500 || matches!(status, 408 | 429),
            Self::Cut { .. } => true,
            Self::Redirect(_) | Self::Length { .. } | Self::Io(_) => false,
        }
    }
}

/// The hub's metadata of a file.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Advertised {
    /// The commit.
    pub revision: Option<String>,
    /// Its SHA-256: the hub's ETag of a file kept in large-file storage.
    pub sha256: Option<Sha256>,
    /// Its length.
    pub len_bytes: Option<u64>,
}

pub(super) struct Client {
    agent: ureq::Agent,
    first_backoff: Duration,
}

impl Client {
    pub fn new(options: &HubOptions) -> Result<Self, Failure> {
        let proxy = options.proxy.as_deref().map(ureq::Proxy::new).transpose()?;
        let timeout = Some(options.timeout);
        let agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            // Redirects are followed here, because only the hub's own response has the metadata, not its store's.
            .max_redirects(0)
            .proxy(proxy)
            .timeout_resolve(timeout)
            .timeout_connect(timeout)
            .timeout_recv_response(timeout)
            .timeout_per_read(timeout)
            .user_agent(concat!("slag/", env!("CARGO_PKG_VERSION")))
            .build()
            .new_agent();
        Ok(Self { agent, first_backoff: options.first_backoff })
    }

    /// Requests a file's metadata.
    pub fn ask(&self, url: &str) -> Result<Advertised, Failure> {
        let head = || {
            let (response, advertised) = self.request(Method::HEAD, url, &[])?;
            match response.status() {
                StatusCode::OK => Ok(advertised),
                status => Err(Failure::Status(status.as_u16())),
            }
        };
        self.retrying(head, || false)
    }

    /// Downloads to `part` until it is whole; returns whether it existed before. `len_bytes`: its length, if known.
    pub fn receive(&self, url: &str, part: &Path, len_bytes: Option<u64>) -> Result<bool, Failure> {
        let mut furthest = n_bytes(part);
        let was_begun = furthest > 0;
        let made_progress = || {
            let before = furthest;
            furthest = before.max(n_bytes(part));
            furthest > before
        };
        self.retrying(|| self.try_receive(url, part, len_bytes), made_progress)?;
        Ok(was_begun)
    }

    fn try_receive(&self, url: &str, part: &Path, len_bytes: Option<u64>) -> Result<(), Failure> {
        let mut offset = n_bytes(part);
        let etag_path = part.with_extension("etag");
        let mut headers = Vec::new();
        match fs_err::read_to_string(&etag_path) {
            Ok(etag) if offset > 0 => {
                headers = vec![(header::RANGE, format!("bytes={offset}-")), (header::IF_RANGE, etag)];
            }
            _ => offset = 0,
        }
        let (response, _) = self.request(Method::GET, url, &headers)?;
        let content_bytes = response.body().content_length();
        let total = match response.status() {
            StatusCode::PARTIAL_CONTENT if offset > 0 => {
                let range = text_of(&response, header::CONTENT_RANGE);
                let total = range.strip_prefix(&format!("bytes {offset}-")).and_then(|r| r.split_once('/'));
                match total.and_then(|(_, total)| total.parse::<u64>().ok()) {
                    Some(total) if total >= offset => Some(total),
                    _ => {
                        // Not the requested range: start again.
                        discard(part)?;
                        return Err(Failure::Cut { expected_bytes: offset, found_bytes: 0 });
                    }
                }
            }
            StatusCode::OK => {
                offset = 0;
                content_bytes
            }
            StatusCode::RANGE_NOT_SATISFIABLE => {
                discard(part)?;
                return Err(Failure::Cut { expected_bytes: offset, found_bytes: 0 });
            }
            status => return Err(Failure::Status(status.as_u16())),
        };
        if let (Some(stated), Some(found_bytes)) = (len_bytes, total)
            && stated != found_bytes
        {
            return Err(Failure::Length { found_bytes, expected: stated.to_string() });
        }
        let expected = len_bytes.or(total);
        let too_long =
            |found_bytes| Failure::Length { found_bytes, expected: format!("at most {MAX_FILE_BYTES}") };
        if let Some(found_bytes) = expected.filter(|&bytes| bytes > MAX_FILE_BYTES) {
            return Err(too_long(found_bytes));
        }
        let mut file = fs_err::OpenOptions::new().create(true).truncate(false).write(true).open(part)?;
        file.set_len(offset)?;
        file.seek(SeekFrom::Start(offset))?;
        if offset == 0 {
            // Only a strong validator proves that two parts belong together.
            let etag = text_of(&response, header::ETAG);
            match etag.starts_with('"') {
                true => fs_err::write(&etag_path, etag)?,
                false => drop(fs_err::remove_file(&etag_path)),
            }
        }
        let most = expected.unwrap_or(MAX_FILE_BYTES);
        let mut body = response.into_body().into_reader().take(most - offset.min(most) + 1);
        let mut chunk = vec![0; CHUNK_BYTES];
        loop {
            let n = body.read(&mut chunk).map_err(ureq::Error::from)?;
            file.write_all(&chunk[..n])?;
            offset += n as u64;
            if offset > most {
                drop(file);
                discard(part)?;
                return Err(too_long(offset));
            }
            if n == 0 {
                break;
            }
        }
        file.sync_all()?;
        match expected {
            Some(expected_bytes) if offset < expected_bytes => {
                Err(Failure::Cut { expected_bytes, found_bytes: offset })
            }
            _ => Ok(()),
        }
    }

    /// Sends a request and follows redirects; collects the metadata from the hub's own responses.
    fn request(
        &self,
        method: Method,
        url: &str,
        headers: &[(HeaderName, String)],
    ) -> Result<(Response<ureq::Body>, Advertised), Failure> {
        let first: Uri = url.parse().map_err(|_| Failure::Redirect(url.to_owned()))?;
        let mut uri = first.clone();
        let mut advertised = Advertised::default();
        for _ in 0..=MAX_REDIRECTS {
            let mut request = Request::builder().method(method.clone()).uri(uri.clone());
            for (name, value) in headers {
                request = request.header(name, value);
            }
            let request = request.body(()).map_err(ureq::Error::from)?;
            let response = self.agent.run(request)?;
            if uri.authority() == first.authority() {
                advertised.take(&response);
            }
            if !response.status().is_redirection() {
                return Ok((response, advertised));
            }
            let location = text_of(&response, header::LOCATION);
            uri = next(&uri, &location).ok_or(Failure::Redirect(location))?;
        }
        Err(Failure::Redirect(uri.to_string()))
    }

    /// Repeats attempts until one succeeds, fails for good, or too many fail in a row without progress.
    fn retrying<T>(
        &self,
        mut attempt: impl FnMut() -> Result<T, Failure>,
        mut made_progress: impl FnMut() -> bool,
    ) -> Result<T, Failure> {
        let backoff = Backoff { first: self.first_backoff, longest: Duration::MAX };
        let mut retries = Retries::new(MAX_ATTEMPTS, backoff);
        loop {
            let failure = match attempt() {
                Err(failure) if failure.is_transient() => failure,
                result => return result,
            };
            let Some(pause) = retries.failed(made_progress()) else { return Err(failure) };
            tracing::info!("{failure}; trying again");
            std::thread::sleep(pause);
        }
    }
}

impl Advertised {
    /// Adds the metadata of a response of the hub.
    fn take(&mut self, response: &Response<ureq::Body>) {
        let text = |name| text_of(response, HeaderName::from_static(name));
        let revision = text("x-repo-commit");
        if revision.len() == 40 && revision.bytes().all(|b| b.is_ascii_hexdigit()) {
            self.revision.get_or_insert(revision);
        }
        let etag = text("x-linked-etag");
        if let Ok(sha256) = Sha256::try_from(etag.trim_matches('"').to_owned()) {
            self.sha256.get_or_insert(sha256);
        }
        if let Ok(len_bytes) = text("x-linked-size").parse() {
            self.len_bytes.get_or_insert(len_bytes);
        }
    }
}

/// Returns the target of a redirect if it may be followed: never from an encrypted connection to a plain one.
fn next(from: &Uri, location: &str) -> Option<Uri> {
    let to: Uri = match location.starts_with('/') && !location.starts_with("//") {
        true => format!("{}://{}{location}", from.scheme_str()?, from.authority()?).parse().ok()?,
        false => location.parse().ok()?,
    };
    let is_kept = to.scheme_str() == Some("https")
        || (to.scheme_str() == Some("http") && from.scheme_str() == Some("http"));
    is_kept.then_some(to)
}

/// Returns a header as text; empty if it is absent or not text.
fn text_of(response: &Response<ureq::Body>, name: HeaderName) -> String {
    response.headers().get(name).and_then(|value| value.to_str().ok()).unwrap_or_default().to_owned()
}

fn n_bytes(part: &Path) -> u64 {
    fs_err::metadata(part).map_or(0, |metadata| metadata.len())
}

/// Removes a partial file and its validator.
pub(super) fn discard(part: &Path) -> std::io::Result<()> {
    for path in [part.to_owned(), part.with_extension("etag")] {
        match fs_err::remove_file(path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn redirects_keep_encryption() {
        let from = |scheme: &str| format!("{scheme}://hub.example/a/b").parse::<Uri>().expect("a URL");
        let to = |scheme: &str, location: &str| next(&from(scheme), location).map(|uri| uri.to_string());
        assert_eq!(to("https", "/c?d"), Some("https://hub.example/c?d".into()));
        assert_eq!(to("https", "https://store.example/x"), Some("https://store.example/x".into()));
        assert_eq!(to("http", "http://store.example/x"), Some("http://store.example/x".into()));
        for location in ["http://store.example/x", "//store.example/x", "file:///etc/passwd", "", "c"] {
            assert_eq!(to("https", location), None, "{location}");
        }
    }
}
