//! The salamander on a stand, by the Rapier engine: trials of the battery, with joint sensors alone.

use std::path::Path;
use std::sync::Arc;

use caudata_gap::excite;
use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{BaseHold, LogMeta, LogWriter};
use caudata_sim::LaneParams;

use crate::battery::RATE_HZ;
use crate::generate::GenerateError;
use crate::truth::free::{self, Channels, Session};

/// Records `trial` of the battery for a robot with `lane` on the day of `seed` into the log folder `dir`.
/// `run` counts the recordings of that day: each has its own friction and noise.
///
/// # Errors
/// [`GenerateError`].
pub fn record(
    model: &Arc<RobotModel>,
    lane: &LaneParams,
    trial: &str,
    seed: u64,
    run: u64,
    dir: &Path,
) -> Result<(), GenerateError> {
    let channels = Channels {
        imu: false,
        mocap: false,
    };
    let made = excite::trial(model, trial, None, RATE_HZ)?;
    let session = Session::of_the_day(model, lane, BaseHold::Fixed, seed, run);
    let key = Key {
        seed,
        actor: 13,
        env: run,
        episode: 0,
    };
    let mut stream = Stream::new(key, Purpose::Sensor);
    let rows = &made.commands_rad;
    let log = free::run(
        model,
        &session,
        rows,
        channels,
        BaseHold::Fixed.into(),
        &mut stream,
    )?;
    let mut meta = LogMeta::new(model.name(), BaseHold::Fixed, RATE_HZ);
    meta.kp = model.common_gains().map(|g| g.kp_nm_per_rad);
    meta.kd = model.common_gains().map(|g| g.kd_nm_s_per_rad);
    meta.supply_v = Some((f64::from(session.lane.supply_v) * 10.0).round() / 10.0);
    let mut writer = LogWriter::create(dir, &free::signals(model, channels), &meta)?;
    for (t, row) in &log {
        writer.row(*t, row)?;
    }
    writer.finish()?;
    Ok(())
}
