//! Making a case: a lab's robot with its nuisances, the effect at the size asked for, the runs, the folder.

use std::fs;
use std::path::Path;

use caudata_model::RobotModel;
use caudata_runlog::{BaseHold, LogMeta, LogWriter};

use crate::battery::{self, Amount, RATE_HZ, Trial};
use crate::case::{Answer, Block, TrueEffect, TrueValue};
use crate::decoy::Decoy;
use crate::file::at;
use crate::hidden::{Hidden, OUTSIDE, Scope, World};
use crate::lab::{FIRST_HELD_OUT, HELD_OUT, LAWS, SIGNS, run, stream};
use crate::sets::{Plan, below, between};
use crate::sizing::{detectability, size_for};
use crate::truth::sensors::Row;
use crate::truth::spec::IMPACT_LOSS_S_PER_RAD;

pub use crate::lab::{GenerateError, Rig, lab};
pub use crate::sizing::{NullView, null_view};

/// One run before it is written.
struct Run {
    folder: String,
    rows: Vec<Row>,
    meta: LogMeta,
}

/// Makes the case of a bench rig called `name` under `parent` and returns its answer.
pub fn make(name: &str, request: &Plan, parent: &Path) -> Result<Answer, GenerateError> {
    let rig = &Rig::bench(request.rig)?;
    let model = &rig.model;
    let seed = request.seed;
    let full_fit = battery::fit(model, request.amount);
    let trials =
        if request.block == Block::Starved { battery::starved(model) } else { full_fit.clone() };
    let mut world = lab(model, seed);
    let mut effects = Vec::new();
    let mut together_d = 0.0;
    if !request.effects.is_empty() || request.other_laws {
        // d is measured on the whole battery also for starved cases: the effect is there, the data do not
        // show it
        let view = null_view(rig, &full_fit, seed)?;
        let mut signs = stream(seed, SIGNS, 0);
        if request.other_laws {
            other_laws((request.seed, rig), &mut world, &full_fit, &view)?;
        }
        for &(hidden, joint, d) in &request.effects {
            let sign = if hidden.signed && signs.chance(0.5) { -1.0 } else { 1.0 };
            let (size, reached) = size_for(rig, hidden, joint, sign, d, &full_fit, &view, seed)?;
            hidden.apply(&mut world, model, joint, sign * size);
            effects.push((hidden, joint, sign * size, reached));
        }
        together_d = match effects.as_slice() {
            [] => 0.0,
            [(_, _, _, d)] => *d,
            _ => detectability(rig, &world, &full_fit, &view, seed)?,
        };
    }
    let (fit, holdout) = runs((request, rig), &world, &trials)?;
    write(rig, &world, &parent.join(name), &fit, &holdout)?;
    let decoy = request.decoy;
    let ids: Vec<&str> = effects.iter().map(|e| e.0.id).collect();
    Ok(Answer {
        case: name.to_owned(),
        block: request.block,
        rig: rig.name.clone(),
        seed,
        target_d: request.effects.first().map_or(0.0, |e| e.2),
        together_d,
        effects: effects
            .iter()
            .map(|&(h, j, size, d)| true_effect(h, j, size, d, &world, model, &ids))
            .collect(),
        without: request.without.clone(),
        decoy: decoy.map_or(String::new(), |d| d.name().to_owned()),
        fault: decoy.is_some_and(Decoy::is_fault),
        fault_kinds: decoy
            .map_or(Vec::new(), |d| d.kinds().iter().map(|k| (*k).to_owned()).collect()),
    })
}

