//! Certificates of a test authority.

use std::path::{Path, PathBuf};

use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};

use crate::text;

pub struct Authority {
    issuer: Issuer<'static, KeyPair>,
    /// PEM.
    pub file: PathBuf,
}

impl Authority {
    pub fn new(file: PathBuf) -> Self {
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, text(&file));
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().expect("a key");
        fs_err::write(&file, params.self_signed(&key).expect("signed").pem()).expect("written");
        Self { issuer: Issuer::new(params, key), file }
    }

    pub fn issue(&self, cert: &Path, key: &Path) {
        self.issue_as(IsCa::NoCa, cert, key);
    }

    /// Issues a certificate, perhaps an authority's.
    pub fn issue_as(&self, kind: IsCa, cert: &Path, key: &Path) {
        let own = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::new(["127.0.0.1".to_owned()]).expect("an address");
        params.is_ca = kind;
        fs_err::write(key, own.serialize_pem()).expect("written");
        fs_err::write(cert, params.signed_by(&own, &self.issuer).expect("signed").pem()).expect("written");
    }

    /// Requests a URL as a client that trusts this authority only.
    pub fn get(&self, url: &str) -> Result<String, ureq::Error> {
        let pem = fs_err::read(&self.file).expect("there");
        let root = ureq::tls::Certificate::from_pem(&pem).expect("a certificate");
        let roots = ureq::tls::RootCerts::new_with_certs(&[root]);
        let tls = ureq::tls::TlsConfig::builder().root_certs(roots).build();
        let agent = ureq::Agent::config_builder().tls_config(tls).build().new_agent();
        agent.get(url).call()?.body_mut().read_to_string()
    }
}
