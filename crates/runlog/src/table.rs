//! Reading `log.csv`: header, rows, time.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use crate::error::{LogError, io_error};
use crate::signal::Signal;

/// Most columns, `t` included.
pub const MAX_COLUMNS: usize = 4096;
/// Most rows: four hours at 1 kHz.
pub const MAX_ROWS: usize = 14_400_000;
/// Longest line, bytes.
pub const MAX_LINE_BYTES: usize = 256 * 1024;

/// The rows of a log, by column. What exists is valid: time increases strictly, every value is finite.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Table {
    signals: Vec<Signal>,
    time_s: Vec<f64>,
    columns: Vec<Vec<Option<f64>>>,
    notes: Vec<String>,
}

impl Table {
    /// Reads a CSV file.
    ///
    /// # Errors
    /// [`LogError`] with file, line and reason.
    pub fn read(path: &Path) -> Result<Self, LogError> {
        let file = File::open(path).map_err(io_error(path))?;
        Self::parse(&path.display().to_string(), BufReader::new(file))
    }

    /// Reads CSV text; `file` names it in errors and notes.
    ///
    /// # Errors
    /// [`LogError`] with line and reason.
    pub fn parse(file: &str, reader: impl BufRead) -> Result<Self, LogError> {
        let mut lines = Lines { file, reader, number: 0 };
        let Some((header, complete)) = lines.next_line()? else {
            return Err(lines.error("is empty; the first line names the signals"));
        };
        if !complete {
            return Err(lines.error("ends within the header line; there is no data"));
        }
        let signals = parse_header(file, &header)?;
        let mut table = Self {
            columns: vec![Vec::new(); signals.len()],
            signals,
            time_s: Vec::new(),
            notes: Vec::new(),
        };
        while let Some((line, complete)) = lines.next_line()? {
            if !complete {
                // cut off while being written: even its numbers may be cut
                table.notes.push(format!(
                    "{file}:{}: dropped the last line, which does not end with a line break (torn)",
                    lines.number
                ));
                break;
            }
            if table.time_s.len() >= MAX_ROWS {
                return Err(lines.error(&format!("more than {MAX_ROWS} rows; split the log")));
            }
            table.push_line(&line).map_err(|m| lines.error(&m))?;
        }
        Ok(table)
    }

    /// From columns that have been checked: times increase strictly, values are finite, one per row.
    pub(crate) fn from_columns(
        signals: Vec<Signal>,
        time_s: Vec<f64>,
        columns: Vec<Vec<Option<f64>>>,
        notes: Vec<String>,
    ) -> Self {
        Self { signals, time_s, columns, notes }
    }

    fn push_line(&mut self, line: &str) -> Result<(), String> {
        if line.trim().is_empty() {
            return Err("blank line".to_owned());
        }
        let need = 1 + self.signals.len();
        let got = line.split(',').count();
        if got != need {
            return Err(format!("{got} cells where the header has {need}"));
        }
        let mut cells = line.split(',').map(str::trim);
        let t = match cells.next().map(|c| cell("t", c)) {
            Some(Ok(Some(t))) => t,
            Some(Err(e)) => return Err(e),
            _ => return Err("`t` is empty".to_owned()),
        };
        check_time(self.time_s.last().copied(), t)?;
        let mut row = Vec::with_capacity(self.signals.len());
        for (signal, text) in self.signals.iter().zip(cells) {
            let value = cell(signal, text)?;
            if let Some(v) = value {
                check_value(signal, v)?;
            }
            row.push(value);
        }
        self.time_s.push(t);
        for (column, value) in self.columns.iter_mut().zip(row) {
            column.push(value);
        }
        Ok(())
    }

    /// What the columns hold, without `t`, in file order.
    pub fn signals(&self) -> &[Signal] {
        &self.signals
    }

    /// Time of each row, s, strictly increasing.
    pub fn time_s(&self) -> &[f64] {
        &self.time_s
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.time_s.len()
    }

    /// Whether there are no rows.
    pub fn is_empty(&self) -> bool {
        self.time_s.is_empty()
    }

