//! The authority of a lab: a key that signs certificates, in a folder that stays with the operator.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyPair, KeyUsagePurpose,
};

use super::error::{CA_FILE, CERTIFICATE_FILE, KEY_FILE, PkiError, VALID_DAYS_MAX};
use super::inspect::identity_of_pem;
use super::role::Role;

/// How long the authority is valid, days.
const AUTHORITY_DAYS: u32 = 3_650;
/// Clocks of a lab may differ by this much.
const CLOCK_SLACK: Duration = Duration::from_secs(3_600);
/// The authority's private key, in its folder.
const CA_KEY_FILE: &str = "ca.key";

/// A certificate that is asked for.
#[derive(Clone, Debug)]
pub struct Request {
    /// What the process is.
    pub role: Role,
    /// Its name, also that of the folder: 1 to 64 of `a-z A-Z 0-9 - _ .`.
    pub name: String,
    /// Host names and addresses at which others reach it. Not empty for a role that listens.
    pub hosts: Vec<String>,
    /// Validity, days.
    pub days: u32,
}

/// The authority.
pub struct Authority {
    folder: PathBuf,
    certificate_pem: String,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    /// Makes a new authority in `folder`, which must not hold one.
    ///
    /// # Errors
    /// [`PkiError::Exists`], [`PkiError::File`], [`PkiError::Make`].
    pub fn create(folder: &Path, lab: &str, now: SystemTime) -> Result<Self, PkiError> {
        check_name(lab)?;
        make_private_folder(folder)?;
        let key = KeyPair::generate().map_err(make)?;
        let mut params = CertificateParams::new(Vec::new()).map_err(make)?;
        params.distinguished_name = subject(&format!("{lab} authority"), lab);
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        set_validity(&mut params, now, AUTHORITY_DAYS);
        let certificate = params.self_signed(&key).map_err(make)?.pem();
        // The key first: when only one of them could be written, the folder is not taken for an authority.
        write_new(&folder.join(CA_KEY_FILE), key.serialize_pem().as_bytes(), 0o600)?;
        write_new(&folder.join(CA_FILE), certificate.as_bytes(), 0o644)?;
        Self::open(folder)
    }

    /// The authority in `folder`.
    ///
    /// # Errors
    /// [`PkiError::File`], [`PkiError::Content`].
    pub fn open(folder: &Path) -> Result<Self, PkiError> {
        let read = |name: &str| {
            let path = folder.join(name);
            let text = fs::read_to_string(&path).map_err(|source| PkiError::file(&path, source))?;
            Ok::<_, PkiError>((path, text))
        };
        let content = |path: PathBuf| {
            move |error: rcgen::Error| PkiError::Content { path, reason: error.to_string() }
        };
        let (key_path, key) = read(CA_KEY_FILE)?;
        let (path, certificate_pem) = read(CA_FILE)?;
        let key = KeyPair::from_pem(&key).map_err(content(key_path))?;
        let issuer = Issuer::from_ca_cert_pem(&certificate_pem, key).map_err(content(path))?;
        Ok(Self { folder: folder.to_owned(), certificate_pem, issuer })
    }

    /// Makes a key and a certificate for one process in a folder with its name beside the authority:
    /// `ca.crt`, `tls.crt`, `tls.key`. With `replace`, certificate and key of an existing folder are renewed.
    ///
    /// # Errors
    /// [`PkiError::Name`], [`PkiError::Days`], [`PkiError::Exists`], [`PkiError::File`], [`PkiError::Make`].
    pub fn issue(
        &self,
        request: &Request,
        now: SystemTime,
        replace: bool,
    ) -> Result<PathBuf, PkiError> {
        check_name(&request.name)?;
        request.hosts.iter().try_for_each(|host| check_host(host))?;
        if !(1..=VALID_DAYS_MAX).contains(&request.days) {
            return Err(PkiError::Days(request.days));
        }
        let folder = self.folder.join(&request.name);
        if folder.exists() {
            if !replace {
                return Err(PkiError::Exists(folder));
            }
        } else {
            make_private_folder(&folder)?;
        }
        let key = KeyPair::generate().map_err(make)?;
        let mut params = CertificateParams::new(request.hosts.clone()).map_err(make)?;
        params.distinguished_name = subject(request.role.name(), &request.name);
        params.is_ca = IsCa::ExplicitNoCa;
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        if request.role.listens() {
            params.extended_key_usages.push(ExtendedKeyUsagePurpose::ServerAuth);
        }
        if request.role.connects() {
            params.extended_key_usages.push(ExtendedKeyUsagePurpose::ClientAuth);
        }
        params.use_authority_key_identifier_extension = true;
        set_validity(&mut params, now, request.days);
        let certificate = params.signed_by(&key, &self.issuer).map_err(make)?.pem();
        let key = key.serialize_pem();
        // Whoever reads meanwhile finds every file, the old one or the new one.
        replace_file(&folder.join(KEY_FILE), key.as_bytes(), 0o600)?;
        replace_file(&folder.join(CERTIFICATE_FILE), certificate.as_bytes(), 0o644)?;
        let authority = self.certificate_pem.as_bytes();
        replace_file(&folder.join(CA_FILE), authority, 0o644)?;
        Ok(folder)
    }

