//! Recordings of a servo that swings a weight, in the JSON form of the BAM project (github.com/Rhoban/bam), read and
//! written.
//!
//! One file is one run: `mass` (kg), `length` (m), `kp` (the servo's gain register), `vin` (V), `motor`,
//! `trajectory`, and `entries` with `timestamp` (s), `position` (rad), `speed` (rad/s), `load` (present PWM,
//! 16-bit two's complement written without its sign), `input_volts` (V), `temp` (°C), `goal_position` (rad),
//! `torque_enable`.
//!
//! Gain register to N·m/rad: duty per error times torque per duty. Duty per error is
//! `register / divisor · counts / full duty`; torque per duty is the supply times the slope of the robot
//! file's servo at stall. The manual's divisor for this servo family is 128; the XL330's own PWM readings
//! follow 256 to within one count (residual 0.4 to 0.6 counts of 885 at register 100), so 256 is used, and
//! each file is held to it.

use std::path::Path;

use caudata_model::RobotModel;
use caudata_runlog::{BaseHold, LogMeta, Setting, Signal, Table};
use serde::{Deserialize, Serialize};

use super::run::{ImportError, Imported, bytes};
use crate::check::series::median;

/// The motor whose law is known, as recordings name it.
const MOTOR: &str = "xl330";
/// PWM reading that stands for full duty (e-manual of the X series).
const FULL_DUTY: f64 = 885.0;
/// Register units per count of PWM and count of error, measured (see above).
const GAIN_DIVISOR: f64 = 256.0;
/// A gain seen in the PWM readings may be off the register's by this share before it is said.
const GAIN_TOLERANCE: f64 = 0.05;
/// PWM readings nearer to full duty than this are taken for saturated.
const SATURATED: f64 = 880.0;
/// Fewer rows than this make no run.
const MIN_ROWS: usize = 10;

#[derive(Serialize, Deserialize)]
struct Recording {
    mass: f64,
    length: f64,
    kp: f64,
    vin: f64,
    motor: String,
    trajectory: String,
    entries: Vec<Entry>,
}

#[derive(Serialize, Deserialize)]
struct Entry {
    timestamp: f64,
    position: f64,
    speed: f64,
    load: f64,
    input_volts: f64,
    temp: f64,
    goal_position: f64,
    torque_enable: bool,
}

impl Entry {
    /// PWM counts with their sign: the register is 16-bit two's complement.
    fn pwm_counts(&self) -> f64 {
        if self.load >= 32_768.0 { self.load - 65_536.0 } else { self.load }
    }

    /// Its time, s, and its values in the order of the columns; what is wrong with it, if anything.
    fn row(&self) -> Result<(f64, Vec<Option<f64>>), String> {
        let values = [
            self.timestamp,
            self.position,
            self.speed,
            self.load,
            self.input_volts,
            self.temp,
            self.goal_position,
        ];
        if values.iter().any(|v| !v.is_finite()) {
            return Err(" has a value that is not finite".to_owned());
        }
        let counts = self.pwm_counts();
        if counts.abs() > 1.01 * FULL_DUTY {
            return Err(format!(": `load` is {}, beyond ±{FULL_DUTY} PWM counts", self.load));
        }
        let row = vec![
            self.torque_enable.then_some(self.goal_position),
            Some(self.position),
            Some(self.speed),
            Some((counts / FULL_DUTY).clamp(-1.0, 1.0)),
            Some(self.temp),
            Some(f64::from(u8::from(self.torque_enable))),
            Some(self.input_volts),
        ];
        Ok((self.timestamp, row))
    }
}

/// Reads a recording of `robot`, which must have one actuated joint.
///
/// # Errors
/// [`ImportError`] with the file and the reason.
pub fn read(path: &Path, robot: &RobotModel) -> Result<Imported, ImportError> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    parse(&path.display().to_string(), &stem, &bytes(path)?, robot)
}