    /// The values of a signal, one per row, `None` where not sampled; `None` where the log has no such
    /// column.
    pub fn column(&self, signal: &Signal) -> Option<&[Option<f64>]> {
        let i = self.signals.iter().position(|s| s == signal)?;
        Some(&self.columns[i])
    }

    /// One row: a value per signal, `None` where not sampled. `None` beyond the last row.
    pub fn row(&self, index: usize) -> Option<Vec<Option<f64>>> {
        (index < self.len()).then(|| self.columns.iter().map(|c| c[index]).collect())
    }

    /// What the reader dropped or passed over, one line each.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }
}

/// Refuses a time that does not come after the one before it.
pub(crate) fn check_time(last: Option<f64>, t: f64) -> Result<(), String> {
    match last {
        Some(last) if t <= last => {
            Err(format!("t = {t:?} does not come after {last:?}; time must increase strictly"))
        }
        _ => Ok(()),
    }
}

/// Refuses values that a signal cannot have.
pub(crate) fn check_value(signal: &Signal, value: f64) -> Result<(), String> {
    if !value.is_finite() {
        return Err(format!("`{signal}` is {value}; leave the cell empty where there is no value"));
    }
    let binary = matches!(signal, Signal::Contact(_) | Signal::Enabled(_));
    if binary && value != 0.0 && value != 1.0 {
        let what = if matches!(signal, Signal::Contact(_)) { "contact" } else { "a switch" };
        return Err(format!("`{signal}` is {value}; {what} is 0 or 1"));
    }
    Ok(())
}

fn cell(name: impl std::fmt::Display, text: &str) -> Result<Option<f64>, String> {
    if text.is_empty() {
        return Ok(None);
    }
    match text.parse::<f64>() {
        Ok(x) if x.is_finite() => Ok(Some(x)),
        _ => Err(format!(
            "`{name}` is `{text}`, not a finite number; leave the cell empty where there is no value"
        )),
    }
}

fn parse_header(file: &str, line: &str) -> Result<Vec<Signal>, LogError> {
    let error = |column: usize, message: String| LogError::Header {
        file: file.to_owned(),
        column,
        message,
    };
    let mut seen = BTreeSet::new();
    let mut signals = Vec::new();
    for (i, name) in line.trim_start_matches('\u{feff}').split(',').map(str::trim).enumerate() {
        if i >= MAX_COLUMNS {
            return Err(error(i + 1, format!("more than {MAX_COLUMNS} columns")));
        }
        if i == 0 {
            if name != "t" {
                return Err(error(1, format!("is `{name}`; the first column is `t`")));
            }
            continue;
        }
        let signal: Signal =
            name.parse().map_err(|e: crate::signal::SignalError| error(i + 1, e.to_string()))?;
        if !seen.insert(signal.clone()) {
            return Err(error(i + 1, format!("`{name}` stands twice")));
        }
        signals.push(signal);
    }
    Ok(signals)
}

/// Lines of bounded length, counted.
struct Lines<'a, R> {
    file: &'a str,
    reader: R,
    number: usize,
}