    /// Makes key and certificate of one process again, for the same role, name, hosts and number of days, if
    /// the one that it has ends within `within`. Returns until when the process has one, and whether it is
    /// new.
    ///
    /// # Errors
    /// As [`Self::issue`]; [`PkiError::File`] and [`PkiError::Content`] where there is none to renew.
    pub fn renew(
        &self,
        name: &str,
        now: SystemTime,
        within: Duration,
    ) -> Result<(SystemTime, bool), PkiError> {
        check_name(name)?;
        let path = self.folder.join(name).join(CERTIFICATE_FILE);
        let old = identity_of_pem(&path)?;
        if old.not_after > now + within {
            return Ok((old.not_after, false));
        }
        let valid = old.not_after.duration_since(old.not_before);
        let valid = valid.unwrap_or_default().saturating_sub(CLOCK_SLACK);
        let request = Request {
            role: old.role,
            name: name.to_owned(),
            hosts: old.hosts,
            days: (valid.as_secs() / 86_400).clamp(1, VALID_DAYS_MAX.into()) as u32,
        };
        self.issue(&request, now, true)?;
        Ok((identity_of_pem(&path)?.not_after, true))
    }
}

/// Puts a file in the place of another one, or of none, at once.
fn replace_file(path: &Path, bytes: &[u8], mode: u32) -> Result<(), PkiError> {
    let fresh = path.with_extension("new");
    match fs::remove_file(&fresh) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            return Err(PkiError::file(&fresh, source));
        }
        _ => write_new(&fresh, bytes, mode)?,
    }
    fs::rename(&fresh, path).map_err(|source| PkiError::file(path, source))
}

fn subject(common_name: &str, unit: &str) -> DistinguishedName {
    let mut name = DistinguishedName::new();
    name.push(DnType::OrganizationName, "caudata");
    name.push(DnType::OrganizationalUnitName, unit);
    name.push(DnType::CommonName, common_name);
    name
}

pub(super) fn set_validity(params: &mut CertificateParams, now: SystemTime, days: u32) {
    params.not_before = (now - CLOCK_SLACK).into();
    params.not_after = (now + Duration::from_secs(u64::from(days) * 86_400)).into();
}

fn check_name(name: &str) -> Result<(), PkiError> {
    let letter = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    if (1..=64).contains(&name.len()) && name.chars().all(letter) && !name.starts_with('.') {
        return Ok(());
    }
    Err(PkiError::Name(name.to_owned()))
}

/// A host name or an address; the latter may be IPv6.
fn check_host(host: &str) -> Result<(), PkiError> {
    let wildcard_free = host.strip_prefix("*.").unwrap_or(host);
    if host.parse::<std::net::IpAddr>().is_ok() {
        return Ok(());
    }
    check_name(wildcard_free).map_err(|_| PkiError::Name(host.to_owned()))
}

fn make(error: rcgen::Error) -> PkiError {
    PkiError::Make(error.to_string())
}

fn make_private_folder(folder: &Path) -> Result<(), PkiError> {
    fs::DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(folder)
        .map_err(|source| PkiError::file(folder, source))
}

