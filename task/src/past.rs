//! What a policy sees of the past: earlier observations behind the present one.
//!
//! How heavy a robot is, how much its feet slip and how late its servos are shows in what came of earlier
//! actions, and in no single observation.

use std::ops::Range;

use crate::{ObservationLayout, TaskError};

/// Lays earlier observations of a layout behind the present one.
#[derive(Clone, Debug)]
pub struct Recall {
    ages: Vec<usize>,
    /// What is kept of an observation.
    kept: Vec<Range<usize>>,
    /// Values of that.
    width: usize,
    present: usize,
}

impl Recall {
    /// For observations of this layout.
    pub fn new(layout: &ObservationLayout) -> Self {
        let kept: Vec<_> = layout.recalled().collect();
        Self {
            ages: layout.past().iter().map(|age| *age as usize).collect(),
            width: kept.iter().map(Range::len).sum(),
            kept,
            present: layout.present_dim(),
        }
    }

    /// Values of an observation that are of the present.
    pub fn present_dim(&self) -> usize {
        self.present
    }

    /// Length of the memory of one robot: what is kept of each observation, newest first.
    pub fn memory_len(&self) -> usize {
        self.ages.last().map_or(0, |age| (age + 1) * self.width)
    }

    /// Takes the present observation, with which `seen` begins, into `memory`, and writes the earlier ones behind
    /// it. `fresh`: there are none, and the present one stands for them.
    ///
    /// # Errors
    /// [`TaskError::Shape`] when a length is wrong; nothing is written then.
    pub fn write(
        &self,
        fresh: bool,
        seen: &mut [f32],
        memory: &mut [f32],
    ) -> Result<(), TaskError> {
        let width = self.width;
        for (what, found, expected) in [
            ("observation", seen.len(), self.present + self.ages.len() * width),
            ("memory", memory.len(), self.memory_len()),
        ] {
            if found != expected {
                return Err(TaskError::Shape { what, found, expected });
            }
        }
        let Some(&oldest) = self.ages.last() else { return Ok(()) };
        let (present, past) = seen.split_at_mut(self.present);
        memory.copy_within(..oldest * width, width);
        let mut at = 0;
        for range in &self.kept {
            memory[at..at + range.len()].copy_from_slice(&present[range.clone()]);
            at += range.len();
        }
        if fresh {
            (1..=oldest).for_each(|age| memory.copy_within(..width, age * width));
        }
        for (i, age) in self.ages.iter().enumerate() {
            past[i * width..][..width].copy_from_slice(&memory[age * width..][..width]);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::Wanted;

    fn layout(past: &[u32]) -> Result<ObservationLayout, TaskError> {
        let term = |name, history| Wanted { name, value: None, history };
        let terms = [term("medium", Some(2)), term("command", None), term("actions", None)];
        ObservationLayout::of(&terms, &["hip".to_owned()], &[])?.with_past(past)
    }

    #[test]
    fn earlier_observations_by_hand() {
        let layout = layout(&[1, 3]).unwrap();
        // medium twice, three of the command, three actions of one joint; behind them, twice, the newest medium
        // and action
        assert_eq!((layout.present_dim(), layout.dim()), (8, 12));
        let recall = Recall::new(&layout);
        let mut memory = vec![f32::NAN; recall.memory_len()];
        let mut seen = [f32::NAN; 12];
        let mut see = |t: f32, fresh| {
            seen[..8].copy_from_slice(&[t, t - 1.0, 9.0, 9.0, 9.0, 10.0 * t, 0.0, 0.0]);
            recall.write(fresh, &mut seen, &mut memory).unwrap();
            seen[8..].to_vec()
        };
        assert_eq!(see(1.0, true), [1.0, 10.0, 1.0, 10.0]);
        assert_eq!(see(2.0, false), [1.0, 10.0, 1.0, 10.0]);
        assert_eq!(see(3.0, false), [2.0, 20.0, 1.0, 10.0]);
        assert_eq!(see(4.0, false), [3.0, 30.0, 1.0, 10.0]);
        assert_eq!(see(5.0, false), [4.0, 40.0, 2.0, 20.0]);
        assert_eq!(see(6.0, true), [6.0, 60.0, 6.0, 60.0]);
        assert!(recall.write(true, &mut seen[..11], &mut memory).is_err());
        assert!(recall.write(true, &mut seen, &mut memory[1..]).is_err());
    }

    #[test]
    fn one_observation_begins_with_another() {
        let [none, one, two] = [&[][..], &[2], &[2, 4]].map(|past| layout(past).unwrap());
        assert!(two.begins_with(&one) && two.begins_with(&none) && two.begins_with(&two));
        assert!(!one.begins_with(&two) && !layout(&[1, 2]).unwrap().begins_with(&one));
        let feet = [];
        let wide = ObservationLayout::new(1, &feet, true).with_past(&[2]).unwrap();
        let narrow = ObservationLayout::new(1, &feet, false);
        assert!(wide.begins_with(&narrow));
        assert!(!wide.begins_with(&narrow.with_past(&[2]).unwrap()));
    }

    #[test]
    fn ages_out_of_order_or_bounds_are_refused() {
        for past in [&[0][..], &[2, 2], &[3, 1], &[65], &(1..=17).collect::<Vec<_>>()] {
            let error = layout(past).unwrap_err().to_string();
            assert!(error.contains("task.observation 'past'"), "{error}");
        }
    }
}
