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
    let channels = Channels { imu: free && robot.model.sensors().imu.is_some(), mocap: free };
    rows(robot, &trial.commands_rad, trial.base.into(), channels, run, dir)
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
    let &Robot { lab, model, lane, seed, payload } = robot;
    let mut session = Session::of_the_day(model, lane, begins.place, seed, run);
    carry(model, payload, &mut session.lane);
    let key = Key { seed, actor: 13, env: run, episode: 0 };
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

#[cfg(test)]
mod tests {
    use caudata_runlog::{RunLog, Signal};

    use super::*;

    #[test]
    fn a_weight_hangs_on_the_robot_and_stands_in_its_log() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/rigs/pendulum.robot.toml");
        let model = Arc::new(RobotModel::load(file.as_ref()).unwrap());
        let trial = excite::trial(&model, "holds", None, RATE_HZ).unwrap();
        let weight = Payload { link: "arm".to_owned(), mass_kg: 0.2, at_m: [0.0, 0.0, -0.13] };
        let folder = tempfile::tempdir().unwrap();
        let recorded = |name: &str, payload: &[Payload]| {
            let dir = folder.path().join(name);
            let robot = Robot {
                lab: &model,
                model: &model,
                lane: &LaneParams::nominal(&model),
                seed: 5,
                payload,
            };
            record(&robot, &trial, 0, &dir).unwrap();
            RunLog::read(&dir).unwrap()
        };
        let weights = [weight];
        let (bare, loaded) = (recorded("bare", &[]), recorded("loaded", &weights));
        assert!(bare.meta.payload.is_empty());
        assert_eq!(loaded.meta.payload, weights);
        let angle = |log: &RunLog| -> Vec<f64> {
            let column = log.table.column(&Signal::Position("swing".to_owned()));
            column.unwrap().iter().map(|x| x.unwrap()).collect()
        };
        let (mut along, mut square) = (0.0, 0.0);
        for (k, (a, b)) in angle(&bare).iter().zip(angle(&loaded)).enumerate() {
            let up = trial.commands_rad[k][0].sin();
            along += up * (a - b);
            square += up * up;
        }
        // it sags by m·g·l·sin/kp: 0.2·9.81·0.13/15
        let sag_rad = along / square;
        assert!((sag_rad / 0.017 - 1.0).abs() < 0.2, "{sag_rad}");
    }
}
