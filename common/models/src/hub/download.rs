//! Files of the hub: metadata, and downloads into partial files.

use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use slag_common::retry::Backoff;
use ureq::http::{HeaderName, Method, Response, StatusCode};
use ureq::tls::TlsConfig;

use crate::description::Sha256;
use crate::download::{
    Client, DownloadError, DownloadFailure, Expected, NetworkLimits, Part, Watch, header_text, refusal,
};

/// Largest file: ONNX files of 2 GiB and more are split.
pub const MAX_FILE_BYTES: u64 = 2 << 30;
/// Most redirects; the hub redirects large files to its store.
const MAX_REDIRECTS: usize = 5;
/// Most consecutive attempts without progress.
const MAX_ATTEMPTS: u32 = 5;

#[derive(Clone, Debug)]
pub struct HubOptions {
    /// Folder of the models, see [`models_folder`](super::models_folder).
    pub root: PathBuf,
    /// Address of the hub; default: the table's.
    pub hub: Option<String>,
    /// Proxy, in the format of `HTTPS_PROXY`.
    pub proxy: Option<String>,
    pub timeout: Duration,
    /// Pause before the second attempt; doubled each time.
    pub first_backoff: Duration,
}

impl HubOptions {
    pub fn new(root: PathBuf) -> Self {
        let (timeout, first_backoff) = (Duration::from_secs(30), Duration::from_millis(500));
        Self { root, hub: None, proxy: None, timeout, first_backoff }
    }
}

struct Log;

impl Watch for Log {
    fn retried(&self, _url: &str, failure: &DownloadFailure) {
        tracing::info!("{failure}; trying again");
    }
}

#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Advertised {
    pub revision: Option<String>,
    /// The hub's ETag of a file in large-file storage.
    pub sha256: Option<Sha256>,
    pub len_bytes: Option<u64>,
}

pub(super) fn client(options: &HubOptions) -> Result<Client<'static>, DownloadFailure> {
    let proxy = options.proxy.as_deref().map(ureq::Proxy::new).transpose()?;
    let limits = NetworkLimits {
        attempts: MAX_ATTEMPTS,
        backoff: Backoff { first: options.first_backoff, longest: Duration::MAX },
        connect_timeout: options.timeout,
        read_timeout: options.timeout,
        progress_bytes: 1,
        redirects: MAX_REDIRECTS,
        ..NetworkLimits::default()
    };
    Ok(Client::new(limits, TlsConfig::default(), proxy, concat!("slag/", env!("CARGO_PKG_VERSION")), &Log))
}

pub(super) fn ask(client: &Client<'_>, url: &str) -> Result<Advertised, DownloadError> {
    let host = |url: &str| url.parse::<ureq::http::Uri>().ok().and_then(|uri| uri.authority().cloned());
    let own = host(url);
    client.retrying(url, || {
        let mut advertised = Advertised::default();
        // Only responses of the hub itself have the metadata.
        let mut seen = |uri: &ureq::http::Uri, response: &Response<ureq::Body>| {
            if uri.authority() == own.as_ref() {
                advertised.take(response);
            }
        };
        let response = client.request(Method::HEAD, url, 0, &[], &mut seen)?;
        match response.status() {
            StatusCode::OK => Ok(advertised),
            _ => Err(refusal(&response).into()),
        }
    })
}

impl Advertised {
    fn take(&mut self, response: &Response<ureq::Body>) {
        let text = |name| header_text(response, HeaderName::from_static(name));
        let revision = text("x-repo-commit");
        if revision.len() == 40 && revision.bytes().all(|b| b.is_ascii_hexdigit()) {
            self.revision.get_or_insert(revision);
        }
        if let Ok(sha256) = Sha256::try_from(text("x-linked-etag").trim_matches('"').to_owned()) {
            self.sha256.get_or_insert(sha256);
        }
        if let Ok(len_bytes) = text("x-linked-size").parse() {
            self.len_bytes.get_or_insert(len_bytes);
        }
    }
}

/// A partial file, with its entity tag beside it.
pub(super) struct PartialFile(pub PathBuf);

impl PartialFile {
    /// Downloads the file completely; returns whether a part existed. `len_bytes`: its length, if known.
    pub fn receive(
        &self,
        client: &Client<'_>,
        url: &str,
        len_bytes: Option<u64>,
    ) -> Result<bool, DownloadError> {
        if let Some(found_bytes) = len_bytes.filter(|bytes| *bytes > MAX_FILE_BYTES) {
            let (expected, found) = (format!("at most {MAX_FILE_BYTES}"), format!("{found_bytes} bytes"));
            return Err(DownloadError::Failed {
                attempts: 0,
                failure: DownloadFailure::Length { expected, found },
            });
        }
        let was_begun = self.len_bytes()? > 0;
        client.large(url, self, len_bytes.map_or(Expected::AtMost(MAX_FILE_BYTES), Expected::Exactly))?;
        Ok(was_begun)
    }

    fn etag_path(&self) -> PathBuf {
        self.0.with_extension("etag")
    }
}

impl Part for PartialFile {
    fn len_bytes(&self) -> io::Result<u64> {
        Ok(fs_err::metadata(&self.0).map_or(0, |metadata| metadata.len()))
    }

    fn etag(&self) -> Option<String> {
        fs_err::read_to_string(self.etag_path()).ok()
    }

    fn begin(&self, etag: &str) -> io::Result<()> {
        match etag {
            "" => remove(&self.etag_path()),
            etag => fs_err::write(self.etag_path(), etag),
        }
    }

    fn write_from(&self, offset_bytes: u64, bytes: &[u8]) -> io::Result<()> {
        let mut file = fs_err::OpenOptions::new().create(true).truncate(false).write(true).open(&self.0)?;
        file.set_len(offset_bytes)?;
        file.seek(SeekFrom::Start(offset_bytes))?;
        file.write_all(bytes)
    }

    fn discard(&self) -> io::Result<()> {
        remove(&self.0)?;
        remove(&self.etag_path())
    }

    fn finish(&self) -> io::Result<Result<(), DownloadFailure>> {
        fs_err::OpenOptions::new().write(true).open(&self.0)?.sync_all()?;
        Ok(Ok(()))
    }

    fn max_wrong(&self) -> u32 {
        1
    }
}

fn remove(path: &Path) -> io::Result<()> {
    match fs_err::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}
