//! A policy that is learnt from: what it would have done wherever the one that is trained got to.

use std::path::Path;

use caudata_actor::Network;
use caudata_policy::MlpSpec;
use caudata_task::layout::Slice;
use caudata_task::{Critic, ObservationLayout, PolicyContract};

use crate::LearnerError;
use crate::batch::Batch;
use crate::warm_start::read;

/// The policy of a file, for the rows of a batch.
#[derive(Debug)]
pub struct Teacher {
    network: Network,
    /// Where in a row each value lies that it sees.
    columns: Vec<usize>,
    seen: Vec<f32>,
}

impl Teacher {
    /// The policy at `path`, for rows of observations of `contract` with the view of `critic` behind each.
    ///
    /// # Errors
    /// [`LearnerError::Read`] and [`LearnerError::Policy`] for what is no policy file, [`LearnerError::Unfit`]
    /// for one whose actions mean something else here, or which sees what the rows have not.
    pub fn load(
        path: &Path,
        contract: &PolicyContract,
        critic: &Critic,
    ) -> Result<Self, LearnerError> {
        let file = read(path)?;
        let theirs = &file.metadata().contract;
        let alike = theirs.joint_names == contract.joint_names
            && theirs.nominal_pos_rad == contract.nominal_pos_rad
            && theirs.control_period_s == contract.control_period_s
            && theirs.action == contract.action;
        let columns = match alike {
            true => columns(&theirs.observation, &contract.observation, critic)
                .ok_or("sees what is neither in this task's observation nor in task.critic.sees"),
            false => Err("is for other joints, or its actions mean something else"),
        };
        let columns = columns.map_err(|reason| LearnerError::Unfit {
            role: "teacher",
            path: path.to_owned(),
            reason: format!("it {reason}"),
        })?;
        Ok(Self::new(file.spec(), columns))
    }

    /// The policy of `spec`, which sees these columns of a row.
    pub fn new(spec: &MlpSpec, columns: Vec<usize>) -> Self {
        Self { network: Network::new(spec, None), columns, seen: Vec::new() }
    }

    /// Its actions for the samples of `batch`, `[B, A]`.
    pub fn actions(&mut self, batch: &Batch) -> Vec<f32> {
        let rows = batch.observations.chunks_exact(batch.obs_dim).take(batch.rows);
        self.seen.clear();
        self.seen.extend(rows.flat_map(|row| self.columns.iter().map(|&at| row[at])));
        let mut actions = vec![0.0; batch.rows * batch.act_dim];
        self.network.run(&self.seen, batch.rows, &mut actions);
        actions
    }
}

/// Where the values of an observation `theirs` lie in one of `own` with the view of `critic` behind it, if they
/// all do.
fn columns(
    theirs: &ObservationLayout,
    own: &ObservationLayout,
    critic: &Critic,
) -> Option<Vec<usize>> {
    if own.begins_with(theirs) {
        return Some((0..theirs.dim()).collect());
    }
    let more = theirs.slices().strip_prefix(own.slices()).filter(|_| theirs.past().is_empty())?;
    let named = |(slice, name): (&Slice, &str)| {
        slice.value.as_deref() == Some(name) && slice.history.is_none()
    };
    let known = more.len() <= critic.names().count() && more.iter().zip(critic.names()).all(named);
    let beyond = own.dim()..own.dim() + theirs.dim() - own.present_dim();
    known.then(|| (0..own.present_dim()).chain(beyond).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_task::critic::CriticConfig;
    use caudata_task::expression::Names;
    use caudata_task::layout::Wanted;

    #[test]
    fn what_a_teacher_sees_lies_in_front_or_behind() {
        let joints = ["hip", "knee"].map(str::to_owned);
        let names = Names { joints: &joints, feet: &[] };
        let layout = |more: &[&str], past: &[u32]| {
            let mut terms = vec![Wanted { name: "gyro", value: None, history: None }];
            let own = |&name| Wanted { name, value: Some(name), history: None };
            terms.extend(more.iter().map(own));
            ObservationLayout::of(&terms, &joints, &[]).unwrap().with_past(past).unwrap()
        };
        let sees = ["velocity", "height"].map(str::to_owned).into();
        let critic = Critic::new(&CriticConfig { sees }, names).unwrap();
        // three of the present, three and three of the past, then velocity (3) and height
        let own = layout(&[], &[1, 2]);
        let of = |more: &[&str], past: &[u32]| columns(&layout(more, past), &own, &critic);
        assert_eq!(of(&[], &[]).unwrap(), [0, 1, 2]);
        assert_eq!(of(&[], &[1]).unwrap(), [0, 1, 2, 3, 4, 5]);
        assert_eq!(of(&["velocity"], &[]).unwrap(), [0, 1, 2, 9, 10, 11]);
        assert_eq!(of(&["velocity", "height"], &[]).unwrap(), [0, 1, 2, 9, 10, 11, 12]);
        for (more, past) in [
            (&["height"][..], &[][..]),
            (&["velocity"], &[1]),
            (&[], &[2]),
            (&["velocity", "height", "torque"], &[]),
        ] {
            assert_eq!(of(more, past), None, "{more:?} {past:?}");
        }
    }
}