/// As [`read`], from bytes; `file` names them in errors, `stem` in the name of the run.
///
/// # Errors
/// As [`read`].
pub fn parse(
    file: &str,
    stem: &str,
    json: &[u8],
    robot: &RobotModel,
) -> Result<Imported, ImportError> {
    let run: Recording =
        serde_json::from_slice(json).map_err(|e| wrong(file, e.to_string().replace('\n', " ")))?;
    let &[joint] = robot.actuated_names().as_slice() else {
        return Err(ImportError::Robot {
            file: file.to_owned(),
            robot: robot.name().to_owned(),
            message: "the recording has one joint; give the robot file of the rig".to_owned(),
        });
    };
    let good = |x: f64| x.is_finite() && x > 0.0;
    if !(good(run.kp) && good(run.vin) && good(run.mass) && good(run.length)) {
        let message = "`kp`, `vin`, `mass` and `length` must be above zero".to_owned();
        return Err(wrong(file, message));
    }
    let count = run.entries.len();
    if count < MIN_ROWS {
        let message = format!("has {count} entries; a run has at least {MIN_ROWS}");
        return Err(wrong(file, message));
    }
    if run.motor != MOTOR {
        return Err(wrong(
            file,
            format!(
                "was recorded with motor `{}`: what its gain register and its load reading count is not known here; known: {MOTOR}. Import its CSV with a map (`--format csv`), which says so",
                run.motor
            ),
        ));
    }
    let columns = [
        Signal::Command,
        Signal::Position,
        Signal::Velocity,
        Signal::Duty,
        Signal::Temperature,
        Signal::Enabled,
    ];
    let mut signals: Vec<Signal> = columns.iter().map(|of| of(joint.to_owned())).collect();
    signals.push(Signal::Voltage);
    let rows = run.entries.iter().enumerate();
    let rows = rows.map(|(i, e)| e.row().map_err(|what| wrong(file, format!("entry {i}{what}"))));
    let rows: Vec<(f64, Vec<Option<f64>>)> = rows.collect::<Result<_, _>>()?;
    let mut notes = Vec::new();
    let meta = meta(file, stem, &run, robot, &mut notes);
    let off = run.entries.iter().filter(|e| !e.torque_enable).count();
    if off > 0 {
        notes.push(format!(
            "{file}: the servo is let go in {off} of {} rows (on.{joint} = 0)",
            rows.len()
        ));
    }
    Ok(Imported { name: folder_name(&run, stem), meta, signals, rows, notes, unused: Vec::new() })
}

/// A log as a recording of this form.
///
/// # Errors
/// What it does not say, or says of another kind of run: the form is for one servo that swings a known weight.
pub fn text(meta: &LogMeta, table: &Table) -> Result<String, String> {
    let mut joints: Vec<&str> = table.signals().iter().filter_map(Signal::joint).collect();
    joints.sort_unstable();
    joints.dedup();
    let &[joint] = joints.as_slice() else {
        return Err(format!("it has {} joints, and BAM is for one", joints.len()));
    };
    let number = |key: &str, what: &str| match meta.settings.get(key) {
        Some(Setting::Number(x)) if *x > 0.0 => Ok(*x),
        _ => Err(format!("its circumstances name no {what} (`{key}`)")),
    };
    let word = |key: &str| match meta.settings.get(key) {
        Some(Setting::Text(text)) => text.clone(),
        _ => String::new(),
    };
    let motor = word("motor");
    if motor != MOTOR {
        return Err(format!(
            "what the readings of motor `{motor}` count there is not known; known: {MOTOR} (`motor`)"
        ));
    }
    let column = |signal: Signal| {
        let missing = || format!("it has no column `{signal}`");
        table.column(&signal).ok_or_else(missing)
    };
    let of = |signal: fn(String) -> Signal| column(signal(joint.to_owned()));
    let (cmd, pos, vel) = (of(Signal::Command)?, of(Signal::Position)?, of(Signal::Velocity)?);
    let (duty, temp, volt) =
        (of(Signal::Duty)?, of(Signal::Temperature)?, column(Signal::Voltage)?);
    let on = of(Signal::Enabled).ok();
    let mut entries: Vec<Entry> = Vec::with_capacity(table.len());
    for (k, &timestamp) in table.time_s().iter().enumerate() {
        let sampled = |column: &[Option<f64>]| {
            column[k].ok_or_else(|| format!("a cell of its row {} is empty", k + 1))
        };
        let position = sampled(pos)?;
        let before = entries.last().map(|e| e.goal_position);
        // the register, 16-bit two's complement
        let share = sampled(duty)?;
        if share.abs() > 1.0 {
            return Err(format!(
                "row {} has a duty of {share}, which is a share of −1 to 1",
                k + 1
            ));
        }
        let counts = (share * FULL_DUTY).round() as i16;
        entries.push(Entry {
            timestamp,
            position,
            speed: sampled(vel)?,
            load: f64::from(counts as u16),
            input_volts: sampled(volt)?,
            temp: sampled(temp)?,
            goal_position: cmd[k].or(before).unwrap_or(position),
            torque_enable: on.map_or(cmd[k].is_some(), |on| on[k] != Some(0.0)),
        });
    }
    let recording = Recording {
        mass: number("load_mass_kg", "weight")?,
        length: number("load_length_m", "length of the arm")?,
        kp: number("kp_register", "gain register")?,
        vin: meta.supply_v.ok_or("its circumstances name no supply (`supply_v`)")?,
        motor,
        trajectory: word("trial"),
        entries,
    };
    serde_json::to_string(&recording).map_err(|e| e.to_string())
}

fn wrong(file: &str, message: String) -> ImportError {
    ImportError::Format { file: file.to_owned(), message }
}

