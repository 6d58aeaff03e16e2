//! The channels of a run's joints.

use caudata_runlog::Signal;

use super::finding::{Finding, Run};
use super::series::smooth;

/// Commands and readings are compared below about 1 Hz, where no lag of a servo turns a sign.
pub(super) const SLOW_S: f64 = 0.35;
/// For comparing readings, over so long a time is smoothed, s.
const FINE_S: f64 = 0.1;

/// What is known of one joint, on the run's grid.
pub(super) struct Channels {
    pub name: String,
    pub index: usize,
    /// What counts as a radian, rad or m.
    pub per_radian: f64,
    /// Unit of its positions: rad or m.
    pub unit: &'static str,
    /// Command, rad; NaN where none is in force.
    pub cmd: Option<Vec<f64>>,
    pub pos: Option<Vec<f64>>,
    pub vel: Option<Vec<f64>>,
    pub cur: Option<Vec<f64>>,
    /// 1 powered, 0 let go.
    pub on: Option<Vec<f64>>,
    /// Command and position below about 1 Hz.
    pub slow_cmd: Option<Vec<f64>>,
    pub slow_pos: Option<Vec<f64>>,
    /// The same, hardly smoothed.
    pub fine_cmd: Option<Vec<f64>>,
    pub fine_pos: Option<Vec<f64>>,
}

impl Channels {
    /// The channels of every actuated joint that the log has, policy order.
    pub fn all(run: &Run<'_>) -> Vec<Self> {
        let table = &run.log.table;
        let (slow, fine) = (run.grid.points(SLOW_S), run.grid.points(FINE_S));
        let names = run.robot.actuated_names();
        names
            .iter()
            .enumerate()
            .filter(|(_, name)| {
                let named = |s: &Signal| s.joint() == Some(**name);
                table.signals().iter().any(named)
            })
            .map(|(index, name)| {
                let own =
                    |of: fn(String) -> Signal| run.grid.linear(table, &of((*name).to_owned()));
                let on = run.grid.held(table, &Signal::Enabled((*name).to_owned()));
                let mut cmd = run.grid.held(table, &Signal::Command((*name).to_owned()));
                if let (Some(cmd), Some(on)) = (&mut cmd, &on) {
                    for (u, &on) in cmd.iter_mut().zip(on) {
                        if on == 0.0 {
                            *u = f64::NAN;
                        }
                    }
                }
                let pos = own(Signal::Position);
                Self {
                    name: (*name).to_owned(),
                    index,
                    per_radian: run.robot.per_radian(index),
                    unit: run.robot.joints()[run.robot.actuated()[index]].unit(),
                    slow_cmd: cmd.as_deref().map(|x| smooth(x, slow)),
                    slow_pos: pos.as_deref().map(|x| smooth(x, slow)),
                    fine_cmd: cmd.as_deref().map(|x| smooth(x, fine)),
                    fine_pos: pos.as_deref().map(|x| smooth(x, fine)),
                    cmd,
                    pos,
                    vel: own(Signal::Velocity),
                    cur: own(Signal::Current),
                    on,
                }
            })
            .collect()
    }

    /// A fault of one of its columns that must be put right first.
    pub fn fatal(&self, kind: &'static str, column: &str, detail: String) -> Finding {
        Finding::fatal(kind, format!("{column}.{}", self.name), detail)
    }

    /// Something worth knowing of one of its columns.
    pub fn note(&self, kind: &'static str, column: &str, detail: String) -> Finding {
        Finding::note(kind, format!("{column}.{}", self.name), detail)
    }
}

/// Those whose angles have no fault. What is wrong with angles would be said again of speed and lag.
pub(super) fn sound<'a>(joints: &'a [Channels], found: &[Finding]) -> Vec<&'a Channels> {
    let at = |j: &Channels, f: &Finding| {
        f.at == format!("pos.{}", j.name) || f.at == format!("cmd.{}", j.name)
    };
    joints.iter().filter(|j| !found.iter().any(|f| f.fatal && at(j, f))).collect()
}
