//! Downloads from a store: small files and shards arrive whole or not at all, within their lengths.

use std::io;
use std::path::Path;
use std::sync::atomic::Ordering;

use slag_common::Hash32;
use slag_common::tuf::TufError;
use slag_models::download::{self, DownloadError, DownloadFailure, Expected, Part, Watch};
use ureq::http::Uri;

use super::error::FetchError;
use super::request::Environment;
use crate::store::files::Files;

pub(super) struct Client<'a> {
    http: download::Client<'a>,
    pub base: String,
}

impl Watch for Environment<'_> {
    fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }

    fn received(&self, bytes: u64) {
        self.progress.received(bytes);
    }

    fn retried(&self, url: &str, failure: &DownloadFailure) {
        self.progress.retried(url, failure);
    }

    fn random(&self) -> f64 {
        (self.random)()
    }
}

/// Checks the address of a store.
///
/// # Errors
/// What is wrong with it.
pub fn check_address(from: &str) -> Result<(), &'static str> {
    let uri: Uri = from.parse().map_err(|_| "it is not a URL")?;
    if !matches!(uri.scheme_str(), Some("http" | "https")) {
        return Err("it does not begin with http:// or https://");
    }
    if uri.authority().is_none_or(|a| a.host().is_empty() || a.as_str().contains('@')) {
        return Err("it has no host, or names a user");
    }
    // A port beyond 65535 would be parsed as none.
    let end = uri.authority().and_then(|a| a.as_str().rsplit(']').next()).unwrap_or_default();
    if end.contains(':') && uri.port_u16().is_none() {
        return Err("its port is no number from 0 to 65535");
    }
    if uri.query().is_some() || from.contains('#') {
        return Err("it has a query or a fragment");
    }
    Ok(())
}

impl<'a> Client<'a> {
    pub fn new(from: &str, environment: &'a Environment<'a>) -> Result<Self, FetchError> {
        check_address(from).map_err(|what| {
            let advice = "give one like http://host:port";
            FetchError::Request(format!("{from:?} is not the address of a store: {what}; {advice}"))
        })?;
        let tls = download::tls(environment.ca).map_err(|what| {
            let (path, expected) =
                (environment.ca.unwrap_or("".as_ref()), "certificates of authorities in PEM");
            FetchError::Request(format!("{}: {what}, expected {expected}; check --ca", path.display()))
        })?;
        // Neither redirects nor a proxy from the environment: requests go to the given address only.
        let limits = environment.limits.clone();
        let agent = concat!("slag-edge/", env!("CARGO_PKG_VERSION"));
        let http = download::Client::new(limits, tls, None, agent, environment);
        Ok(Self { http, base: from.trim_end_matches('/').to_owned() })
    }

    /// Returns the bytes left by earlier fetches, and the number of attempts beyond the first.
    pub(crate) fn resumed_bytes_and_retries(self) -> (u64, u64) {
        (self.http.resumed_bytes.into_inner(), self.http.retries.into_inner())
    }

    /// Downloads a file of at most `max_bytes`; `None` if the store does not have it.
    pub fn file(&self, path: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, FetchError> {
        let url = format!("{}/v1/{path}", self.base);
        self.http.small(&url, max_bytes).map_err(|e| match e {
            DownloadError::TooLong { max_bytes } => {
                TufError::TooLong { what: path.to_owned(), max_bytes }.into()
            }
            e => FetchError::of_download(url, e, 0),
        })
    }

    /// Downloads a root that may be absent: some static hosts answer 403 or 410, and a 404 could hide a root as well.
    pub fn next_root(&self, path: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, FetchError> {
        match self.file(path, max_bytes) {
            Err(FetchError::Download {
                failure: DownloadFailure::Status { status: 403 | 410, .. }, ..
            }) => Ok(None),
            file => file,
        }
    }

    /// Downloads an object into a staged file, resuming an earlier attempt, and makes it durable. Checks its hash.
    pub fn object(
        &self,
        files: &dyn Files,
        hash: Hash32,
        len_bytes: u64,
        path: &Path,
    ) -> Result<(), FetchError> {
        let url = format!("{}/v1/objects/{hash}", self.base);
        let part = StagedObject { files, hash, len_bytes, path };
        let received = self.http.large(&url, &part, Expected::Exactly(len_bytes));
        received.map_err(|e| FetchError::of_download(url, e, part.len_bytes().unwrap_or(0)))
    }
}

struct StagedObject<'a> {
    files: &'a dyn Files,
    hash: Hash32,
    len_bytes: u64,
    path: &'a Path,
}

impl Part for StagedObject<'_> {
    fn len_bytes(&self) -> io::Result<u64> {
        Ok(self.files.stat(self.path)?.map_or(0, |stat| stat.len_bytes))
    }

    /// A store's entity tag of an object is its hash.
    fn etag(&self) -> Option<String> {
        Some(format!("\"{}\"", self.hash))
    }

    fn write_from(&self, offset_bytes: u64, bytes: &[u8]) -> io::Result<()> {
        self.files.write_from(self.path, offset_bytes, bytes)
    }

    fn discard(&self) -> io::Result<()> {
        self.files.remove(self.path)
    }

    fn finish(&self) -> io::Result<Result<(), DownloadFailure>> {
        self.files.sync(self.path)?;
        let bytes = match self.files.read(self.path, self.len_bytes) {
            Ok(bytes) => bytes,
            Err(e) => {
                // On a bad medium, the next fetch writes it elsewhere.
                self.discard()?;
                return Err(e);
            }
        };
        let found = Hash32::of(&bytes);
        let wrong = || DownloadFailure::Hash { expected: self.hash.to_string(), found: found.to_string() };
        Ok(if found == self.hash { Ok(()) } else { Err(wrong()) })
    }

    /// One for a partial file that a power cut damaged, two for the network.
    fn max_wrong(&self) -> u32 {
        3
    }
}
