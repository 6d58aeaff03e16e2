//! Reading the role, the name and the validity out of a certificate.

use std::net::IpAddr;
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use x509_parser::prelude::{FromDer, GeneralName, X509Certificate};

use super::error::PkiError;
use super::role::Role;

/// Who a certificate speaks of. It says nothing about who signed it: that is for TLS to check.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// What the process is.
    pub role: Role,
    /// Its name.
    pub name: String,
    /// Host names and addresses at which others reach it.
    pub hosts: Vec<String>,
    /// From when on the certificate is valid.
    pub not_before: SystemTime,
    /// Until when it is valid.
    pub not_after: SystemTime,
}

/// The identity in a certificate in DER, as TLS hands it over.
///
/// # Errors
/// In words: it is no certificate, or has no role of ours.
pub fn identity_of_der(der: &[u8]) -> Result<Identity, String> {
    let certificate = of_der(der)?;
    let subject = certificate.subject();
    // Exactly one: with two, one reader would take the first and another the last.
    let mut names = subject.iter_common_name();
    let role = match (names.next(), names.next()) {
        (Some(name), None) => name.as_str().map_err(|error| error.to_string())?,
        _ => return Err("the certificate must have exactly one common name".to_owned()),
    };
    let role = role.parse().map_err(|error: PkiError| error.to_string())?;
    let unit = subject.iter_organizational_unit().next();
    let name = unit.and_then(|unit| unit.as_str().ok()).unwrap_or_default();
    let validity = certificate.validity();
    Ok(Identity {
        role,
        name: name.to_owned(),
        hosts: hosts_of(&certificate),
        not_before: time_of(validity.not_before.timestamp()),
        not_after: time_of(validity.not_after.timestamp()),
    })
}

fn of_der(der: &[u8]) -> Result<X509Certificate<'_>, String> {
    let read = X509Certificate::from_der(der);
    read.map_or_else(|error| Err(format!("not a certificate: {error}")), |(_, read)| Ok(read))
}

/// The names and addresses that a certificate is for; none where it does not say.
fn hosts_of(certificate: &X509Certificate<'_>) -> Vec<String> {
    let names = certificate.subject_alternative_name().ok().flatten();
    let names = names.map(|extension| extension.value.general_names.as_slice());
    let host = |name: &GeneralName<'_>| match name {
        GeneralName::DNSName(host) => Some((*host).to_owned()),
        GeneralName::IPAddress(bytes) => {
            match (<[u8; 4]>::try_from(*bytes), <[u8; 16]>::try_from(*bytes)) {
                (Ok(v4), _) => Some(IpAddr::from(v4).to_string()),
                (_, Ok(v6)) => Some(IpAddr::from(v6).to_string()),
                _ => None,
            }
        }
        _ => None,
    };
    names.unwrap_or_default().iter().filter_map(host).collect()
}

/// The identity in the first certificate of a PEM file.
///
/// # Errors
/// [`PkiError::File`], [`PkiError::Content`].
pub fn identity_of_pem(path: &Path) -> Result<Identity, PkiError> {
    first_of_pem(path, identity_of_der)
}

/// The names and addresses that the first certificate of a PEM file is for, whoever made it.
///
/// # Errors
/// [`PkiError::File`], [`PkiError::Content`].
pub fn hosts_of_pem(path: &Path) -> Result<Vec<String>, PkiError> {
    first_of_pem(path, |der| of_der(der).map(|certificate| hosts_of(&certificate)))
}

fn first_of_pem<T>(
    path: &Path,
    read: impl FnOnce(&[u8]) -> Result<T, String>,
) -> Result<T, PkiError> {
    let bytes = std::fs::read(path).map_err(|source| PkiError::file(path, source))?;
    let content = |reason: String| PkiError::Content { path: path.to_owned(), reason };
    let (_, pem) = x509_parser::pem::parse_x509_pem(&bytes)
        .map_err(|error| content(format!("not a certificate in PEM: {error}")))?;
    read(&pem.contents).map_err(content)
}

/// Seconds since 1970 as a time; times before count as 1970.
fn time_of(seconds: i64) -> SystemTime {
    UNIX_EPOCH + Duration::from_secs(u64::try_from(seconds).unwrap_or(0))
}
