//! What the robot tells Prometheus, each half its own part; the agent shows both on one page.

use caudata_telemetry::{Counter, Histogram, IntGauge, Metrics};

/// Metrics of the control loop.
#[derive(Clone, Debug)]
pub struct RobotMetrics {
    /// Control ticks.
    pub ticks: Counter,
    /// Periods skipped because a tick took too long.
    pub overruns: Counter,
    /// Ticks without readings in time.
    pub late_readings: Counter,
    /// Actions that were not finite.
    pub held_actions: Counter,
    /// From waking to the command sent, s.
    pub tick_seconds: Histogram,
    /// Version that runs.
    pub policy_version: IntGauge,
    /// 1 while a newer policy waits for a safe moment.
    pub armed: IntGauge,
}

/// Metrics of the agent.
#[derive(Clone, Debug)]
pub struct AgentMetrics {
    /// Policies that were refused.
    pub refused: Counter,
    /// 1 where no server proved for long that what runs is the newest.
    pub stale: IntGauge,
}

impl RobotMetrics {
    /// Registers everything.
    pub fn register(metrics: &Metrics) -> Self {
        Self {
            ticks: metrics.counter("caudata_robot_ticks_total", "Control ticks"),
            overruns: metrics.counter(
                "caudata_control_deadline_missed_total",
                "Control periods skipped because a tick took too long",
            ),
            late_readings: metrics.counter(
                "caudata_robot_late_readings_total",
                "Control ticks without sensor readings in time",
            ),
            held_actions: metrics.counter(
                "caudata_robot_held_actions_total",
                "Actions that were not finite; the last target was held",
            ),
            tick_seconds: metrics.seconds(
                "caudata_robot_tick_seconds",
                "From waking to the command sent",
            ),
            policy_version: metrics.int_gauge(
                "caudata_robot_policy_version",
                "Version of the policy that runs",
            ),
            armed: metrics.int_gauge(
                "caudata_robot_policy_waiting",
                "1 while a newer policy waits for a safe moment",
            ),
        }
    }
}

impl AgentMetrics {
    /// Registers everything.
    pub fn register(metrics: &Metrics) -> Self {
        Self {
            stale: metrics.int_gauge(
                "caudata_robot_policy_stale",
                "1 where no policy server proved for ten minutes that what runs is the newest",
            ),
            refused: metrics.counter(
                "caudata_robot_policies_refused_total",
                "Policies that must not run on this robot",
            ),
        }
    }
}
