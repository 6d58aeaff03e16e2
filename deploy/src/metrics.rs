//! What the robot tells Prometheus, each half its own part; the agent shows both on one page.

use caudata_telemetry::{Counter, Histogram, IntGauge};

caudata_telemetry::metrics! {
    /// Metrics of the control loop.
    pub struct RobotMetrics {
        ticks: Counter = "caudata_robot_ticks_total", "Control ticks";
        overruns: Counter = "caudata_control_deadline_missed_total",
            "Control periods skipped because a tick took too long";
        late_readings: Counter = "caudata_robot_late_readings_total",
            "Control ticks without sensor readings in time";
        held_actions: Counter = "caudata_robot_held_actions_total",
            "Actions that were not finite; the last target was held";
        tick_seconds: Histogram = "caudata_robot_tick_seconds", "From waking to the command sent";
        policy_version: IntGauge = "caudata_robot_policy_version", "Version of the policy that runs";
        armed: IntGauge = "caudata_robot_policy_waiting", "1 while a newer policy waits for a safe moment";
    }
}

caudata_telemetry::metrics! {
    /// Metrics of the agent.
    pub struct AgentMetrics {
        refused: Counter = "caudata_robot_policies_refused_total", "Policies that must not run on this robot";
        stale: IntGauge = "caudata_robot_policy_stale",
            "1 where no policy server proved for ten minutes that what runs is the newest";
    }
}
