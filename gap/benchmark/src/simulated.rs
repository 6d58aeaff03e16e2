//! A robot that is recorded in the Rapier engine: on a stand by joint sensors alone, on the ground and in
//! water with IMU and motion capture.

use std::path::Path;
use std::sync::Arc;

use caudata_gap::excite;
use caudata_gap::plant::carry;
use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{BaseHold, LogMeta, LogWriter, Payload, Setting};
use caudata_sim::LaneParams;

use crate::battery::RATE_HZ;
use crate::generate::GenerateError;
use crate::truth::free::{self, Beginning, Channels, Session};

/// A robot on the day of `seed`.
#[derive(Clone, Copy, Debug)]
pub struct Robot<'a> {
    /// What its lab takes it for.
    pub lab: &'a RobotModel,
    /// What it is built like.
    pub model: &'a Arc<RobotModel>,
    /// Its physics.
    pub lane: &'a LaneParams,
    /// Day: friction, noise, supply.
    pub seed: u64,
    /// Known weights that are fastened to it, and noted in the log.
    pub payload: &'a [Payload],
}

/// Records a trial of the battery into the log folder `dir`. `run` counts the recordings of the day: each has
/// its own friction and noise.
pub fn record(
    robot: &Robot<'_>,
    trial: &excite::Trial,
    run: u64,
    dir: &Path,
) -> Result<(), GenerateError> {
    let free = trial.base != BaseHold::Fixed;
    let channels = Channels {
        imu: free && robot.model.sensors().imu.is_some(),
        mocap: free,
    };
    rows(
        robot,
        &trial.commands_rad,
        trial.base.into(),
        channels,
        run,
        dir,
    )
}

/// The same of any commands, a row each 10 ms.
pub(crate) fn rows(
    robot: &Robot<'_>,
    rows_rad: &[Vec<f64>],
    begins: Beginning,
    channels: Channels,
    run: u64,
    dir: &Path,
) -> Result<(), GenerateError> {
    let &Robot {
        lab,
        model,
        lane,
        seed,
        payload,
    } = robot;
    let mut session = Session::of_the_day(model, lane, begins.place, seed, run);
    carry(model, payload, &mut session.lane);
    let key = Key {
        seed,
        actor: 13,
        env: run,
        episode: 0,
    };
    let mut stream = Stream::new(key, Purpose::Sensor);
    let log = free::run(model, &session, rows_rad, channels, begins, &mut stream)?;
    let mut meta = LogMeta::new(lab.name(), begins.place, RATE_HZ);
    meta.terrain = match begins.place {
        BaseHold::Water => "deep_water",
        BaseHold::Free => "flat",
        BaseHold::Fixed => "stand",
    }
    .to_owned();
    if begins.place == BaseHold::Water {
        let level = Setting::Number(free::WATER_LEVEL_M);
        meta.settings.insert("water_level_m".to_owned(), level);
    }
    meta.kp = lab.common_gains().map(|g| g.kp_nm_per_rad);
    meta.kd = lab.common_gains().map(|g| g.kd_nm_s_per_rad);
    meta.payload = payload.to_vec();
    meta.supply_v = Some((f64::from(session.lane.supply_v) * 10.0).round() / 10.0);
    let mut writer = LogWriter::create(dir, &free::signals(model, channels), &meta)?;
    for (t, row) in &log {
        writer.row(*t, row)?;
    }
    Ok(writer.finish()?)
}
