//! What policy and value function see of a lane.

use caudata_task::observation::ObservationInput;
use caudata_task::reward::own::StateSignals;

use crate::lane::reward_input;
use crate::measure::Truth;
use crate::{EnvError, VecEnv};

impl VecEnv {
    pub(crate) fn observe_start(&mut self, lane: usize) -> Result<(), EnvError> {
        let truth = self.truth(lane);
        self.observe(lane, &truth, true)
    }

    /// Writes the observation of one lane, with sensor noise; a `fresh` one has no history.
    pub(crate) fn observe(
        &mut self,
        lane: usize,
        truth: &Truth,
        fresh: bool,
    ) -> Result<(), EnvError> {
        let now = &mut self.lanes[lane];
        let readings = &mut self.readings;
        truth.readings(readings);
        for (pos, offset) in readings.joint_pos_rad.iter_mut().zip(&now.joint_offset_rad) {
            *pos += offset;
        }
        if let Some(sensors) = &self.sensors {
            sensors.measure(readings, &now.imu_bias, &mut now.sensor_stream);
        }
        self.task.noise.add(readings, &mut now.sensor_stream);
        let dim = self.layout.dim();
        let input = ObservationInput {
            joint_vel_radps: &readings.joint_vel_radps,
            joint_pos_rad: &readings.joint_pos_rad,
            gyro_radps: readings.gyro_radps,
            gravity: readings.gravity,
            phase_rad: now.phases_rad(),
            command: now.command.value,
            previous_actions: &now.actions,
            medium: Some(truth.afloat),
        };
        let out = &mut self.observations[lane * dim..][..self.recall.present_dim()];
        let more = self.critic.dim();
        if self.sees_truth || more > 0 {
            let (task, joints, body) = (&self.task, &self.joints, &self.body);
            let target_rad = &mut self.target_rad;
            now.filter.unlimited_rad(&task.action, joints, target_rad);
            let state = reward_input(task, joints, body, target_rad, now, truth);
            let signals = StateSignals::new(&state, task.reward.contact_force_n);
            self.observer.write(&input, Some(&signals), fresh, out)?;
            let privileged = &mut self.privileged[lane * more..][..more];
            self.critic.write(&signals, privileged);
        } else {
            self.observer.write(&input, None, fresh, out)?;
        }
        self.add_term_noise(lane);
        let len = self.recall.memory_len();
        let seen = &mut self.observations[lane * dim..][..dim];
        Ok(self.recall.write(fresh, seen, &mut self.memories[lane * len..][..len])?)
    }

    /// Noise of single observation terms, on what is newest of each.
    fn add_term_noise(&mut self, lane: usize) {
        if !self.task.noise.enabled {
            return;
        }
        let dim = self.layout.dim();
        let out = &mut self.observations[lane * dim..][..dim];
        let stream = &mut self.lanes[lane].sensor_stream;
        let terms = self.task.observation.term.iter().zip(self.layout.slices());
        for (term, slice) in terms.filter(|(term, _)| term.noise_std > 0.0) {
            let newest = &mut out[slice.start..][..slice.width()];
            stream.add_bell_noise(newest, term.noise_std);
        }
    }
}
