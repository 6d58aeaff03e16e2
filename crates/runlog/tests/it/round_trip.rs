//! What is written is what is read, whatever happens to the writer.

use std::fs;
use std::io;

use caudata_runlog::{
    Axis, BaseHold, CSV_NAME, LogError, LogMeta, LogWriter, META_NAME, QuatPart, RunLog, Signal,
    Table, TableWriter,
};
use proptest::prelude::*;

fn header() -> Vec<Signal> {
    vec![
        Signal::Command("FL_hip".into()),
        Signal::Position("FL_hip".into()),
        Signal::Voltage,
        Signal::BaseQuaternion(QuatPart::W),
        Signal::Foot("FL".into(), Axis::Z),
        Signal::Contact("FL".into()),
    ]
}

fn meta() -> LogMeta {
    LogMeta { kp: Some(15.0), ..LogMeta::new("polymander", BaseHold::Free, 50.0) }
}

#[test]
fn a_log_reads_back_as_written() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path().join("run/1");
    let mut w = LogWriter::create(&dir, &header(), &meta()).unwrap();
    let row = [Some(0.1), None, Some(14.02), Some(1.0), Some(-1e-9), Some(1.0)];
    w.row(0.0, &row).unwrap();
    w.row(0.02, &[None; 6]).unwrap();
    assert_eq!(w.rows(), 2);
    w.finish().unwrap();
    let log = RunLog::read(&dir).unwrap();
    assert_eq!(log.meta, meta());
    assert_eq!(log.table.signals(), header());
    assert_eq!(log.table.time_s(), [0.0, 0.02]);
    assert_eq!(log.table.row(0).unwrap(), row);
    assert_eq!(log.table.row(1).unwrap(), [None; 6]);
    assert!(log.table.notes().is_empty());
    let text = fs::read_to_string(dir.join(CSV_NAME)).unwrap();
    assert_eq!(
        text,
        "t,cmd.FL_hip,pos.FL_hip,volt,base.quat.w,foot.FL.z,contact.FL\n0.0,0.1,,14.02,1.0,-1e-9,1.0\n0.02,,,,,,\n"
    );
}

#[test]
fn wrong_rows_are_refused_and_leave_no_trace() {
    let dir = tempfile::tempdir().unwrap();
    let mut w = LogWriter::create(dir.path(), &header(), &meta()).unwrap();
    w.row(1.0, &[None; 6]).unwrap();
    let mut refused = |t: f64, row: &[Option<f64>], want: &str| {
        let e = w.row(t, row).unwrap_err();
        assert!(matches!(e, LogError::Refused(_)), "{e}");
        assert!(e.to_string().contains(want), "`{want}` is not in: {e}");
    };
    refused(2.0, &[None; 5], "5 values where the header has 6");
    refused(1.0, &[None; 6], "t = 1.0 does not come after 1.0");
    refused(f64::NAN, &[None; 6], "t is NaN");
    let with = |i: usize, x: f64| {
        let mut row = [None; 6];
        row[i] = Some(x);
        row
    };
    refused(2.0, &with(1, f64::NAN), "`pos.FL_hip` is NaN");
    refused(2.0, &with(2, f64::INFINITY), "`volt` is inf");
    refused(2.0, &with(5, 0.5), "contact is 0 or 1");
    w.row(2.0, &[None; 6]).unwrap();
    w.finish().unwrap();
    assert_eq!(RunLog::read(dir.path()).unwrap().table.time_s(), [1.0, 2.0]);
}

#[test]
fn headers_and_folders_that_cannot_be() {
    let dir = tempfile::tempdir().unwrap();
    let twice = [Signal::Voltage, Signal::Voltage];
    let e = LogWriter::create(&dir.path().join("a"), &twice, &meta()).err().unwrap();
    assert!(e.to_string().contains("`volt` stands twice"), "{e}");
    let bad = [Signal::Position("a,b".into())];
    let e = LogWriter::create(&dir.path().join("b"), &bad, &meta()).err().unwrap();
    assert!(e.to_string().contains("`a,b` is not a name"), "{e}");
    let no_rate = LogMeta { rate_hz: 0.0, ..meta() };
    let e = LogWriter::create(&dir.path().join("c"), &header(), &no_rate).err().unwrap();
    assert!(e.to_string().contains("rate_hz"), "{e}");
    LogWriter::create(&dir.path().join("d"), &header(), &meta()).unwrap().finish().unwrap();
    let e = LogWriter::create(&dir.path().join("d"), &header(), &meta()).err().unwrap();
    assert!(matches!(e, LogError::Exists { .. }), "{e}");
    let e = RunLog::read(&dir.path().join("none")).unwrap_err();
    assert!(e.to_string().contains(META_NAME), "{e}");
}

