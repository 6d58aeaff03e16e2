//! Writing logs row by row, for a control loop: cheap rows, whole lines, nothing half-written by choice.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use crate::error::LogError;
use crate::log::{CSV_NAME, META_NAME};
use crate::meta::LogMeta;
use crate::signal::Signal;
use crate::table::{MAX_COLUMNS, MAX_LINE_BYTES, check_time, check_value};

/// When rows leave the writer's memory. Times are log time (`t`), not a clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlushPolicy {
    /// Rows are handed to the operating system at least every so many seconds: what a killed process can lose. 0: every row.
    pub flush_s: f64,
    /// The file is forced to the disk every so many seconds: what a power cut can lose. `None`: only at the end, since it can stall a
    /// loop for tens of milliseconds on an SD card.
    pub sync_s: Option<f64>,
}

impl Default for FlushPolicy {
    fn default() -> Self {
        Self {
            flush_s: 0.5,
            sync_s: None,
        }
    }
}

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
    /// [`LogError::Refused`] for a signal that stands twice or has a name that cannot be written; [`LogError::Io`].
    pub fn new(out: W, signals: &[Signal], flush_s: f64) -> Result<Self, LogError> {
        if signals.len() + 1 > MAX_COLUMNS {
            return Err(LogError::Refused(format!(
                "more than {MAX_COLUMNS} columns"
            )));
        }
        let mut line = String::from("t");
        for (i, signal) in signals.iter().enumerate() {
            signal
                .check()
                .map_err(|e| LogError::Refused(e.to_string()))?;
            if signals[..i].contains(signal) {
                return Err(LogError::Refused(format!("signal `{signal}` stands twice")));
            }
            line.push(',');
            line.push_str(&signal.to_string());
        }
        line.push('\n');
        if line.len() > MAX_LINE_BYTES {
            return Err(LogError::Refused(format!(
                "header of more than {MAX_LINE_BYTES} bytes"
            )));
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

    /// Appends a row: one value per signal in the header's order, `None` where there is no sample. A refused row leaves no trace.
    ///
    /// # Errors
    /// [`LogError::Refused`] for a wrong number of values, a time that does not increase, a value that is not finite, or too many rows
    /// waiting for a disk that fails; [`LogError::Io`] when a flush fails: the row was accepted and waits for the next try.
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

    /// Hands everything to the operating system. After an error the rest waits for the next try: no byte is lost or written twice.
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
        result.map_err(|source| LogError::Io {
            path: PathBuf::from(CSV_NAME),
            source,
        })
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
    sync_s: Option<f64>,
    synced_t: f64,
}

impl LogWriter {
    /// Creates the folder with `log.toml` and the header of `log.csv`, with the default [`FlushPolicy`].
    ///
    /// # Errors
    /// [`LogError::Exists`] where the folder already has a `log.csv`; [`LogError::Refused`]; [`LogError::Io`].
    pub fn create(dir: &Path, header: &[Signal], meta: &LogMeta) -> Result<Self, LogError> {
        Self::create_with(dir, header, meta, FlushPolicy::default())
    }

    /// As [`LogWriter::create`] with another flush policy.
    ///
    /// # Errors
    /// As [`LogWriter::create`].
    pub fn create_with(
        dir: &Path,
        header: &[Signal],
        meta: &LogMeta,
        policy: FlushPolicy,
    ) -> Result<Self, LogError> {
        let text = meta.to_toml()?;
        let io = |path: &Path| {
            let path = path.to_owned();
            move |source: io::Error| LogError::Io { path, source }
        };
        fs::create_dir_all(dir).map_err(io(dir))?;
        let csv = dir.join(CSV_NAME);
        let file = OpenOptions::new()
            .write(true)
            .create_new(true)
            .open(&csv)
            .map_err(|e| {
                if e.kind() == io::ErrorKind::AlreadyExists {
                    return LogError::Exists { path: csv.clone() };
                }
                LogError::Io {
                    path: csv.clone(),
                    source: e,
                }
            })?;
        let meta_path = dir.join(META_NAME);
        fs::write(&meta_path, text).map_err(io(&meta_path))?;
        let table = TableWriter::new(file, header, policy.flush_s).map_err(at(dir))?;
        Ok(Self {
            dir: dir.to_owned(),
            table,
            sync_s: policy.sync_s,
            synced_t: f64::NEG_INFINITY,
        })
    }

    /// Appends a row, see [`TableWriter::row`].
    ///
    /// # Errors
    /// As [`TableWriter::row`].
    pub fn row(&mut self, t_s: f64, values: &[Option<f64>]) -> Result<(), LogError> {
        self.table.row(t_s, values).map_err(at(&self.dir))?;
        if self.sync_s.is_some_and(|s| t_s - self.synced_t >= s) {
            self.sync()?;
            self.synced_t = t_s;
        }
        Ok(())
    }

    /// Rows accepted so far.
    pub fn rows(&self) -> u64 {
        self.table.rows()
    }

    /// Forces everything to the disk.
    ///
    /// # Errors
    /// [`LogError::Io`].
    pub fn sync(&mut self) -> Result<(), LogError> {
        self.table.flush().map_err(at(&self.dir))?;
        self.table.out.sync_data().map_err(|source| LogError::Io {
            path: self.dir.join(CSV_NAME),
            source,
        })
    }

    /// Ends the log: everything is on the disk. A writer that is dropped instead keeps what was accepted, without forcing it there.
    ///
    /// # Errors
    /// [`LogError::Io`].
    pub fn finish(mut self) -> Result<(), LogError> {
        self.sync()
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
        LogError::Io { path, source } => LogError::Io {
            path: dir.join(path),
            source,
        },
        other => other,
    }
}