impl<R: BufRead> Lines<'_, R> {
    fn error(&self, message: &str) -> LogError {
        LogError::Row {
            file: self.file.to_owned(),
            line: self.number.max(1),
            message: message.to_owned(),
        }
    }

    /// The next line without its end, and whether it had one; `None` at the end of the file.
    fn next_line(&mut self) -> Result<Option<(String, bool)>, LogError> {
        let mut bytes = Vec::new();
        let limit = MAX_LINE_BYTES as u64 + 1;
        let read = (&mut self.reader).take(limit).read_until(b'\n', &mut bytes);
        let n = read.map_err(io_error(Path::new(self.file)))?;
        if n == 0 {
            return Ok(None);
        }
        self.number += 1;
        if n > MAX_LINE_BYTES {
            return Err(self.error(&format!("line of more than {MAX_LINE_BYTES} bytes")));
        }
        let complete = bytes.last() == Some(&b'\n');
        if !complete {
            return Ok(Some((String::new(), false)));
        }
        let text = String::from_utf8(bytes).map_err(|_| self.error("is not UTF-8 text"))?;
        Ok(Some((text.trim_end_matches(['\r', '\n']).to_owned(), true)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Table, LogError> {
        Table::parse("log.csv", text.as_bytes())
    }

    fn fails(text: &str, want: &str) {
        let e = parse(text).expect_err(text).to_string();
        assert!(e.contains(want) && !e.contains('\n'), "`{want}` is not in: {e}");
    }

    #[test]
    fn reads_values_gaps_and_line_ends() {
        let t = parse("t,pos.a,contact.FL\r\n0,1.5,\r\n 0.02 , -2e-3 ,1\r\n").unwrap();
        assert_eq!(t.time_s(), [0.0, 0.02]);
        assert_eq!(t.column(&"pos.a".parse().unwrap()).unwrap(), [Some(1.5), Some(-0.002)]);
        assert_eq!(t.column(&"contact.FL".parse().unwrap()).unwrap(), [None, Some(1.0)]);
        assert_eq!(t.column(&"volt".parse().unwrap()), None);
        assert_eq!(t.row(1), Some(vec![Some(-0.002), Some(1.0)]));
        assert_eq!(t.row(2), None);
        assert!(t.notes().is_empty());
    }

    #[test]
    fn a_torn_last_line_is_dropped_with_a_note() {
        // 0.0 is what is left of 0.04: it must not be taken for data
        for torn in ["0.0", "0.04,1.2", "0.04,", "0.04,1.25"] {
            let t = parse(&format!("t,pos.a\n0,1\n0.02,1.1\n{torn}")).unwrap();
            assert_eq!(t.time_s(), [0.0, 0.02], "{torn}");
            assert_eq!(t.notes().len(), 1);
            assert!(
                t.notes()[0].starts_with("log.csv:4: dropped the last line"),
                "{}",
                t.notes()[0]
            );
        }
        // even in the middle of a character
        let mut bytes = b"t,pos.a\n0,1\n0.02,".to_vec();
        bytes.push(0xc3);
        assert_eq!(Table::parse("log.csv", bytes.as_slice()).unwrap().len(), 1);
    }

    #[test]
    fn wrong_tables_say_where() {
        fails("", "log.csv:1: is empty");
        fails("t,pos.a", "log.csv:1: ends within the header");
        fails("time,pos.a\n", "log.csv:1: column 1: is `time`");
        fails("t,pos.a,speed\n", "log.csv:1: column 3: `speed` is not a signal");
        fails("t,pos.a,pos.a\n", "column 3: `pos.a` stands twice");
        fails("t,pos.a b\n", "column 2: `a b` is not a name");
        fails("t,pos.a\n0,1\n0.02\n", "log.csv:3: 1 cells where the header has 2");
        fails("t,pos.a\n0,1,2\n", "log.csv:2: 3 cells");
        fails("t,pos.a\n0,x\n", "log.csv:2: `pos.a` is `x`, not a finite number");
        fails("t,pos.a\n0,nan\n", "log.csv:2: `pos.a` is `nan`");
        fails("t,pos.a\n0,inf\n", "log.csv:2: `pos.a` is `inf`");
        fails("t,pos.a\n,1\n", "log.csv:2: `t` is empty");
        fails("t,pos.a\n0,1\n0.0,2\n", "log.csv:3: t = 0.0 does not come after 0.0");
        fails("t,pos.a\n1,1\n0.5,2\n", "log.csv:3: t = 0.5 does not come after 1.0");
        fails("t,pos.a\n0,1\n\n1,2\n", "log.csv:3: blank line");
        fails("t,contact.FL\n0,0.5\n", "log.csv:2: `contact.FL` is 0.5; contact is 0 or 1");
        let long = format!("t,pos.a\n0,{}1\n", "0".repeat(MAX_LINE_BYTES));
        fails(&long, "log.csv:2: line of more than");
    }
}
