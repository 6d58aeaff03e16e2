//! When the robot must stop walking by itself: servos that fall silent, alerts, reboots, heat, supply,
//! current, a stale IMU.
//!
//! Pure: one call per tick with what the hardware reports; the verdicts go down the ladder stand → damped.

use caudata_hardware::wiring::Limits;
use serde::{Deserialize, Serialize};

use crate::bus::{Health, ServoReadings};

/// Ticks in a row that a servo may be silent before the robot stands.
pub const SILENT_STAND: u32 = 3;
/// The same, before it is damped.
pub const SILENT_DAMP: u32 = 10;
/// Ticks in a row without a new IMU sample before the robot stands (50 ms are two and a half).
pub const IMU_STALE: u32 = 3;
/// Identical IMU samples in a row that show a sensor that hangs: noise alone changes the last digit.
pub const IMU_FROZEN: u32 = 100;
/// Ticks that supply, heat or current must be out of bounds to count (0.5 s).
pub const DEBOUNCE: u32 = 25;

/// Why the robot stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fault {
    /// A servo does not answer.
    ServoSilent,
    /// A servo latched a hardware error.
    ServoAlert,
    /// A servo has no torque any more: it was restarted, or shut down.
    ServoRestarted,
    /// A servo's bus watchdog has fired.
    WatchdogFired,
    /// The supply is out of bounds.
    Supply,
    /// A servo is too hot.
    Heat,
    /// A joint draws too much for too long.
    Current,
    /// The IMU gives nothing new.
    Imu,
}

/// What to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Go on.
    Fine,
    /// Return to the nominal pose, then let go.
    Stand(Fault),
    /// Brake, then let go.
    Damp(Fault),
}

/// Watches one run.
#[derive(Clone, Debug)]
pub struct Guard {
    limits: Option<Limits>,
    supply_ticks: u32,
    heat_ticks: u32,
    current_ticks: u32,
}

impl Guard {
    /// A guard; without `limits` (a simulated robot has none) supply, heat and current are not judged.
    pub fn new(limits: Option<Limits>) -> Self {
        Self { limits, supply_ticks: 0, heat_ticks: 0, current_ticks: 0 }
    }

    /// Judges one tick; the worst that applies.
    pub fn judge(&mut self, health: &Health, servos: &ServoReadings) -> Verdict {
        if health.watchdog_fired.is_some() {
            return Verdict::Damp(Fault::WatchdogFired);
        }
        // A hardware error switches the servo's torque off: say what it was, not what followed from it.
        if health.restarted.is_some() && health.alert.is_none() {
            return Verdict::Damp(Fault::ServoRestarted);
        }
        if health.silent_ticks >= SILENT_DAMP {
            return Verdict::Damp(Fault::ServoSilent);
        }
        if health.alert.is_some() {
            return Verdict::Stand(Fault::ServoAlert);
        }
        if health.silent_ticks >= SILENT_STAND {
            return Verdict::Stand(Fault::ServoSilent);
        }
        if health.imu_stale_ticks >= IMU_STALE || health.imu_same_ticks >= IMU_FROZEN {
            return Verdict::Stand(Fault::Imu);
        }
        self.judge_limits(health, servos)
    }

    fn judge_limits(&mut self, health: &Health, servos: &ServoReadings) -> Verdict {
        let Some(limits) = &self.limits else { return Verdict::Fine };
        let supply = limits.supply_min_v..=limits.supply_max_v;
        let count = |ticks: &mut u32, out: bool| {
            *ticks = if out { *ticks + 1 } else { 0 };
            *ticks >= DEBOUNCE
        };
        let current_a = servos.current_a.iter().fold(0.0, |m: f32, c| m.max(c.abs()));
        let faults = [
            (count(&mut self.supply_ticks, !supply.contains(&servos.supply_v)), Fault::Supply),
            (
                count(&mut self.heat_ticks, health.hottest_c >= limits.temperature_max_c),
                Fault::Heat,
            ),
            (count(&mut self.current_ticks, current_a > limits.current_max_a), Fault::Current),
        ];
        faults
            .iter()
            .find(|(over, _)| *over)
            .map_or(Verdict::Fine, |(_, fault)| Verdict::Stand(*fault))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn readings() -> ServoReadings {
        ServoReadings {
            time_s: 0.0,
            pos_rad: [0.0; 16].into(),
            vel_radps: [0.0; 16].into(),
            current_a: [0.1; 16].into(),
            supply_v: 12.0,
        }
    }

    fn guard() -> Guard {
        Guard::new(Some(Limits {
            supply_min_v: 10.5,
            supply_max_v: 15.0,
            temperature_max_c: 68,
            current_max_a: 2.0,
        }))
    }

    /// The verdict on one tick of `health`.
    fn on(health: Health) -> Verdict {
        guard().judge(&health, &readings())
    }

    #[test]
    fn silence_goes_down_the_ladder() {
        let silent = |ticks| on(Health { silent_ticks: ticks, ..Health::default() });
        assert_eq!([silent(0), silent(2)], [Verdict::Fine; 2]);
        assert_eq!(silent(3), Verdict::Stand(Fault::ServoSilent));
        assert_eq!(silent(9), Verdict::Stand(Fault::ServoSilent));
        assert_eq!(silent(10), Verdict::Damp(Fault::ServoSilent));
    }

    #[test]
    fn alerts_reboots_and_the_watchdog() {
        let alert = Health { alert: Some((3, 0x20)), ..Health::default() };
        assert_eq!(on(alert), Verdict::Stand(Fault::ServoAlert));
        let restarted = Health { restarted: Some(3), ..Health::default() };
        assert_eq!(on(restarted), Verdict::Damp(Fault::ServoRestarted));
        // An overload switches the torque off by itself: the alert is the cause.
        let both = Health { restarted: Some(3), ..alert };
        assert_eq!(on(both), Verdict::Stand(Fault::ServoAlert));
        let fired = Health { watchdog_fired: Some(0), ..both };
        assert_eq!(on(fired), Verdict::Damp(Fault::WatchdogFired));
    }

    #[test]
    fn a_stale_or_frozen_imu_stands() {
        let imu = |stale, same| {
            on(Health { imu_stale_ticks: stale, imu_same_ticks: same, ..Health::default() })
        };
        assert_eq!([imu(2, 0), imu(0, 99)], [Verdict::Fine; 2]);
        assert_eq!([imu(3, 0), imu(0, 100)], [Verdict::Stand(Fault::Imu); 2]);
    }

    #[test]
    fn supply_heat_and_current_count_after_half_a_second_in_a_row() {
        let mut low = readings();
        low.supply_v = 10.4;
        let mut stalled = readings();
        stalled.current_a[5] = -2.1;
        let hot = Health { hottest_c: 68, ..Health::default() };
        for (health, servos, fault) in [
            (Health::default(), low, Fault::Supply),
            (Health::default(), stalled, Fault::Current),
            (hot, readings(), Fault::Heat),
        ] {
            let mut guard = guard();
            let verdicts: Vec<_> = (0..24).map(|_| guard.judge(&health, &servos)).collect();
            assert!(verdicts.iter().all(|v| *v == Verdict::Fine));
            // One good tick begins anew.
            guard.judge(&Health::default(), &readings());
            for _ in 0..24 {
                assert_eq!(guard.judge(&health, &servos), Verdict::Fine);
            }
            assert_eq!(guard.judge(&health, &servos), Verdict::Stand(fault));
        }
    }
}
