//! Writing logs row by row, for a control loop: cheap rows, whole lines, nothing half-written by choice.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use crate::error::{LogError, io_error};
use crate::log::{CSV_NAME, META_NAME};
use crate::meta::LogMeta;
use crate::signal::Signal;
use crate::table::{MAX_COLUMNS, MAX_LINE_BYTES, check_time, check_value};

/// Rows of a log are handed to the operating system at least every so many seconds of log time: what a killed
/// process can lose. The disk is forced only at the end, since that can stall a loop for tens of
/// milliseconds.
const FLUSH_S: f64 = 0.5;
/// Rows are also handed over when this much text waits, whatever the time; beyond it rows are refused, bytes.
const BUFFER_LIMIT_BYTES: usize = 256 * 1024;

/// Writes the CSV of a log to anything.
pub struct TableWriter<W: Write> {
    out: W,
    signals: Vec<Signal>,
    flush_s: f64,
    buffer: Vec<u8>,
    last_t: Option<f64>,
    flushed_t: f64,
    rows: u64,
}

impl<W: Write> TableWriter<W> {
    /// Writes the header (`t` and the signals) and keeps rows for up to `flush_s` seconds of log time.
    ///
    /// # Errors
    /// [`LogError::Refused`] for a signal that stands twice or has a name that cannot be written;
    /// [`LogError::Io`].
    pub fn new(out: W, signals: &[Signal], flush_s: f64) -> Result<Self, LogError> {
        if signals.len() + 1 > MAX_COLUMNS {
            return Err(LogError::Refused(format!("more than {MAX_COLUMNS} columns")));
        }
        let mut line = String::from("t");
        for (i, signal) in signals.iter().enumerate() {
            signal.check().map_err(|e| LogError::Refused(e.to_string()))?;
            if signals[..i].contains(signal) {
                return Err(LogError::Refused(format!("signal `{signal}` stands twice")));
            }
            line.push(',');
            line.push_str(&signal.to_string());
        }
        line.push('\n');
        if line.len() > MAX_LINE_BYTES {
            return Err(LogError::Refused(format!("header of more than {MAX_LINE_BYTES} bytes")));
        }
        let mut writer = Self {
            out,
            signals: signals.to_vec(),
            flush_s,
            buffer: line.into_bytes(),
            last_t: None,
            flushed_t: f64::NEG_INFINITY,
            rows: 0,
        };
        writer.flush()?;
        Ok(writer)
    }

    /// Appends a row: one value per signal in the header's order, `None` where there is no sample. A refused
    /// row leaves no trace.
    ///
    /// # Errors
    /// [`LogError::Refused`] for a wrong number of values, a time that does not increase, a value that is not
    /// finite, or too many rows waiting for a disk that fails; [`LogError::Io`] when a flush fails: the row
    /// was accepted and waits for the next try.
    pub fn row(&mut self, t_s: f64, values: &[Option<f64>]) -> Result<(), LogError> {
        if values.len() != self.signals.len() {
            return Err(LogError::Refused(format!(
                "{} values where the header has {} signals",
                values.len(),
                self.signals.len()
            )));
        }
        if !t_s.is_finite() {
            return Err(LogError::Refused(format!("t is {t_s}")));
        }
        check_time(self.last_t, t_s).map_err(LogError::Refused)?;
        for (signal, value) in self.signals.iter().zip(values) {
            if let Some(v) = *value {
                check_value(signal, v).map_err(LogError::Refused)?;
            }
        }
        if self.buffer.len() > BUFFER_LIMIT_BYTES {
            return Err(LogError::Refused(format!(
                "{} bytes of earlier rows still wait for the disk",
                self.buffer.len()
            )));
        }
        push_number(&mut self.buffer, t_s);
        for value in values {
            self.buffer.push(b',');
            if let Some(v) = *value {
                push_number(&mut self.buffer, v);
            }
        }
        self.buffer.push(b'\n');
        self.last_t = Some(t_s);
        self.rows += 1;
        if t_s - self.flushed_t >= self.flush_s || self.buffer.len() >= BUFFER_LIMIT_BYTES {
            self.flush()?;
            self.flushed_t = t_s;
        }
        Ok(())
    }

