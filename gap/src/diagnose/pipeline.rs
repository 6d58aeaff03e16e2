//! What putting a free robot back to its measured state costs, over and over: measured on the simulator itself.
//!
//! A free robot is replayed in short stretches, each from what was measured at its start. Counts, noise, and what nobody measures (how hard each
//! foot presses, where play hangs) make even a perfect model miss. So the model's own long run is taken for a recording, counted and sampled like
//! the real one, and replayed in the same stretches: by how much it misses itself is no fault of a model.

use std::collections::BTreeMap;

use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::BaseHold;

use super::noise::Noise;
use crate::error::GapError;
use crate::replay::{Data, Replayer, SegmentOptions};
use crate::trial::Kind;

/// So many times its own miss is what a model of a free robot may be off: its misfit is then that of a careful lab on a stand (0.2 to 0.3), so that the same
/// thresholds hold for both.
const MISSES_ALLOWED: f32 = 2.0;

/// Adds the misses of the robot as given against itself to the noise of free and swimming runs.
///
/// # Errors
/// As [`Replayer::predict`].
pub fn add_own_misses(
    replayer: &Replayer,
    data: &Data,
    options: SegmentOptions,
    noise: &mut Noise,
) -> Result<(), GapError> {
    if data.trials.iter().all(|t| t.base == BaseHold::Fixed) {
        return Ok(());
    }
    let model = replayer.model();
    let whole = SegmentOptions {
        free_s: f64::INFINITY,
        ..options
    };
    let long = Data::new(model, data.trials.clone(), whole);
    let own = replayer.predict(&long, &[Vec::new()])?.swap_remove(0);
    let mut trials = data.trials.clone();
    let mut stream = Stream::new(Key::for_run(1), Purpose::Sensor);
    for segment in &long.segments {
        for piece in &segment.pieces {
            let channel = &mut trials[segment.trial].channels[piece.channel];
            for k in piece.range.clone() {
                let at = channel.time_s.partition_point(|&t| t < long.time_s[k]);
                if own[k].is_finite() && at < channel.value.len() {
                    let jitter = sigma_of(noise, data, segment.trial, piece.channel);
                    channel.value[at] = f64::from(own[k]) + jitter * stream.normal_f64();
                }
            }
        }
    }
    let again = Data::new(model, trials, options);
    let missed = replayer.predict(&again, &[Vec::new()])?.swap_remove(0);
    let mut sums: BTreeMap<(Kind, usize), (f64, f64)> = BTreeMap::new();
    for segment in again
        .segments
        .iter()
        .filter(|s| again.trials[s.trial].base != BaseHold::Fixed)
    {
        for piece in &segment.pieces {
            let entry = sums.entry((piece.kind, piece.index)).or_default();
            for k in piece.range.clone() {
                let r = again.value[k] - f64::from(missed[k]);
                if r.is_finite() {
                    entry.0 += r * r;
                    entry.1 += 1.0;
                }
            }
        }
    }
    for segment in data
        .segments
        .iter()
        .filter(|s| data.trials[s.trial].base != BaseHold::Fixed)
    {
        for piece in &segment.pieces {
            let Some((sum, n)) = sums.get(&(piece.kind, piece.index)) else {
                continue;
            };
            let miss = MISSES_ALLOWED * (sum / n.max(1.0)).sqrt() as f32;
            for k in piece.range.clone() {
                noise.grow(k, 1.0_f32.hypot(miss / noise.sigma[k]));
            }
        }
    }
    Ok(())
}

/// Noise of a channel in a run, from the quietest of its samples in its first stretch that counts.
fn sigma_of(noise: &Noise, data: &Data, trial: usize, channel: usize) -> f64 {
    data.segments
        .iter()
        .filter(|s| s.trial == trial)
        .flat_map(|s| &s.pieces)
        .find(|p| p.channel == channel)
        .map_or(0.0, |p| {
            let least = noise.sigma[p.range.clone()].iter().copied();
            f64::from(least.fold(f32::INFINITY, f32::min))
        })
}