/// The circumstances of a recording; what contradicts itself goes to `notes`.
fn meta(
    file: &str,
    stem: &str,
    run: &Recording,
    robot: &RobotModel,
    notes: &mut Vec<String>,
) -> LogMeta {
    let servo = robot.servo(0);
    let counts_per_rad = f64::from(servo.encoder_counts_per_turn) / std::f64::consts::TAU;
    let duty_per_rad = run.kp / GAIN_DIVISOR * counts_per_rad / FULL_DUTY;
    let stall_nm_per_volt = servo.tau_max_nm / servo.reference_supply_v;
    let mut meta = LogMeta::new(robot.name(), BaseHold::Fixed, rate_hz(&run.entries));
    meta.notes = format!("imported from {stem}, trajectory {}", run.trajectory);
    meta.kp = Some(duty_per_rad * run.vin * stall_nm_per_volt);
    meta.kd = Some(0.0);
    meta.supply_v = Some(run.vin);
    let mut put = |key: &str, value| meta.settings.insert(key.to_owned(), value);
    put("trial", Setting::Text(run.trajectory.clone()));
    put("motor", Setting::Text(run.motor.clone()));
    put("kp_register", Setting::Number(run.kp));
    put("load_mass_kg", Setting::Number(run.mass));
    put("load_length_m", Setting::Number(run.length));
    if let Some(counts) = pwm_per_count(&run.entries, counts_per_rad) {
        let measured = run.kp / counts;
        put("gain_divisor_measured", Setting::Number(measured));
        if (measured / GAIN_DIVISOR - 1.0).abs() > GAIN_TOLERANCE {
            notes.push(format!(
                "{file}: the PWM readings follow register/{measured:.0}, not register/{GAIN_DIVISOR:.0}; `kp` in log.toml may be off by as much"
            ));
        }
    }
    meta
}

/// `sin_sin_kp200_2026-01-15_10h28m42`, of letters that any file system takes.
fn folder_name(run: &Recording, stem: &str) -> String {
    format!("{}_kp{}_{stem}", run.trajectory, run.kp)
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() || "_-".contains(c) { c } else { '-' })
        .collect()
}

/// Rows per second: the inverse of the median step.
fn rate_hz(entries: &[Entry]) -> f64 {
    let steps = entries.windows(2).map(|w| w[1].timestamp - w[0].timestamp);
    let median = median(steps.collect()).unwrap_or(0.0);
    if median > 0.0 {
        (1.0 / median).min(1e5)
    } else {
        1.0 // the writer then refuses the rows and says which
    }
}

