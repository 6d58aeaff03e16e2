//! MCAP files: what is written is read, and nothing panics.

use caudata_runlog::ros::{Compression, Frame, Scene, parse_mcap, write_mcap};
use caudata_runlog::{RunLog, Table};
use proptest::prelude::*;

const LOG: &str = "t,cmd.FL_hip,pos.FL_hip,vel.FL_hip,pos.FR_hip,tau.FR_hip,cur.FL_hip,volt,temp.FL_hip,imu.gyro.x,imu.gyro.y,imu.gyro.z,imu.acc.x,imu.acc.y,imu.acc.z,\
imu.grav.x,imu.grav.y,imu.grav.z,base.pos.x,base.pos.y,base.pos.z,base.quat.w,base.quat.x,base.quat.y,base.quat.z,base.vel.x,base.vel.y,base.vel.z,mocap.tip.x,mocap.tip.y,mocap.tip.z
0.5,0.1,0.05,1.5,-0.2,0.3,0.25,12.5,30,0.1,0.2,0.3,0.5,-0.5,9.8,0.6,0,-0.8,1,2,3,0.5,0.5,0.5,0.5,0.1,0.2,0.3,7,8,9
0.52,0.2,,,,,,,,,,,,,,,,,,,,,,,,,,,,,
0.54,,0.06,,,,,12.25,,0.1,0.2,0.3,0.5,-0.5,9.8,,,,1,2,3,,,,,,,,,,
";

fn bytes(table: &Table) -> Vec<u8> {
    packed(table, None)
}

fn packed(table: &Table, compression: Option<Compression>) -> Vec<u8> {
    let start_ns = 1_700_000_000_000_000_000;
    let frames = |row: usize| {
        let name = "trunk".to_owned();
        let (outer, z) = ("world".to_owned(), row as f64);
        vec![Frame {
            outer,
            name,
            position_m: [0.0, 0.0, z],
            orientation_wxyz: [1.0, 0.0, 0.0, 0.0],
        }]
    };
    let scene = Scene { description: "<robot name=\"p\"/>", base: "trunk", frames: &frames };
    write_mcap(table, start_ns, compression, Some(&scene)).unwrap()
}

fn log() -> Table {
    Table::parse("log.csv", LOG.as_bytes()).unwrap()
}

#[test]
fn a_log_comes_back_through_mcap() {
    for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
        comes_back(&log(), compression);
    }
}

fn comes_back(table: &Table, compression: Option<Compression>) {
    let back = parse_mcap("run.mcap", &packed(table, compression)).unwrap();
    assert_eq!(back.len(), 3);
    // what viewers need is no loss
    assert!(back.notes().is_empty(), "{:?}", back.notes());
    for (got, want) in back.time_s().iter().zip([0.0, 0.02, 0.04]) {
        assert!((got - want).abs() < 1e-9, "{got}");
    }
    for signal in table.signals() {
        let (got, want) = (back.column(signal).unwrap(), table.column(signal).unwrap());
        for (g, w) in got.iter().zip(want) {
            match (g, w) {
                (Some(g), Some(w)) => assert!((g - w).abs() < 1e-12, "{signal}: {g} {w}"),
                (None, None) => {}
                other => panic!("{signal}: {other:?}"),
            }
        }
    }
}

#[test]
fn topics_that_are_not_read_are_named() {
    let mut all = bytes(&log());
    let (name, other) = (b"/odom", b"/mine");
    for at in 0..all.len() - name.len() {
        if &all[at..at + name.len()] == name {
            all[at..at + name.len()].copy_from_slice(other);
        }
    }
    let table = parse_mcap("run.mcap", &all).unwrap();
    assert_eq!(table.notes(), ["topic /mine (nav_msgs/msg/Odometry) is not read"]);
}

#[test]
fn a_folder_with_an_mcap_file_is_a_log() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(
        dir.path().join("log.toml"),
        "robot = \"polymander\"\nbase = \"free\"\nrate_hz = 50\n",
    )
    .unwrap();
    assert!(
        RunLog::read(dir.path()).unwrap_err().to_string().contains("log.csv"),
        "neither is there"
    );
    std::fs::write(dir.path().join("bag_0.mcap"), bytes(&log())).unwrap();
    assert_eq!(RunLog::read(dir.path()).unwrap().table.len(), 3);
    // a CSV beside it comes first
    std::fs::write(dir.path().join("log.csv"), "t,volt\n0,1\n").unwrap();
    assert_eq!(RunLog::read(dir.path()).unwrap().table.len(), 1);
}

#[test]
fn files_that_are_none_say_so() {
    let check = |bytes: &[u8], want: &str| {
        let e = parse_mcap("run.mcap", bytes).unwrap_err().to_string();
        assert!(e.contains(want) && !e.contains('\n'), "{e}");
    };
    check(b"", "run.mcap: is not an MCAP file");
    check(b"t,cmd.a\n0,1\n", "run.mcap: is not an MCAP file");
    let whole = bytes(&log());
    // a recorder that was killed leaves what it had written
    let torn = parse_mcap("run.mcap", &whole[..whole.len() / 2]);
    let torn = torn.unwrap();
    assert!(
        torn.len() <= 3 && torn.notes()[0].contains("dropped what follows message"),
        "{:?}",
        torn.notes()
    );
    // stamps that no message can hold
    assert!(write_mcap(&log(), 0, None, None).is_err());
    assert!(write_mcap(&log(), u64::MAX, None, None).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn no_damage_panics(at in 0usize..6000, with: u8, cut in 0usize..6000, pack in 0usize..3) {
        let mut all = packed(&log(), [None, Some(Compression::Zstd), Some(Compression::Lz4)][pack]);
        let n = all.len();
        all[at % n] = with;
        if let Ok(table) = parse_mcap("run.mcap", &all) {
            prop_assert!(table.time_s().windows(2).all(|w| w[0] < w[1]));
        }
        let _ = parse_mcap("run.mcap", &all[..cut % n]);
    }

    #[test]
    fn no_bytes_panic(bytes: Vec<u8>) {
        let _ = parse_mcap("run.mcap", &bytes);
    }
}
