//! TLS: a certificate and its key from PEM files, reread on changes.
//!
//! A renewal replaces two files in turn. A pair that does not match is ignored with a warning; the last one stays.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::{self, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use rustls::{ConfigBuilder, ServerConfig, WantsVerifier};
use slag_common::files;
use tokio_rustls::TlsAcceptor;

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TlsFiles {
    /// Certificate chain, PEM.
    pub cert: PathBuf,
    /// Private key, PEM.
    pub key: PathBuf,
}

/// No certificate with its key: the files, what was found, and what was expected.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct TlsError(pub(crate) String);

/// State of both files, read without their content.
type Stamps = [Option<(SystemTime, u64)>; 2];

/// Most bytes of a file: ten times the longest chain in use.
const MAX_BYTES: u64 = 1 << 20;

struct ReadPair {
    stamps: Stamps,
    key: Arc<CertifiedKey>,
}

struct Certificate {
    files: TlsFiles,
    provider: Arc<CryptoProvider>,
    state: Mutex<ReadPair>,
}

#[derive(Clone)]
pub struct Tls(pub(crate) TlsAcceptor);

impl fmt::Debug for Tls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Tls")
    }
}

impl Tls {
    pub fn open(files: TlsFiles) -> Result<Self, TlsError> {
        let provider = Arc::new(ring::default_provider());
        let stamps = stamps_of(&files);
        let state = Mutex::new(ReadPair { stamps, key: Arc::new(read(&files, &provider)?) });
        let certificate = Arc::new(Certificate { files, provider: Arc::clone(&provider), state });
        let config = versions(provider).with_no_client_auth().with_cert_resolver(certificate);
        Ok(Self(TlsAcceptor::from(Arc::new(config))))
    }
}

fn versions(provider: Arc<CryptoProvider>) -> ConfigBuilder<ServerConfig, WantsVerifier> {
    let versions = ServerConfig::builder_with_provider(provider).with_safe_default_protocol_versions();
    versions.expect("ring has the cipher suites of TLS 1.3")
}

impl fmt::Debug for Certificate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Certificate").field("files", &self.files).finish_non_exhaustive()
    }
}

impl ResolvesServerCert for Certificate {
    /// Returns the certificate for a connection: two `stat` calls, plus reading a few kilobytes if a file changed.
    fn resolve(&self, _: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let stamps = stamps_of(&self.files);
        if stamps != state.stamps {
            // Also after a failure: a pair is read once per change of its files.
            state.stamps = stamps;
            match read(&self.files, &self.provider) {
                Ok(key) => {
                    state.key = Arc::new(key);
                    tracing::info!("{} was read anew", self.files.cert.display());
                }
                Err(error) => tracing::warn!("{error}; the certificate before it stays in use"),
            }
        }
        Some(Arc::clone(&state.key))
    }
}

fn stamps_of(files: &TlsFiles) -> Stamps {
    [&files.cert, &files.key].map(|path| {
        let metadata = std::fs::metadata(path).ok()?;
        Some((metadata.modified().ok()?, metadata.len()))
    })
}

fn read(files: &TlsFiles, provider: &CryptoProvider) -> Result<CertifiedKey, TlsError> {
    let chain = read_pem(&files.cert, "a certificate", |bytes| {
        let chain = CertificateDer::pem_slice_iter(bytes).collect::<Result<Vec<_>, _>>()?;
        if chain.is_empty() { Err(pem::Error::NoItemsFound) } else { Ok(chain) }
    })?;
    let key = read_pem(&files.key, "a private key", PrivateKeyDer::from_pem_slice)?;
    CertifiedKey::from_der(chain, key, provider).map_err(|cause| {
        let (cert, key) = (files.cert.display(), files.key.display());
        TlsError(format!("{cert} and {key}: {cause}, expected a certificate and its own key"))
    })
}

fn read_pem<T>(
    path: &Path,
    expected: &str,
    parse: impl FnOnce(&[u8]) -> Result<T, pem::Error>,
) -> Result<T, TlsError> {
    let file = |cause: &dyn fmt::Display| {
        TlsError(format!("{}: {cause}, expected {expected} in PEM", path.display()))
    };
    let bytes = files::read_short(path, MAX_BYTES).map_err(|e| file(&e))?;
    parse(&bytes).map_err(|e| match e {
        pem::Error::NoItemsFound => file(&"none is there"),
        e => file(&e),
    })
}

#[cfg(test)]
mod tests;
