//! What putting a free robot back to its measured state costs, over and over: measured on the simulator
//! itself.
//!
//! A free robot is replayed in short stretches, each from what was measured at its start. Counts, noise, and
//! what nobody measures (how hard each foot presses, where play hangs) make even a perfect model miss. So the
//! model's own long run is taken for a recording, counted and sampled like the real one, and replayed in the
//! same stretches: by how much it misses itself is no fault of a model.

use std::collections::BTreeMap;

use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::BaseHold;

use super::noise::Noise;
use crate::error::GapError;
use crate::replay::{Data, Piece, Replayer, SegmentOptions};
use crate::trial::Kind;

/// So many times its own miss is what a model of a free robot may be off: its misfit is then that of a
/// careful lab on a stand (0.2 to 0.3), so that the same thresholds hold for all. A healthy swimmer that
/// another engine simulates is off by 1.5 to 3.5 times its own miss. On the ground what is not known of its
/// hardness comes on top; with 1.5 and that, two healthy robots of stiff girdles ended as
/// `insufficient_data`.
fn misses_allowed(base: BaseHold) -> f64 {
    match base {
        BaseHold::Water => 2.5,
        BaseHold::Fixed | BaseHold::Free => 2.0,
    }
}

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
    let whole = SegmentOptions { free_s: f64::INFINITY, swimming_s: f64::INFINITY, ..options };
    let long = Data::new(model, data.trials.clone(), whole);
    let own = replayer.predict(&long, &[Vec::new()])?.swap_remove(0);
    let mut trials = data.trials.clone();
    let mut stream = Stream::new(Key::for_run(1), Purpose::Sensor);
    for segment in &long.segments {
        for piece in &segment.pieces {
            let channel = &mut trials[segment.trial].channels[piece.channel];
            let key = (segment.trial, piece.kind, piece.index);
            let jitter = match long.trials[segment.trial].base {
                BaseHold::Water => noise.white.get(&key).copied().unwrap_or(0.0),
                BaseHold::Fixed | BaseHold::Free => quietest(noise, data, segment.trial, piece),
            };
            for k in piece.range.clone() {
                let at = channel.time_s.partition_point(|&t| t < long.time_s[k]);
                if own[k].is_finite() && at < channel.value.len() {
                    channel.value[at] = f64::from(own[k]) + jitter * stream.normal_f64();
                }
            }
        }
    }
    let again = Data::new(model, trials, options);
    let missed = replayer.predict(&again, &[Vec::new()])?.swap_remove(0);
    let mut sums: BTreeMap<(usize, Kind, usize), (f64, f64)> = BTreeMap::new();
    for (s, segment) in again.segments.iter().enumerate() {
        if again.trials[segment.trial].base == BaseHold::Fixed {
            continue;
        }
        for piece in &segment.pieces {
            let entry = sums.entry((again.hold(s), piece.kind, piece.index)).or_default();
            for k in piece.range.clone() {
                let r = again.value[k] - f64::from(missed[k]);
                if r.is_finite() {
                    entry.0 += r * r;
                    entry.1 += 1.0;
                }
            }
        }
    }
    for (s, segment) in data.segments.iter().enumerate() {
        if data.trials[segment.trial].base == BaseHold::Fixed {
            continue;
        }
        let allowed = misses_allowed(data.trials[segment.trial].base);
        for piece in &segment.pieces {
            let Some((sum, n)) = sums.get(&(data.hold(s), piece.kind, piece.index)) else {
                continue;
            };
            let miss = (allowed * (sum / n.max(1.0)).sqrt()) as f32;
            for k in piece.range.clone() {
                noise.grow(k..k + 1, 1.0_f32.hypot(miss / noise.sigma[k]));
            }
        }
    }
    Ok(())
}

/// Noise of the channel of `piece` in a run, from the quietest of its samples in its first stretch that
/// counts. It is more than a sensor adds from sample to sample (no noise is believed to be finer than a
/// millimetre, 0.05 rad/s, …), and on the ground it must be: there it stands for what two engines make of the
/// same contact. With a sensor's own noise, which is enough in water, two healthy robots are 0.9 and 1.9
/// floors off, by how body and tail drag along.
fn quietest(noise: &Noise, data: &Data, trial: usize, piece: &Piece) -> f64 {
    data.segments
        .iter()
        .filter(|s| s.trial == trial)
        .flat_map(|s| &s.pieces)
        .find(|p| p.channel == piece.channel)
        .map_or(0.0, |p| {
            let least = noise.sigma[p.range.clone()].iter().copied();
            f64::from(least.fold(f32::INFINITY, f32::min))
        })
}
