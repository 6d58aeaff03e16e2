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
/// Robot file, place, name, what is hidden, what is recorded.
type Case = (LabFile, BaseHold, (&'static str, Hides, Channels));

fn cases() -> Vec<Case> {
    let all = Channels {
        imu: true,
        mocap: true,
    };
    let plans = [
        ("ground_null", Hides::Nothing, all),
        (
            "play_hind_x_4deg",
            Hides::Play {
                hinge: 2,
                half_width_deg: 4.0,
            },
            all,
        ),
        (
            "play_hind_x_joints_only",
            Hides::Play {
                hinge: 2,
                half_width_deg: 4.0,
            },
            Channels {
                imu: false,
                mocap: false,
            },
        ),
        ("slippery", Hides::Friction(0.5), all),
        ("payload_0.4kg", Hides::Payload(0.4), all),
        ("weak_leg", Hides::WeakLeg(0.5), all),
        (
            "paper",
            Hides::Paper {
                half_width_deg: 4.0,
                low_pass_s: 0.03,
                torque: 0.7,
            },
            all,
        ),
    ];
    let worn = Hides::Play {
        hinge: 2,
        half_width_deg: 10.0,
    };
    let shipped = [
        ("shipped_null", Hides::Nothing, all),
        ("shipped_weak_leg", Hides::WeakLeg(0.4), all),
        ("shipped_slippery", Hides::Friction(0.4), all),
        ("shipped_worn_girdle", worn, all),
    ];
    let swims = [
        ("water_null", Hides::Nothing, all),
        ("water_drag", Hides::Drag(1.6), all),
        ("water_linear_drag", Hides::LinearDrag(60.0), all),
        ("water_added_mass", Hides::AddedMass(0.8), all),
        ("water_buoyancy", Hides::Buoyancy(1.12), all),
        ("water_buoyancy_centre", Hides::BuoyancyCentre(0.01), all),
        ("water_heave", Hides::Heave(2.0), all),
        ("water_current", Hides::Current(0.12), all),
        ("water_weak_leg", Hides::WeakLeg(0.5), all),
        ("water_null_again", Hides::Nothing, all),
    ];
    (plans
        .map(|p| (LabFile::Stiff, BaseHold::Free, p))
        .into_iter())
    .chain(shipped.map(|p| (LabFile::AsShipped, BaseHold::Free, p)))
    .chain(swims.map(|p| (LabFile::Stiff, BaseHold::Water, p)))
    .collect()
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
    for (i, (lab, place, (name, hidden, channels))) in cases().into_iter().enumerate() {
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
            channels,
            seed: first_seed + i as u64,
            repeats: 2,
        };
        let answer = salamander::make(&plan, &out, &|| true).unwrap();
        println!(
            "{name} {:?} {:.1} s",
            answer
                .effects
                .iter()
                .map(|e| (&e.effect, &e.joint))
                .collect::<Vec<_>>(),
            now.elapsed().as_secs_f64()
        );
    }
}