/// Writes a file that must not exist yet.
fn write_new(path: &Path, bytes: &[u8], mode: u32) -> Result<(), PkiError> {
    let file = OpenOptions::new().write(true).create_new(true).mode(mode).open(path);
    let mut file = file.map_err(|source| match source.kind() {
        std::io::ErrorKind::AlreadyExists => PkiError::Exists(path.to_owned()),
        _ => PkiError::file(path, source),
    })?;
    file.write_all(bytes)
        .and_then(|()| file.sync_all())
        .map_err(|source| PkiError::file(path, source))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;
    use std::time::UNIX_EPOCH;

    use super::*;
    use crate::pki::identity_of_der;

    /// 2026-01-01T00:00:00Z.
    fn new_year() -> SystemTime {
        UNIX_EPOCH + Duration::from_secs(1_767_225_600)
    }

    fn request(role: Role, name: &str) -> Request {
        Request {
            role,
            name: name.to_owned(),
            hosts: vec!["learner.lab".to_owned(), "10.0.0.7".to_owned(), "::1".to_owned()],
            days: 7,
        }
    }

    #[test]
    fn a_certificate_has_its_role_its_name_and_a_week() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("pki");
        Authority::create(&folder, "biorob", new_year()).unwrap();
        let authority = Authority::open(&folder).unwrap();
        let made = authority.issue(&request(Role::Learner, "node-1"), new_year(), false).unwrap();
        let identity = identity_of_pem(&made.join(CERTIFICATE_FILE)).unwrap();
        assert_eq!((identity.role, identity.name.as_str()), (Role::Learner, "node-1"));
        let week = Duration::from_secs(7 * 86_400);
        assert_eq!(identity.not_after, new_year() + week);
        assert_eq!(identity.not_before, new_year() - Duration::from_secs(3_600));
        for (file, mode) in [(KEY_FILE, 0o600), (CERTIFICATE_FILE, 0o644)] {
            let permissions = fs::metadata(made.join(file)).unwrap().permissions();
            assert_eq!(permissions.mode() & 0o777, mode, "{file}");
        }
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!((mode(&folder), mode(&made)), (0o700, 0o700));
        // The authority itself is no process: its common name is no role.
        assert!(identity_of_pem(&made.join(CA_FILE)).is_err());
    }

    #[test]
    fn nothing_is_overwritten_unless_asked_for() {
        let dir = tempfile::tempdir().unwrap();
        let authority = Authority::create(dir.path(), "lab", new_year()).unwrap();
        let again = Authority::create(dir.path(), "lab", new_year()).err().unwrap();
        assert!(matches!(again, PkiError::Exists(_)), "{again}");
        let asked = request(Role::Actor, "actor");
        let made = authority.issue(&asked, new_year(), false).unwrap();
        let key = fs::read(made.join(KEY_FILE)).unwrap();
        let again = authority.issue(&asked, new_year(), false).unwrap_err();
        assert!(matches!(again, PkiError::Exists(_)), "{again}");
        assert_eq!(fs::read(made.join(KEY_FILE)).unwrap(), key);
        authority.issue(&asked, new_year(), true).unwrap();
        assert_ne!(fs::read(made.join(KEY_FILE)).unwrap(), key);
    }

    #[test]
    fn what_ends_soon_is_made_again_for_the_same_process() {
        let dir = tempfile::tempdir().unwrap();
        let authority = Authority::create(dir.path(), "lab", new_year()).unwrap();
        let asked = request(Role::Learner, "node-1");
        let made = authority.issue(&asked, new_year(), false).unwrap();
        let of = |made: &Path| identity_of_pem(&made.join(CERTIFICATE_FILE)).unwrap();
        let first = of(&made);
        assert_eq!(first.hosts, asked.hosts);
        let day = Duration::from_secs(86_400);
        let renew = |now| authority.renew("node-1", now, 2 * day).unwrap();
        assert_eq!(renew(new_year() + 4 * day), (new_year() + 7 * day, false));
        assert_eq!(of(&made), first);
        assert_eq!(renew(new_year() + 6 * day), (new_year() + 13 * day, true));
        let renewed = of(&made);
        assert_eq!((renewed.role, renewed.hosts), (first.role, first.hosts));
        let missing = authority.renew("node-2", new_year(), day).unwrap_err();
        assert!(matches!(missing, PkiError::File { .. }), "{missing}");
    }

    #[test]
    fn names_that_leave_the_folder_and_odd_validities_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let authority = Authority::create(dir.path(), "lab", new_year()).unwrap();
        for name in ["", "../evil", "a/b", ".hidden", "a b", &"x".repeat(65)] {
            let error =
                authority.issue(&request(Role::Robot, name), new_year(), false).unwrap_err();
            assert!(matches!(error, PkiError::Name(_)), "{name}: {error}");
        }
        for days in [0, VALID_DAYS_MAX + 1] {
            let asked = Request { days, ..request(Role::Robot, "robot-1") };
            let error = authority.issue(&asked, new_year(), false).unwrap_err();
            assert!(matches!(error, PkiError::Days(_)), "{error}");
        }
    }

    #[test]
    fn what_is_no_certificate_is_named() {
        assert!(identity_of_der(b"\x30\x03\x02\x01\x01").is_err());
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join(CERTIFICATE_FILE), "hello").unwrap();
        let error = identity_of_pem(&dir.path().join(CERTIFICATE_FILE)).unwrap_err();
        assert!(error.to_string().contains(CERTIFICATE_FILE), "{error}");
    }
}
