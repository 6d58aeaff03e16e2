//! Changes of the task while a run goes on, from a learner to the actors in its process.

use std::sync::Arc;

use caudata_task::TaskConfig;
use parking_lot::Mutex;

/// A task, and the first policy version that acts under it.
type From = (u64, Arc<TaskConfig>);

/// The tasks of a run, each with the first policy version that acts under it. Cloning shares it. At most one
/// for each change of a run.
#[derive(Clone, Debug, Default)]
pub struct Retunes(Arc<Mutex<Vec<From>>>);

impl Retunes {
    /// From policy `version` on it is this task.
    pub fn add(&self, version: u64, task: TaskConfig) {
        let mut all = self.0.lock();
        all.retain(|(from, _)| *from < version);
        all.push((version, Arc::new(task)));
    }

    /// The task under which `version` acts, if it is another than the configured one.
    pub(crate) fn under(&self, version: u64) -> Option<Arc<TaskConfig>> {
        let all = self.0.lock();
        let until = all.iter().rfind(|(from, _)| *from <= version);
        until.map(|(_, task)| Arc::clone(task))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_version_acts_under_the_newest_task_up_to_it() {
        let task = |zero_share| {
            let mut task = TaskConfig::default();
            task.command.zero_share = zero_share;
            task
        };
        let retunes = Retunes::default();
        assert!(retunes.under(9).is_none());
        retunes.add(3, task(0.3));
        retunes.add(5, task(0.4));
        retunes.add(5, task(0.5));
        let share = |version| retunes.under(version).map(|task| task.command.zero_share);
        assert_eq!([2, 3, 4, 5, 9].map(share), [None, Some(0.3), Some(0.3), Some(0.5), Some(0.5)]);
    }
}
