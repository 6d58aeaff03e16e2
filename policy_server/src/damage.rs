//! What is done with damaged files: they are set aside, their numbers stay used up, and the record says so.

use std::fs;
use std::path::{Path, PathBuf};

use caudata_proto::registry::StreamName;

use crate::audit::{Deed, Origin};
use crate::error::RecordError;
use crate::files::version_of;
use crate::notes::Hash;
use crate::record::Record;
use crate::store::Store;

/// A file that was found damaged.
pub struct Damage {
    pub stream: StreamName,
    pub version: u64,
    pub path: PathBuf,
}

impl Store {
    /// Takes away the versions of a damaged blob; their numbers wait for the same bytes.
    pub(crate) fn withdraw(&mut self, sha256: &Hash) {
        let of_it = |record: &&Record| record.manifest.sha256 == *sha256;
        let lost: Vec<Record> = self.records(None).filter(of_it).cloned().collect();
        for Record { manifest, .. } in lost {
            let (stream, version) = (manifest.stream, manifest.version);
            tracing::error!(%stream, version, "blob damaged, version withdrawn");
            if let Err(error) = self.use_up(&stream, |used| used.damage(version, Some(*sha256))) {
                tracing::error!(%error, %stream, version, "its number is free after a restart");
            }
            self.set_aside(&self.record_path(&stream, version));
            if let Some(versions) = self.streams.get_mut(&stream) {
                versions.remove(&version);
            }
        }
        self.streams.retain(|_, versions| !versions.is_empty());
    }

    /// Moves a damaged file away; one of the same name that was moved before stays.
    pub(crate) fn set_aside(&self, path: &Path) {
        let parts: Vec<_> = path.components().collect();
        let last = parts.iter().skip(parts.len().saturating_sub(2));
        let name: Vec<_> = last.map(|part| part.as_os_str().to_string_lossy()).collect();
        let damaged = self.root.join("damaged").join(name.join("_"));
        let mut names = (1..1000).map(|number| damaged.with_extension(format!("{number}.json")));
        let to = if damaged.exists() { names.find(|name| !name.exists()) } else { Some(damaged) };
        if let Some(Err(error)) = to.map(|to| self.disk.rename(path, &to)) {
            tracing::error!(path = %path.display(), %error, "cannot be set aside");
        }
    }

    /// Files that were set aside.
    pub fn damaged_files(&self) -> usize {
        fs::read_dir(self.root.join("damaged")).map_or(0, Iterator::count)
    }

    /// Sets a version's record aside once its number is used up; until then it stays where it is.
    pub(crate) fn damaged_version(
        &mut self,
        path: &Path,
        sha256: Option<Hash>,
        why: &dyn std::fmt::Display,
    ) -> Option<Damage> {
        tracing::error!(path = %path.display(), %why, "damaged record, set aside; its number stays used up");
        let (stream, version) = version_of(path)?;
        match self.use_up(&stream, |used| used.damage(version, sha256)) {
            Ok(()) => self.set_aside(path),
            Err(error) => tracing::error!(%error, "stays where it is"),
        }
        Some(Damage { stream, version, path: path.to_owned() })
    }

    pub(crate) fn note_damage(&self, path: &Path, error: &RecordError) -> Option<Damage> {
        tracing::error!(path = %path.display(), %error, "damaged, set aside");
        self.set_aside(path);
        let in_folder = version_of(path);
        let (stream, version) = match in_folder {
            Some(found) => found,
            // A label, or what is kept once a stream.
            None => {
                let name = path.parent()?.file_name()?.to_str()?;
                let name = match name {
                    "used_up" => path.file_stem()?.to_str()?,
                    folder => folder,
                };
                (StreamName::new(&name.replace('@', "/")).ok()?, 0)
            }
        };
        Some(Damage { stream, version, path: path.to_owned() })
    }

    /// A line for each damaged file, so that the record says what became of it.
    pub(crate) fn write_down_damage(&mut self, damaged: &[Damage]) {
        for damage in damaged {
            let file = damage.path.strip_prefix(&self.root).unwrap_or(&damage.path);
            let detail = format!("{} was found damaged", file.display());
            let deed = Deed::of("damaged", damage.stream.as_str(), damage.version, detail);
            if let Err(error) = self.audit.write(&Origin::of("server"), &deed) {
                tracing::error!(%error, "the record does not say what was found damaged");
            }
        }
    }

    /// Where the file of used-up numbers is damaged, all below the newest version count as such.
    pub(crate) fn guess_used_up(&mut self, damaged: &[Damage]) {
        for Damage { stream, path, .. } in damaged {
            let newest = self.newest(stream).map(|record| record.manifest.version);
            if let Some(newest) = newest.filter(|_| path.starts_with(self.root.join("used_up")))
                && let Err(error) = self.use_up(stream, |used| used.retire(newest))
            {
                tracing::error!(%error, %stream, "numbers of retired versions are free again");
            }
        }
    }
}
