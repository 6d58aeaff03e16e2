//! TLS 1.3 for those who listen.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use rcgen::{CertificateParams, DistinguishedName, ExtendedKeyUsagePurpose, KeyPair};
use sha2::{Digest, Sha256};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::server::danger::ClientCertVerifier;
use tokio_rustls::rustls::{Error, RootCertStore, ServerConfig, version};
use x509_parser::parse_x509_certificate;

use super::authority::set_validity;
use super::error::{CA_FILE, CERTIFICATE_FILE, KEY_FILE, PkiError, VALID_DAYS_MAX};

/// Who may call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Callers {
    /// Whoever knows the address: a browser.
    Anyone,
    /// Who shows a certificate of the same authority.
    OfTheLab,
}

/// TLS with `tls.crt` and `tls.key` of `folder`, and for [`Callers::OfTheLab`] `ca.crt`; `protocol` is the one
/// spoken within (`h2`, `http/1.1`).
///
/// # Errors
/// [`PkiError::File`] and [`PkiError::Content`].
pub fn listen_as(folder: &Path, callers: Callers, protocol: &str) -> Result<TlsAcceptor, PkiError> {
    let verifier = match callers {
        Callers::Anyone => WebPkiClientVerifier::no_client_auth(),
        Callers::OfTheLab => read(&folder.join(CA_FILE), |pem| {
            let mut roots = RootCertStore::empty();
            roots.add_parsable_certificates(certificates(pem)?);
            let provider = Arc::new(ring::default_provider());
            let verifier = WebPkiClientVerifier::builder_with_provider(roots.into(), provider);
            verifier.build().map_err(|error| error.to_string())
        })?,
    };
    let chain_path = folder.join(CERTIFICATE_FILE);
    let chain = read(&chain_path, certificates_of_a_server)?;
    let key = read(&folder.join(KEY_FILE), |pem| {
        PrivateKeyDer::from_pem_slice(pem).map_err(|error| error.to_string())
    })?;
    acceptor(chain, key, verifier, protocol).map_err(|error| match error {
        Error::InconsistentKeys(_) => {
            content(&chain_path, &"is not the certificate of tls.key beside it")
        }
        error => content(&chain_path, &error),
    })
}

/// TLS with a key and a certificate for `hosts` that are made here and written nowhere, and the certificate's
/// SHA-256 as browsers show it: nobody else vouches for it.
///
/// # Errors
/// [`PkiError::Make`].
pub fn listen_unknown(
    hosts: Vec<String>,
    now: SystemTime,
    protocol: &str,
) -> Result<(TlsAcceptor, String), PkiError> {
    let failed = |error: &dyn std::fmt::Display| PkiError::Make(error.to_string());
    let key = KeyPair::generate().map_err(|error| failed(&error))?;
    let mut params = CertificateParams::new(hosts).map_err(|error| failed(&error))?;
    params.distinguished_name = DistinguishedName::new();
    // Some browsers do not let people past a certificate without these.
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    set_validity(&mut params, now, VALID_DAYS_MAX);
    let certificate = params.self_signed(&key).map_err(|error| failed(&error))?;
    let sum = Sha256::digest(certificate.der());
    let fingerprint: Vec<_> = sum.iter().map(|byte| format!("{byte:02X}")).collect();
    let secret = PrivatePkcs8KeyDer::from(key.serialize_der()).into();
    let callers = WebPkiClientVerifier::no_client_auth();
    let acceptor = acceptor(vec![certificate.into()], secret, callers, protocol)
        .map_err(|error| failed(&error))?;
    Ok((acceptor, fingerprint.join(":")))
}

fn acceptor(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
    callers: Arc<dyn ClientCertVerifier>,
    protocol: &str,
) -> Result<TlsAcceptor, Error> {
    let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_protocol_versions(&[&version::TLS13])?
        .with_client_cert_verifier(callers)
        .with_single_cert(chain, key)?;
    config.alpn_protocols = vec![protocol.into()];
    Ok(TlsAcceptor::from(Arc::new(config)))
}

fn certificates(pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, String> {
    let read: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    read.map_err(|error| error.to_string())
}

/// Refuses what whoever connects would refuse.
fn certificates_of_a_server(pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, String> {
    let chain = certificates(pem)?;
    let own = chain.first().ok_or("holds no certificate")?;
    let (_, own) = parse_x509_certificate(own).map_err(|error| error.to_string())?;
    match own.extended_key_usage() {
        Ok(Some(usage)) if !usage.value.server_auth && !usage.value.any => {
            Err("is no certificate of a server (`caudata pki issue --role server`)".to_owned())
        }
        _ => Ok(chain),
    }
}

fn read<T>(path: &Path, parse: impl Fn(&[u8]) -> Result<T, String>) -> Result<T, PkiError> {
    let bytes = fs::read(path).map_err(|source| PkiError::file(path, source))?;
    parse(&bytes).map_err(|reason| content(path, &reason))
}

fn content(path: &Path, reason: &dyn std::fmt::Display) -> PkiError {
    PkiError::Content { path: path.to_owned(), reason: reason.to_string() }
}