/// What a robot of another maker has: bristles, windings, a bridge and a loop of its own, teeth that give back
/// 0.15 to 0.85 of a blow, a gear that bends by less than anybody sees, friction that grows with another load, and
/// up to two laws that no catalogue has, from what nobody sees to a little more than a careful lab's differences.
fn other_laws(
    (seed, rig): (u64, &Rig),
    world: &mut World,
    trials: &[Trial],
    view: &NullView,
) -> Result<(), GenerateError> {
    let mut s = stream(seed, LAWS, 0);
    for p in &mut world.spec.joints {
        p.presliding_rad *= between(&mut s, -0.7, 0.7).exp();
        // no shorter than the truth's step can follow
        p.inductance_s = between(&mut s, 0.0003, 0.0006);
        p.duty_steps = [255.0, 885.0, 1023.0, 2047.0][below(&mut s, 4)];
        p.loop_delay_s += between(&mut s, 0.0, 0.0004);
        p.impact_loss_s_per_rad = 2.0 * IMPACT_LOSS_S_PER_RAD * between(&mut s, 0.15, 0.85);
        if s.chance(0.5) {
            p.gear_nm_per_rad = 1000.0 * between(&mut s, 0.0, 1.6).exp();
        }
        if s.chance(0.5) {
            p.load_of_motor = 1.0;
        }
    }
    for _ in 0..below(&mut s, 3) {
        let law = &OUTSIDE[below(&mut s, OUTSIDE.len())];
        let joint = below(&mut s, world.spec.joints.len());
        let d = between(&mut s, 0.2, 1.5);
        match size_for(rig, law, joint, 1.0, d, trials, view, seed) {
            Ok((size, _)) => law.apply(world, &rig.model, joint, size),
            Err(GenerateError::TooSmall { .. } | GenerateError::Diverged(_)) => {}
            Err(e) => return Err(e),
        }
    }
    Ok(())
}

fn true_effect(
    h: &Hidden,
    joint: usize,
    size: f64,
    d: f64,
    world: &World,
    model: &RobotModel,
    hidden: &[&str],
) -> TrueEffect {
    let joints = model.actuated().len();
    let same = if joints == 1 { h.equivalent.0 } else { h.equivalent.1 };
    let beside = h.same_beside(joints, hidden).into_iter();
    TrueEffect {
        effect: h.id.to_owned(),
        layer: h.layer.to_owned(),
        joint: if h.scope == Scope::Joint {
            model.actuated_names()[joint].to_owned()
        } else {
            String::new()
        },
        size,
        d,
        equivalent: same.iter().map(|s| (*s).to_owned()).collect(),
        equivalent_beside: beside.map(|(a, b)| (a.to_owned(), b.to_owned())).collect(),
        parameters: h
            .truth(world, model, joint)
            .into_iter()
            .map(|p| TrueValue {
                names: p.names.iter().map(|s| (*s).to_owned()).collect(),
                unit: p.unit.to_owned(),
                value: p.value,
                nominal: p.nominal,
            })
            .collect(),
    }
}

/// All runs of a case: fit with repeats, hold-out with repeats.
fn runs(
    (request, rig): (&Plan, &Rig),
    world: &World,
    trials: &[Trial],
) -> Result<(Vec<Run>, Vec<Run>), GenerateError> {
    let seed = request.seed;
    let repeats = match request.amount {
        Amount::Short => 2,
        Amount::Full => 3,
    };
    let plain = lab(&rig.model, seed);
    let fit_world = if request.block == Block::HoldoutChange { &plain } else { world };
    let mut fit = Vec::new();
    for (i, trial) in trials.iter().enumerate() {
        for r in 0..repeats {
            let index = 10 * i as u64 + r;
            fit.push(one_run((request, rig), fit_world, trial, index, "fit", r)?);
        }
    }
    let mut s = stream(seed, HELD_OUT, 0);
    let mut holdout = Vec::new();
    for (i, trial) in battery::holdout(&rig.model, request.amount, &mut s).iter().enumerate() {
        for r in 0..2 {
            let index = FIRST_HELD_OUT + 10 * i as u64 + r;
            holdout.push(one_run((request, rig), world, trial, index, "holdout", r)?);
        }
    }
    Ok((fit, holdout))
}

