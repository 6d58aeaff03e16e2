//! Files of pyarrow and of our own, whole and spoilt.

use proptest::prelude::*;

use super::*;
use crate::table::Table;

const MOST: usize = 10_000;

fn of_pyarrow() -> Vec<u8> {
    let file = "../../gap/tests/fixtures/lerobot/data/chunk-000/file-000.parquet";
    std::fs::read(std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).unwrap()
}

/// Twenty rows: lists of three floats, switches, whole numbers; a text is no number and left out.
#[test]
fn columns_of_pyarrow_are_read() {
    let columns = read(&of_pyarrow(), &|_| true, MOST).unwrap();
    let names: Vec<&str> = columns.iter().map(|c| c.name.as_str()).collect();
    let want = [
        "observation.state",
        "action",
        "next.done",
        "timestamp",
        "frame_index",
        "episode_index",
    ];
    assert_eq!(names, want);
    assert!(columns.iter().all(|c| c.rows() == 20));
    let degrees = |k: f64| f64::from((0.01 * k).to_degrees() as f32);
    assert_eq!(columns[0].row(3), [120.0, degrees(3.0), 40.0]);
    assert_eq!(
        columns[1].row(19),
        [120.0, f64::from((0.17f64).to_degrees() as f32), 40.0]
    );
    assert_eq!(columns[2].row(0), [0.0]);
    assert_eq!(columns[4].row(12), [0.0]);
    assert_eq!(columns[5].row(12), [1.0]);
    assert!(columns[5].row(20).is_empty());
    // only what is asked for, and not more than is asked for
    let one = read(&of_pyarrow(), &|name| name == "action", 60).unwrap();
    assert_eq!((one.len(), one[0].rows()), (1, 20));
    assert_eq!(
        read(&of_pyarrow(), &|name| name == "action", 59),
        Err(ParquetError::Many(59))
    );
}

#[test]
fn what_is_no_parquet_says_so() {
    for bytes in [&b""[..], b"PAR1", b"PAR1PAR1", b"t,pos.a\n0,1\n"] {
        assert_eq!(read(bytes, &|_| true, MOST), Err(ParquetError::Magic));
    }
    let whole = of_pyarrow();
    for cut in 0..whole.len() {
        assert!(read(&whole[..cut], &|_| true, MOST).is_err(), "{cut}");
    }
}

#[test]
fn a_log_is_the_same_behind_it() {
    let text = "t,pos.a,contact.FL\n0,1.5,\n0.02,,1\n0.04,-2e-3,0\n";
    let table = Table::parse("log.csv", text.as_bytes()).unwrap();
    let bytes = table.to_parquet().unwrap();
    assert_eq!(Table::from_parquet("log.parquet", &bytes).unwrap(), table);
    let says = |columns: &[(&str, &[f64])], want: &str| {
        let some = |values: &[f64]| values.iter().map(|x| Some(*x)).collect();
        let columns: Vec<_> = columns
            .iter()
            .map(|(n, v)| ((*n).to_owned(), some(v)))
            .collect();
        let error = Table::from_parquet("x.parquet", &write(&columns).unwrap()).unwrap_err();
        assert!(error.to_string().contains(want), "{error}");
    };
    says(&[("pos.a", &[1.0])], "x.parquet: has no column `t`");
    says(
        &[("t", &[1.0, 1.0])],
        "row 1: t = 1.0 does not come after 1.0",
    );
    says(
        &[("t", &[1.0]), ("contact.FL", &[0.5])],
        "contact is 0 or 1",
    );
}

proptest! {
    #[test]
    fn what_is_written_is_read(rows in proptest::collection::vec(proptest::option::of(-1e9..1e9f64), 0..70)) {
        let columns = [("a".to_owned(), rows.clone()), ("b".to_owned(), vec![None; rows.len()])];
        let back = read(&write(&columns).unwrap(), &|_| true, MOST).unwrap();
        let a: Vec<Option<f64>> = (0..back[0].rows()).map(|k| back[0].row(k).first().copied()).collect();
        prop_assert_eq!(a, rows);
        prop_assert!((0..back[1].rows()).all(|k| back[1].row(k).is_empty()));
    }

    /// A file with any damage is columns or an error, never a panic.
    #[test]
    fn no_damage_panics(at in 0usize..1420, with: u8, cut in 0usize..1420) {
        let mut bytes = of_pyarrow();
        let n = bytes.len();
        bytes[at % n] = with;
        let _ = read(&bytes, &|_| true, MOST);
        bytes.drain(at.min(cut) % n..at.max(cut) % n);
        let _ = read(&bytes, &|_| true, MOST);
    }
}
