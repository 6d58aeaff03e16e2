//! Length-prefixed frames on a byte stream: u32, little-endian, then that many bytes.

use std::io::{self, ErrorKind, Read, Write};

use thiserror::Error;

const PREFIX: usize = 4;

/// Why a frame could not be read or written.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum FrameError {
    /// Longer than the reader or writer allows.
    #[error(
        "frame of {bytes} bytes, the limit is {limit}; the two sides do not speak the same protocol"
    )]
    TooLarge { bytes: usize, limit: usize },
    /// The stream ended within a frame.
    #[error("the connection closed within a frame, after {got} of {expected} bytes")]
    Truncated { got: usize, expected: usize },
    /// The stream failed, or its read time-out passed.
    #[error("the connection failed: {0}")]
    Io(#[from] io::Error),
}

impl FrameError {
    /// True where the read time-out of the stream passed: nothing is lost, read again.
    pub fn is_timeout(&self) -> bool {
        matches!(self, Self::Io(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut))
    }
}

/// Writes one frame, prefix and payload in one go so that they leave in one packet.
///
/// # Errors
/// [`FrameError::TooLarge`] above `limit` bytes of payload, before anything is written; failures
/// of the stream.
pub fn write_frame(
    stream: &mut impl Write,
    payload: &[u8],
    limit: usize,
) -> Result<(), FrameError> {
    let too_large = FrameError::TooLarge { bytes: payload.len(), limit };
    if payload.len() > limit {
        return Err(too_large);
    }
    let length = u32::try_from(payload.len()).map_err(|_| too_large)?;
    let mut frame = Vec::with_capacity(PREFIX + payload.len());
    frame.extend_from_slice(&length.to_le_bytes());
    frame.extend_from_slice(payload);
    stream.write_all(&frame)?;
    Ok(stream.flush()?)
}

/// Reads frames from a stream and keeps its place when a read times out, so that a control loop
/// can wait for a frame with a deadline and come back for the rest.
#[derive(Debug)]
pub struct FrameReader {
    limit: usize,
    buffer: Vec<u8>,
    filled: usize,
    /// The frame in `buffer` is whole and was handed out; the next read starts a new one.
    delivered: bool,
}

impl FrameReader {
    /// A reader that refuses frames of more than `limit` bytes of payload.
    pub fn new(limit: usize) -> Self {
        Self { limit, buffer: vec![0; PREFIX], filled: 0, delivered: false }
    }

    /// The payload of the next frame, or `None` where the far side closed between frames.
    ///
    /// # Errors
    /// With [`FrameError::is_timeout`], call again: what arrived so far is kept. After any other
    /// error the stream is out of step and of no further use.
    pub fn read(&mut self, stream: &mut impl Read) -> Result<Option<&[u8]>, FrameError> {
        if self.delivered {
            self.buffer.truncate(PREFIX);
            self.filled = 0;
            self.delivered = false;
        }
        if self.filled < PREFIX && !self.fill(stream, PREFIX)? {
            return Ok(None);
        }
        let payload = self.announced();
        if payload > self.limit {
            return Err(FrameError::TooLarge { bytes: payload, limit: self.limit });
        }
        let whole = PREFIX + payload;
        self.buffer.resize(whole, 0);
        self.fill(stream, whole)?;
        self.delivered = true;
        Ok(Some(&self.buffer[PREFIX..]))
    }

    fn announced(&self) -> usize {
        let mut prefix = [0; PREFIX];
        prefix.copy_from_slice(&self.buffer[..PREFIX]);
        u32::from_le_bytes(prefix) as usize
    }

    /// Reads up to `end` bytes of the buffer. False: the stream closed before the first one.
    fn fill(&mut self, stream: &mut impl Read, end: usize) -> Result<bool, FrameError> {
        while self.filled < end {
            match stream.read(&mut self.buffer[self.filled..end]) {
                Ok(0) if self.filled == 0 => return Ok(false),
                Ok(0) => return Err(FrameError::Truncated { got: self.filled, expected: end }),
                Ok(n) => self.filled += n,
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(e.into()),
            }
        }
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::VecDeque;

    /// A stream that hands out the scripted pieces, one per read.
    struct Script(VecDeque<io::Result<Vec<u8>>>);

    impl Read for Script {
        fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
            let Some(piece) = self.0.pop_front() else { return Ok(0) };
            let mut piece = piece?;
            let n = piece.len().min(out.len());
            out[..n].copy_from_slice(&piece[..n]);
            let rest = piece.split_off(n);
            if !rest.is_empty() {
                self.0.push_front(Ok(rest));
            }
            Ok(n)
        }
    }

    fn timeout() -> io::Result<Vec<u8>> {
        Err(ErrorKind::WouldBlock.into())
    }

    #[test]
    fn a_frame_is_its_length_and_its_bytes() {
        let mut out = Vec::new();
        write_frame(&mut out, b"abc", 3).unwrap();
        assert_eq!(out, [3, 0, 0, 0, b'a', b'b', b'c']);
        let refused = write_frame(&mut out, b"abcd", 3);
        assert!(matches!(refused, Err(FrameError::TooLarge { bytes: 4, limit: 3 })));
        assert_eq!(out.len(), 7, "nothing of a refused frame is written");
    }

    #[test]
    fn frames_arrive_in_order_and_the_end_is_none() {
        let mut bytes = Vec::new();
        for payload in [&b"one"[..], b"", b"three"] {
            write_frame(&mut bytes, payload, 16).unwrap();
        }
        let mut reader = FrameReader::new(16);
        let mut stream = &bytes[..];
        assert_eq!(reader.read(&mut stream).unwrap(), Some(&b"one"[..]));
        assert_eq!(reader.read(&mut stream).unwrap(), Some(&b""[..]));
        assert_eq!(reader.read(&mut stream).unwrap(), Some(&b"three"[..]));
        assert_eq!(reader.read(&mut stream).unwrap(), None);
    }

    #[test]
    fn a_timeout_within_a_frame_loses_nothing() {
        let script = [Ok(vec![2, 0]), timeout(), Ok(vec![0, 0, b'h']), timeout(), Ok(vec![b'i'])];
        let mut stream = Script(script.into());
        let mut reader = FrameReader::new(16);
        assert!(reader.read(&mut stream).unwrap_err().is_timeout());
        assert!(reader.read(&mut stream).unwrap_err().is_timeout());
        assert_eq!(reader.read(&mut stream).unwrap(), Some(&b"hi"[..]));
    }

    #[test]
    fn a_cut_frame_and_a_giant_one_are_refused() {
        let cut = FrameReader::new(16).read(&mut &[5, 0, 0, 0, 1][..]).map(|_| ());
        assert!(matches!(cut, Err(FrameError::Truncated { got: 5, expected: 9 })));
        let cut = FrameReader::new(16).read(&mut &[5, 0][..]).map(|_| ());
        assert!(matches!(cut, Err(FrameError::Truncated { got: 2, expected: 4 })));
        let giant = FrameReader::new(16).read(&mut &[255; 8][..]).map(|_| ());
        assert!(matches!(giant, Err(FrameError::TooLarge { bytes: 0xffff_ffff, limit: 16 })));
    }
}
