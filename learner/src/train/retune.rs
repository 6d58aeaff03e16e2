//! What a change of settings means to the learner.

use caudata_config::{Change, asked};
use caudata_telemetry::progress::{Changed, Event};

use super::run::Run;
use crate::LearnerError;
use crate::ppo::PpoSettings;

/// The key of the learning rate.
const RATE: &str = "learner.ppo.learning_rate";

impl Run<'_> {
    /// Nobody shall wait for a change that will not come any more.
    pub(super) fn refuse_late_changes(&mut self) {
        for (path, _) in asked(&self.run_dir) {
            self.reporter.warn("a change is refused: the run ends".into());
            if let Err(error) = std::fs::remove_file(&path) {
                tracing::warn!(%error, "cannot remove {}", path.display());
            }
        }
    }

    /// Makes the changes that are due before the next policy goes out.
    pub(super) fn retune(&mut self) -> Result<(), LearnerError> {
        let (iteration, version) = (self.progress.iteration, self.progress.version());
        let reporter = &mut self.reporter;
        let changes = (self.tuning).make(iteration, version, &mut |line| reporter.warn(line))?;
        for change in changes {
            let settings = PpoSettings::new(self.tuning.now());
            // The rate adapts: to be told the one that is configured already sets it back.
            let rate = |set: &String| set.split('=').next().map(str::trim) == Some(RATE);
            if change.set.iter().any(rate) {
                self.ppo.set_learning_rate(settings.ppo.learning_rate);
            }
            self.ppo.set_settings(settings);
            let Change { iteration, set } = change;
            self.reporter.event(&Event::Changed(Changed { iteration, set }));
        }
        Ok(())
    }
}
