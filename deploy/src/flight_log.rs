//! The flight log, written by a thread of its own: the control loop hands rows over and never waits for a
//! disk.
//!
//! Row `t`: what was sensed at the start of that control tick, and what was then sent.

use std::path::Path;
use std::thread::JoinHandle;

use caudata_model::RobotModel;
use caudata_runlog::{Axis, BaseHold, LogError, LogMeta, LogWriter, QuatPart, Setting, Signal};
use caudata_task::PerJoint;
use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};

use crate::DeployError;
use crate::bus::{GroundTruth, ImuReading, ServoReadings};
use crate::state::PolicyRef;

/// Rows that wait for the disk; beyond it the oldest is dropped and counted (5 s at 50 Hz).
pub const QUEUE_ROWS: usize = 256;

/// One row.
#[derive(Clone, Copy, Debug)]
pub struct LogRow {
    /// What was sent, rad.
    pub command_rad: PerJoint,
    /// Whether the torque was on; without it there is no command.
    pub torque: bool,
    /// What the servos reported.
    pub servos: ServoReadings,
    /// What the IMU reported.
    pub imu: ImuReading,
    /// Direction of gravity that the policy saw.
    pub gravity: [f32; 3],
    /// What a simulation knows.
    pub truth: GroundTruth,
}

/// What happened to the rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LogCounts {
    /// Rows written.
    pub written: u64,
    /// Rows dropped because the disk was too slow.
    pub dropped: u64,
}

/// The loop's end of the log. Dropped without [`FlightLog::finish`], the thread writes what is queued and
/// ends by itself.
#[derive(Debug)]
pub struct FlightLog {
    rows: Sender<LogRow>,
    /// The other end, to drop the oldest row.
    oldest: Receiver<LogRow>,
    writer: JoinHandle<Result<u64, LogError>>,
    dropped: u64,
}

impl FlightLog {
    /// Creates the log folder. Columns for what `truth` holds are made, others left out.
    ///
    /// # Errors
    /// [`DeployError::Log`] where the folder has a log already or cannot be written; [`DeployError::System`].
    pub fn create(
        folder: &Path,
        model: &RobotModel,
        meta: &LogMeta,
        truth: &GroundTruth,
    ) -> Result<Self, DeployError> {
        let columns = Columns::new(model, truth);
        let log = LogWriter::create(folder, &columns.signals, meta)?;
        let (rows, queue) = bounded(QUEUE_ROWS);
        let oldest = queue.clone();
        let writer = std::thread::Builder::new()
            .name("flight-log".into())
            .spawn(move || write(log, &columns, queue))
            .map_err(DeployError::system("a thread"))?;
        Ok(Self { rows, oldest, writer, dropped: 0 })
    }

    /// Hands a row over; never waits.
    pub fn push(&mut self, row: LogRow) {
        if let Err(TrySendError::Full(row)) = self.rows.try_send(row) {
            self.dropped += u64::from(self.oldest.try_recv().is_ok());
            // The writer may have ended; then nobody wants the row, and `finish` says why.
            let _ = self.rows.try_send(row);
        }
    }

    /// Writes what is queued, forces it to the disk and ends the thread.
    ///
    /// # Errors
    /// [`DeployError::Log`]: the first failure of the writer.
    pub fn finish(self) -> Result<LogCounts, DeployError> {
        let Self { rows, oldest, writer, dropped } = self;
        drop(rows);
        let ended = writer.join().map_err(|_| DeployError::Internal {
            what: "the flight log's thread panicked".to_owned(),
        })?;
        drop(oldest);
        Ok(LogCounts { written: ended?, dropped })
    }
}

/// Writes rows that are there already as a log of their own; how many went in.
///
/// # Errors
/// As [`FlightLog::create`] and [`FlightLog::finish`].
pub fn write_rows<'a>(
    folder: &Path,
    model: &RobotModel,
    meta: &LogMeta,
    rows: impl Iterator<Item = &'a LogRow>,
) -> Result<u64, DeployError> {
    let mut rows = rows.peekable();
    let truth = rows.peek().map_or_else(GroundTruth::default, |row| row.truth);
    let columns = Columns::new(model, &truth);
    let log = LogWriter::create(folder, &columns.signals, meta)?;
    Ok(write(log, &columns, rows.copied())?)
}