    /// Rows accepted so far.
    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// Hands everything to the operating system. After an error the rest waits for the next try: no byte is
    /// lost or written twice.
    ///
    /// # Errors
    /// [`LogError::Io`].
    pub fn flush(&mut self) -> Result<(), LogError> {
        let mut written = 0;
        let result = loop {
            if written == self.buffer.len() {
                break self.out.flush();
            }
            match self.out.write(&self.buffer[written..]) {
                Ok(0) => break Err(io::ErrorKind::WriteZero.into()),
                Ok(n) => written += n,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) => break Err(e),
            }
        };
        self.buffer.drain(..written);
        result.map_err(io_error(Path::new(CSV_NAME)))
    }

    /// Flushes and gives the output back. Rows that still wait in a writer that is dropped instead are lost.
    ///
    /// # Errors
    /// [`LogError::Io`].
    pub fn finish(mut self) -> Result<W, LogError> {
        self.flush()?;
        Ok(self.out)
    }
}

/// Shortest text that reads back to the same bits.
fn push_number(buffer: &mut Vec<u8>, x: f64) {
    // Writing into a Vec cannot fail.
    let _ = write!(buffer, "{x:?}");
}

/// Writes a log folder.
///
/// ```no_run
/// use caudata_runlog::{BaseHold, LogMeta, LogWriter, Signal};
/// # fn main() -> Result<(), caudata_runlog::LogError> {
/// let header = [Signal::Command("FL_hip".into()), Signal::Position("FL_hip".into())];
/// let meta = LogMeta::new("polymander", BaseHold::Free, 50.0);
/// let mut log = LogWriter::create("flight/2027-03-01".as_ref(), &header, &meta)?;
/// log.row(0.00, &[Some(0.1), Some(0.0)])?;
/// log.row(0.02, &[Some(0.1), None])?; // the servo did not answer
/// log.finish()?;
/// # Ok(())
/// # }
/// ```
pub struct LogWriter {
    dir: PathBuf,
    table: TableWriter<File>,
}

impl LogWriter {
    /// Creates the folder with `log.toml` and the header of `log.csv`.
    ///
    /// # Errors
    /// [`LogError::Exists`] where the folder already has a `log.csv`; [`LogError::Refused`];
    /// [`LogError::Io`].
    pub fn create(dir: &Path, header: &[Signal], meta: &LogMeta) -> Result<Self, LogError> {
        let text = meta.to_toml()?;
        fs::create_dir_all(dir).map_err(io_error(dir))?;
        let csv = dir.join(CSV_NAME);
        let file = File::create_new(&csv).map_err(|e| match e.kind() {
            io::ErrorKind::AlreadyExists => LogError::Exists { path: csv.clone() },
            _ => io_error(&csv)(e),
        })?;
        let meta_path = dir.join(META_NAME);
        fs::write(&meta_path, text).map_err(io_error(&meta_path))?;
        let table = TableWriter::new(file, header, FLUSH_S).map_err(at(dir))?;
        Ok(Self { dir: dir.to_owned(), table })
    }

    /// Appends a row, see [`TableWriter::row`].
    ///
    /// # Errors
    /// As [`TableWriter::row`].
    pub fn row(&mut self, t_s: f64, values: &[Option<f64>]) -> Result<(), LogError> {
        self.table.row(t_s, values).map_err(at(&self.dir))
    }

    /// Rows accepted so far.
    pub fn rows(&self) -> u64 {
        self.table.rows()
    }

    /// Ends the log: everything is on the disk. A writer that is dropped instead keeps what was accepted,
    /// without forcing it there.
    ///
    /// # Errors
    /// [`LogError::Io`].
    pub fn finish(mut self) -> Result<(), LogError> {
        self.table.flush().map_err(at(&self.dir))?;
        let synced = self.table.out.sync_data();
        synced.map_err(io_error(&self.dir.join(CSV_NAME)))
    }
}

impl Drop for LogWriter {
    fn drop(&mut self) {
        // Nobody is left to hear of an error; `finish` reports it.
        let _ = self.table.flush();
    }
}

/// Puts the folder in front of the file name of an error.
fn at(dir: &Path) -> impl Fn(LogError) -> LogError {
    let dir = dir.to_owned();
    move |e| match e {
        LogError::Io { path, source } => LogError::Io { path: dir.join(path), source },
        other => other,
    }
}