fn one_run(
    (request, rig): (&Plan, &Rig),
    world: &World,
    trial: &Trial,
    index: u64,
    role: &str,
    repeat: u64,
) -> Result<Run, GenerateError> {
    let decoy = request.decoy;
    let mut world = world.clone();
    if let Some(d) = decoy {
        d.change_world(&mut world);
    }
    let touch = decoy.and_then(|d| d.touch(role, trial, repeat));
    let (_, mut rows, day) = run(rig, &world, trial, request.seed, index, touch)?;
    if let Some(d) = decoy {
        d.change_rows(&mut rows, rig.model.actuated().len());
    }
    let mut meta = LogMeta::new(rig.name.clone(), BaseHold::Fixed, RATE_HZ);
    meta.terrain = "stand".to_owned();
    let gains = rig.model.common_gains();
    let declared = decoy.and_then(Decoy::declared_kp);
    meta.kp = declared.or(gains.map(|g| g.kp_nm_per_rad));
    meta.kd = gains.map(|g| g.kd_nm_s_per_rad);
    let supply = day.declared_supply_v.unwrap_or(day.spec.supply_v);
    meta.supply_v = Some((supply * 10.0).round() / 10.0);
    meta.notes = format!("{} {}", trial.name, repeat + 1);
    Ok(Run { folder: format!("{role}_{}_{}", trial.name, repeat + 1), rows, meta })
}

fn write(
    rig: &Rig,
    world: &World,
    folder: &Path,
    fit: &[Run],
    holdout: &[Run],
) -> Result<(), GenerateError> {
    fs::create_dir_all(folder).map_err(at(folder))?;
    let robot = folder.join(format!("{}.robot.toml", rig.name));
    fs::write(&robot, &rig.robot_toml).map_err(at(&robot))?;
    let mjcf = folder.join(&rig.mjcf.0);
    fs::write(&mjcf, &rig.mjcf.1).map_err(at(&mjcf))?;
    let signals = world.sensing.signals(&rig.model);
    for run in fit.iter().chain(holdout) {
        let mut log = LogWriter::create(&folder.join(&run.folder), &signals, &run.meta)?;
        for (t, row) in &run.rows {
            log.row(*t, row)?;
        }
        log.finish()?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::truth::Spec;

    #[test]
    fn gains_that_follow_the_supply_are_no_other_gains_once_it_changes() {
        let rig = Rig::bench("pendulum").unwrap();
        let trials = battery::fit(&rig.model, Amount::Short);
        let mut view = null_view(&rig, &trials, 3).unwrap();
        let mut follows = lab(&rig.model, 3);
        follows.spec.gain_follows_supply = true;
        follows.spec.supply_v = 10.0;
        let mut fixed = lab(&rig.model, 3);
        fixed.spec.supply_v = 10.0;
        let mut apart = |drained_v: f64| {
            follows.drained_v = drained_v;
            fixed.drained_v = drained_v;
            // four runs at 0, 1, 2 and 3 fourths of what is drained
            let share = (10.0 - 0.375 * drained_v) / fixed.spec.reference_v;
            let nominal = Spec::nominal(&rig.model);
            for (p, n) in fixed.spec.joints.iter_mut().zip(&nominal.joints) {
                p.kp_nm_per_rad = share * n.kp_nm_per_rad;
                p.kd_nms_per_rad = share * n.kd_nms_per_rad;
                p.feed_forward_vs_per_rad = share * n.feed_forward_vs_per_rad;
            }
            view.rows = (trials.iter().enumerate())
                .map(|(i, t)| run(&rig, &follows, t, 3, 10 * i as u64, None).unwrap().1)
                .collect();
            detectability(&rig, &fixed, &trials, &view, 3).unwrap()
        };
        // ± 0.4 V from run to run are there in any case
        let (steady, drained) = (apart(0.0), apart(4.0));
        assert!(steady < 0.8 && drained > 1.0 && drained > 2.0 * steady, "{steady} {drained}");
    }
}
