//! Reading what somebody named, which may have no end: a device, a pipe, another file than was meant.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// The bytes of a file that holds no more than `most`, whatever it says about its size.
///
/// # Errors
/// What the system says, or [`io::ErrorKind::FileTooLarge`].
pub fn read_at_most(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut file = File::open(path)?.take(most.saturating_add(1));
    file.read_to_end(&mut bytes)?;
    match bytes.len() as u64 <= most {
        true => Ok(bytes),
        false => Err(io::Error::new(
            io::ErrorKind::FileTooLarge,
            format!("it has more than {most} bytes"),
        )),
    }
}

/// The same of a text.
///
/// # Errors
/// As [`read_at_most`], and [`io::ErrorKind::InvalidData`] for what is not UTF-8.
pub fn read_text_at_most(path: &Path, most: u64) -> io::Result<String> {
    String::from_utf8(read_at_most(path, most)?)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error.utf8_error()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_without_an_end_is_not_read_to_it() {
        let endless = Path::new("/dev/zero");
        let error = read_at_most(endless, 1 << 20).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
        assert_eq!(error.to_string(), "it has more than 1048576 bytes");
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("f");
        std::fs::write(&path, b"abc\xff").unwrap();
        assert_eq!(read_at_most(&path, 4).unwrap(), b"abc\xff");
        assert!(read_at_most(&path, 3).is_err());
        let error = read_text_at_most(&path, 4).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::InvalidData);
    }
}