/// `log.toml` of a run.
pub fn meta(
    model: &RobotModel,
    policy: &PolicyRef,
    period_s: f64,
    supply_v: f32,
    terrain: &str,
) -> LogMeta {
    let mut meta = LogMeta::new(model.name(), BaseHold::Free, 1.0 / period_s);
    meta.terrain = terrain.to_owned();
    meta.kp = model.common_gains().map(|g| g.kp_nm_per_rad);
    meta.kd = model.common_gains().map(|g| g.kd_nm_s_per_rad);
    meta.supply_v = Some(f64::from(supply_v.max(0.0)));
    meta.notes = format!("policy {policy}, sha256 {}", policy.sha256);
    let texts = [
        ("policy_stream", policy.stream.clone()),
        ("policy_version", policy.version.to_string()),
        ("policy_sha256", policy.sha256.to_string()),
        ("robot_hash", model.hash_hex()),
    ];
    for (key, text) in texts {
        meta.settings.insert(key.to_owned(), Setting::Text(text));
    }
    meta
}

fn write(
    mut log: LogWriter,
    columns: &Columns,
    rows: impl IntoIterator<Item = LogRow>,
) -> Result<u64, LogError> {
    let mut values = Vec::with_capacity(columns.signals.len());
    for row in rows {
        columns.fill(&row, &mut values);
        // A row that cannot be part of a log (time that stands still, a number that is not finite) is left
        // out.
        match log.row(row.servos.time_s, &values) {
            Err(LogError::Refused(reason)) => tracing::debug!(reason, "log row left out"),
            other => other?,
        }
    }
    let written = log.rows();
    log.finish()?;
    Ok(written)
}

/// The header, and what of a row goes where.
struct Columns {
    signals: Vec<Signal>,
    base: bool,
    /// Feet whose contacts are written.
    feet: usize,
}

impl Columns {
    fn new(model: &RobotModel, truth: &GroundTruth) -> Self {
        let of_joints: [fn(String) -> Signal; 4] =
            [Signal::Command, Signal::Position, Signal::Velocity, Signal::Current];
        let mut signals = Signal::each(&of_joints, &model.actuated_names());
        signals.push(Signal::Voltage);
        signals.extend(Signal::axes(&[Signal::Gyro, Signal::Acceleration, Signal::Gravity]));
        let base = truth.base_pos_m.is_some();
        if base {
            signals.extend(Axis::ALL.map(Signal::BasePosition));
            signals.extend(QuatPart::ALL.map(Signal::BaseQuaternion));
        }
        let feet = match truth.foot_contacts {
            Some(_) => model.feet(),
            None => &[],
        };
        signals.extend(feet.iter().map(|foot| Signal::Contact(foot.name.clone())));
        Self { signals, base, feet: feet.len() }
    }

    fn fill(&self, row: &LogRow, values: &mut Vec<Option<f64>>) {
        fn numbers(values: &[f32]) -> impl Iterator<Item = Option<f64>> + '_ {
            values.iter().map(|v| v.is_finite().then_some(f64::from(*v)))
        }
        values.clear();
        values.extend(numbers(&row.command_rad).map(|v| v.filter(|_| row.torque)));
        for part in [&row.servos.pos_rad, &row.servos.vel_radps, &row.servos.current_a] {
            values.extend(numbers(part));
        }
        values.extend(numbers(&[row.servos.supply_v]));
        for part in [&row.imu.gyro_radps, &row.imu.acc_mps2, &row.gravity] {
            values.extend(numbers(part));
        }
        if self.base {
            values.extend(optional(row.truth.base_pos_m.map(|p| p.map(f64::from))));
            values.extend(optional(row.truth.base_quat_wxyz.map(|q| q.map(f64::from))));
        }
        let touches = row.truth.foot_contacts;
        values.extend((0..self.feet).map(|foot| {
            let touches = touches.as_deref()?.get(foot)?;
            Some(f64::from(u8::from(*touches)))
        }));
    }
}

/// The cells of a part that may be missing.
fn optional<const K: usize>(part: Option<[f64; K]>) -> [Option<f64>; K] {
    part.map_or([None; K], |values| values.map(Some))
}