/// PWM counts per count of position error, by least squares over the rows where the servo holds and is not
/// saturated.
fn pwm_per_count(entries: &[Entry], counts_per_rad: f64) -> Option<f64> {
    let (mut xx, mut xy) = (0.0, 0.0);
    for e in entries {
        if e.torque_enable && e.pwm_counts().abs() < SATURATED {
            let error = (e.goal_position - e.position) * counts_per_rad;
            xx += error * error;
            xy += error * e.pwm_counts();
        }
    }
    // A run that hardly moves says nothing: rounding to whole counts would decide.
    (xx > 1e5 && xy > 0.0).then(|| xy / xx)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rig() -> RobotModel {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        RobotModel::load(path.as_ref()).unwrap()
    }

    /// Twelve rows at 5 ms; error 0.3 rad = 195.6 counts, so register 200 asks for 195.6·200/256 = 152.8
    /// counts.
    fn recording(loads: [i64; 2], on_last: bool) -> String {
        let entries: Vec<String> = (0..12)
            .map(|i| {
                let on = i < 11 || on_last;
                let load = loads[usize::from(i >= 6)];
                let goal = if i < 6 { 0.4 } else { -0.2 };
                format!(
                    r#"{{"timestamp": {}, "position": 0.1, "speed": 0.0, "load": {load}, "input_volts": 7.3, "temp": 29,
                        "goal_position": {goal}, "torque_enable": {on}}}"#,
                    f64::from(i) * 0.005
                )
            })
            .collect();
        format!(
            r#"{{"mass": 0.49, "length": 0.1, "kp": 200, "vin": 7.4, "motor": "xl330", "trajectory": "square wave",
                "entries": [{}]}}"#,
            entries.join(",")
        )
    }

    fn import(text: &str) -> Result<Imported, ImportError> {
        parse("a.json", "a", text.as_bytes(), &rig())
    }

    #[test]
    fn a_run_in_neutral_form() {
        // −153 as the register shows it: 65536 − 153
        let run = import(&recording([153, 65_383], false)).unwrap();
        assert_eq!(run.name, "square-wave_kp200_a");
        let header: Vec<String> = run.signals.iter().map(ToString::to_string).collect();
        assert_eq!(
            header.join(","),
            "cmd.swing,pos.swing,vel.swing,pwm.swing,temp.swing,on.swing,volt"
        );
        // register 200: 200/256 · 4096/2π / 885 = 0.5755 duty/rad; times 7.4 V times 0.77/7.4 N·m/V
        assert!((run.meta.kp.unwrap() - 0.5755 * 0.77).abs() < 1e-4);
        assert_eq!(run.meta.supply_v, Some(7.4));
        assert!((run.meta.rate_hz - 200.0).abs() < 1e-9);
        assert_eq!(run.rows[0].1[3], Some(153.0 / 885.0));
        assert_eq!(run.rows[6].1[3], Some(-153.0 / 885.0));
        // the last row is let go: no command
        assert_eq!((run.rows[10].1[0], run.rows[10].1[5]), (Some(-0.2), Some(1.0)));
        assert_eq!((run.rows[11].1[0], run.rows[11].1[5]), (None, Some(0.0)));
        assert_eq!(run.notes.len(), 1, "{:?}", run.notes);
    }

    #[test]
    fn a_gain_that_is_not_the_registers_is_said() {
        // twice the PWM: the servo follows register/128
        let run = import(&recording([306, 65_230], true)).unwrap();
        assert!(run.notes[0].contains("register/128"), "{:?}", run.notes);
        let Setting::Number(divisor) = run.meta.settings["gain_divisor_measured"] else {
            panic!("not a number");
        };
        assert!((divisor - 127.8).abs() < 0.1, "{divisor}");
    }

    #[test]
    fn wrong_recordings_say_what() {
        let check = |text: &str, want: &str| {
            let e = import(text).unwrap_err().to_string();
            assert!(e.contains(want) && !e.contains('\n'), "{e}");
        };
        check("", "a.json: EOF");
        check("[1, 2]", "a.json:");
        check(&recording([1000, 0], true), "entry 0: `load` is 1000");
        check(&recording([0, 0], true).replace("\"kp\": 200", "\"kp\": 0"), "must be above zero");
        check(
            r#"{"mass":1,"length":1,"kp":1,"vin":7,"motor":"m","trajectory":"t","entries":[]}"#,
            "has 0 entries",
        );
    }

    #[test]
    fn written_and_read_again_it_is_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let run = import(&recording([153, 65_383], true)).unwrap();
        let folder = run.write(dir.path()).unwrap();
        let log = caudata_runlog::RunLog::read(&folder).unwrap();
        assert_eq!(log.meta, run.meta);
        assert_eq!(log.table.signals(), run.signals);
        assert_eq!(log.table.row(6).unwrap(), run.rows[6].1);
        // nothing is overwritten
        assert!(run.write(dir.path()).is_err());
    }

    #[test]
    fn said_in_bam_again_it_is_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let run = import(&recording([153, 65_383], false)).unwrap();
        let log = caudata_runlog::RunLog::read(&run.write(dir.path()).unwrap()).unwrap();
        let again = import(&text(&log.meta, &log.table).unwrap()).unwrap();
        assert_eq!((&again.meta, &again.signals), (&run.meta, &run.signals));
        assert_eq!((&again.rows, &again.name), (&run.rows, &run.name));

        let table = |csv: &str| Table::parse("t.csv", csv.as_bytes()).unwrap();
        let refused = |meta: &LogMeta, table: &Table, why: &str| {
            let said = text(meta, table).unwrap_err();
            assert!(said.contains(why), "{said}");
        };
        refused(&log.meta, &table("t,cmd.a,pos.b\n0,1,1\n"), "has 2 joints");
        refused(&log.meta, &table("t,volt\n0,7\n"), "has 0 joints");
        refused(&log.meta, &table("t,cmd.a,pos.a,vel.a\n0,1,1,0\n"), "no column `pwm.a`");
        let gap = table("t,cmd.a,pos.a,vel.a,pwm.a,temp.a,volt\n0,1,1,0,,30,7\n");
        refused(&log.meta, &gap, "a cell of its row 1 is empty");
        for (key, why) in
            [("load_mass_kg", "no weight"), ("kp_register", "no gain"), ("motor", "of motor ``")]
        {
            let mut meta = log.meta.clone();
            meta.settings.remove(key);
            refused(&meta, &log.table, why);
        }
    }

    proptest::proptest! {
        /// A recording with any damage is a run or an error, never a panic.
        #[test]
        fn no_damage_panics(at in 0usize..4000, with: u8, load in -70_000i64..70_000) {
            let mut bytes = recording([load, 5], true).into_bytes();
            let n = bytes.len();
            bytes[at % n] = with;
            let _ = parse("a.json", "a", &bytes, &rig());
            let _ = parse("a.json", "a", &bytes[..at % n], &rig());
        }
    }
}
