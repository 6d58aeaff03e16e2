//! Writes cases of the salamander, `salamander OUT [--seed N] [NAME…]`; the robot that each comes from goes
//! to `OUT/truth/NAME.robot.toml`.
//!
//! Those whose names begin with `shipped_` come with the robot file of this repository, in which policies are
//! trained, and are for `caudata adapt`; the others with one of stiff girdles. `water_…` swim, the others
//! walk.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use caudata_gap_benchmark::salamander::{self, Hides, LabFile, SalamanderPlan};
use caudata_gap_benchmark::truth::free::Channels;
use caudata_runlog::BaseHold;
/// Robot file, place, name, what is hidden.
type Case = (LabFile, BaseHold, (&'static str, Hides));

fn cases() -> Vec<Case> {
    let play = |half_width_deg| Hides::Play { hinge: 2, half_width_deg };
    let paper = Hides::Paper { half_width_deg: 4.0, low_pass_s: 0.03, torque: 0.7 };
    let walks = [
        ("ground_null", Hides::Nothing),
        ("play_hind_x_4deg", play(4.0)),
        ("play_hind_x_joints_only", play(4.0)),
        ("slippery", Hides::Friction(0.5)),
        ("payload_0.4kg", Hides::Payload(0.4)),
        ("weak_leg", Hides::WeakLeg(0.5)),
        ("paper", paper),
    ];
    let shipped = [
        ("shipped_null", Hides::Nothing),
        ("shipped_weak_leg", Hides::WeakLeg(0.4)),
        ("shipped_slippery", Hides::Friction(0.4)),
        ("shipped_worn_girdle", play(10.0)),
    ];
    let swims = [
        ("water_null", Hides::Nothing),
        ("water_drag", Hides::Drag(1.6)),
        ("water_linear_drag", Hides::LinearDrag(60.0)),
        ("water_added_mass", Hides::AddedMass(0.8)),
        ("water_buoyancy", Hides::Buoyancy(1.12)),
        ("water_buoyancy_centre", Hides::BuoyancyCentre(0.01)),
        ("water_heave", Hides::Heave(2.0)),
        ("water_current", Hides::Current(0.12)),
        ("water_weak_leg", Hides::WeakLeg(0.5)),
        ("water_null_again", Hides::Nothing),
    ];
    let walks = walks.map(|case| (LabFile::Stiff, BaseHold::Free, case));
    let shipped = shipped.map(|case| (LabFile::AsShipped, BaseHold::Free, case));
    let swims = swims.map(|case| (LabFile::Stiff, BaseHold::Water, case));
    walks.into_iter().chain(shipped).chain(swims).collect()
}

/// Everything, but for one case what servos report alone.
fn channels_of(name: &str) -> Channels {
    match name {
        "play_hind_x_joints_only" => Channels { imu: false, mocap: false },
        _ => Channels::ALL,
    }
}

fn main() {
    let out = std::path::PathBuf::from(std::env::args().nth(1).unwrap());
    let mut wanted: Vec<String> = std::env::args().skip(2).collect();
    let mut first_seed = 300;
    if let Some(at) = wanted.iter().position(|w| w == "--seed") {
        wanted.remove(at);
        assert!(at < wanted.len(), "--seed needs a number");
        first_seed = wanted.remove(at).parse().expect("a seed");
    }
    let truth = out.join("truth");
    std::fs::create_dir_all(&truth).unwrap();
    let mjcf = salamander::lab_file(LabFile::Stiff).unwrap().1;
    std::fs::write(truth.join("polymander.xml"), mjcf).unwrap();
    for (i, (lab, place, (name, hidden))) in cases().into_iter().enumerate() {
        if !wanted.is_empty() && !wanted.iter().any(|w| w == name) {
            continue;
        }
        let file = truth.join(format!("{name}.robot.toml"));
        std::fs::write(file, salamander::true_salamander(lab, hidden).unwrap()).unwrap();
        let now = std::time::Instant::now();
        let plan = SalamanderPlan {
            name: name.to_owned(),
            file: lab,
            place,
            hidden,
            channels: channels_of(name),
            seed: first_seed + i as u64,
            repeats: 2,
        };
        let answer = salamander::make(&plan, &out, &|| true).unwrap();
        println!(
            "{name} {:?} {:.1} s",
            answer.effects.iter().map(|e| (&e.effect, &e.joint)).collect::<Vec<_>>(),
            now.elapsed().as_secs_f64()
        );
    }
}