#[test]
fn rows_leave_the_writer_by_log_time() {
    let dir = tempfile::tempdir().unwrap();
    let mut w = LogWriter::create(dir.path(), &[Signal::Voltage], &meta()).unwrap();
    let on_disk = || Table::read(&dir.path().join(CSV_NAME)).unwrap().len();
    assert_eq!(on_disk(), 0, "the header is there at once");
    for i in 0..=5 {
        w.row(f64::from(i) * 0.25, &[Some(14.0)]).unwrap();
    }
    // t = 0 goes at once, then 0.25 waits for 0.5, 0.75 for 1.0; 1.25 still waits
    assert_eq!(on_disk(), 5);
    drop(w);
    assert_eq!(on_disk(), 6, "a dropped writer keeps what it accepted");
}

/// Takes `room` bytes, then its disk is full.
struct SmallDisk {
    bytes: Vec<u8>,
    room: usize,
}

impl io::Write for SmallDisk {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let n = data.len().min(self.room - self.bytes.len());
        if n == 0 && !data.is_empty() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.bytes.extend_from_slice(&data[..n]);
        Ok(n)
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_full_disk_is_reported_and_what_is_there_stays_readable() {
    let mut disk = SmallDisk { bytes: Vec::new(), room: 30 };
    let mut w = TableWriter::new(&mut disk, &[Signal::Voltage], 0.0).unwrap();
    let mut results = Vec::new();
    for i in 0..5 {
        results.push(w.row(f64::from(i), &[Some(14.25)]).is_ok());
    }
    drop(w);
    // header 7 bytes, "0.0,14.25\n" 10 each: the third row is cut after 3 bytes
    assert_eq!(results, [true, true, false, false, false]);
    let t = Table::parse("log.csv", disk.bytes.as_slice()).unwrap();
    assert_eq!(t.time_s(), [0.0, 1.0]);
    assert_eq!(t.notes().len(), 1);
}

/// Takes the header, then three bytes of every write, and fails every other call.
#[derive(Default)]
struct Hiccup {
    bytes: Vec<u8>,
    calls: usize,
}

impl io::Write for Hiccup {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        self.calls += 1;
        if self.calls.is_multiple_of(2) {
            return Err(io::ErrorKind::StorageFull.into());
        }
        let n = if self.calls == 1 { data.len() } else { data.len().min(3) };
        self.bytes.extend_from_slice(&data[..n]);
        Ok(n)
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn rows_that_could_not_be_written_wait_for_the_next_try() {
    let mut disk = Hiccup::default();
    let mut w = TableWriter::new(&mut disk, &[Signal::Voltage], 0.0).unwrap();
    let errors = (0..3).filter(|i| w.row(f64::from(*i), &[Some(14.25)]).is_err()).count();
    assert_eq!(errors, 3, "every row comes to a failing call");
    // 30 bytes, three per try
    assert_eq!((0..100).take_while(|_| w.flush().is_err()).count(), 7);
    drop(w);
    assert_eq!(String::from_utf8(disk.bytes).unwrap(), "t,volt\n0.0,14.25\n1.0,14.25\n2.0,14.25\n");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Any finite values come back with the same bits, and any cut gives the rows that were complete.
    #[test]
    fn bits_survive_and_any_cut_keeps_whole_rows(
        rows in prop::collection::vec((1e-6..1e3f64, prop::collection::vec(prop::option::of(prop::num::f64::NORMAL | prop::num::f64::SUBNORMAL | prop::num::f64::ZERO), 3)), 0..12),
        cut in 0.0..1.0f64,
    ) {
        let signals = [Signal::Voltage, Signal::Gyro(Axis::X), Signal::Mocap("m".into(), Axis::Y)];
        let mut w = TableWriter::new(Vec::new(), &signals, 0.0).unwrap();
        let mut t = -5.0;
        let mut times = Vec::new();
        for (dt, values) in &rows {
            t += dt;
            times.push(t);
            w.row(t, values).unwrap();
        }
        let bytes = w.finish().unwrap();
        let read = Table::parse("log.csv", bytes.as_slice()).unwrap();
        prop_assert_eq!(read.len(), rows.len());
        for (i, (_, values)) in rows.iter().enumerate() {
            prop_assert_eq!(read.time_s()[i].to_bits(), times[i].to_bits());
            let got: Vec<Option<u64>> = read.row(i).unwrap().iter().map(|v| v.map(f64::to_bits)).collect();
            let want: Vec<Option<u64>> = values.iter().map(|v| v.map(f64::to_bits)).collect();
            prop_assert_eq!(got, want);
        }
        let header_end = bytes.iter().position(|b| *b == b'\n').unwrap() + 1;
        let end = header_end + ((bytes.len() - header_end) as f64 * cut) as usize;
        let part = Table::parse("log.csv", &bytes[..end]).unwrap();
        let whole = bytes[header_end..end].iter().filter(|b| **b == b'\n').count();
        prop_assert_eq!(part.len(), whole);
        prop_assert_eq!(part.time_s(), &read.time_s()[..whole]);
        prop_assert_eq!(part.notes().is_empty(), bytes[end - 1] == b'\n');
    }

    /// No text makes the reader panic.
    #[test]
    fn junk_never_panics(text in "(t|pos\\.a|,|\n|\r|[0-9.e-]|nan){0,40}") {
        let _ = Table::parse("log.csv", text.as_bytes());
        let _ = LogMeta::parse("log.toml", &text);
    }
}
