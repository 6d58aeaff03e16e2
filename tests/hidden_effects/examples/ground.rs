//! Writes cases of the salamander on the ground, `ground OUT [NAME…]`; the robot that each comes from goes to `OUT/truth/NAME.robot.toml`.
//!
//! Those whose names begin with `shipped_` come with the robot file of this repository, in which policies are trained, and are for `caudata adapt`; the
//! others with one of stiff girdles.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use caudata_hidden_effects::ground::{self, GroundPlan, LabFile, OnGround};
use caudata_hidden_effects::truth::free::Channels;
fn main() {
    let out = std::path::PathBuf::from(std::env::args().nth(1).unwrap());
    let all = Channels {
        imu: true,
        mocap: true,
    };
    let plans = [
        ("ground_null", OnGround::Nothing, all),
        (
            "play_hind_x_4deg",
            OnGround::Play {
                hinge: 2,
                half_width_deg: 4.0,
            },
            all,
        ),
        (
            "play_hind_x_joints_only",
            OnGround::Play {
                hinge: 2,
                half_width_deg: 4.0,
            },
            Channels {
                imu: false,
                mocap: false,
            },
        ),
        ("slippery", OnGround::Friction(0.5), all),
        ("payload_0.4kg", OnGround::Payload(0.4), all),
        ("weak_leg", OnGround::WeakLeg(0.5), all),
        (
            "paper",
            OnGround::Paper {
                half_width_deg: 4.0,
                low_pass_s: 0.03,
                torque: 0.7,
            },
            all,
        ),
    ];
    let worn = OnGround::Play {
        hinge: 2,
        half_width_deg: 10.0,
    };
    let shipped = [
        ("shipped_null", OnGround::Nothing, all),
        ("shipped_weak_leg", OnGround::WeakLeg(0.4), all),
        ("shipped_slippery", OnGround::Friction(0.4), all),
        ("shipped_worn_girdle", worn, all),
    ];
    let plans = plans
        .map(|p| (LabFile::Stiff, p))
        .into_iter()
        .chain(shipped.map(|p| (LabFile::AsShipped, p)));
    let wanted: Vec<String> = std::env::args().skip(2).collect();
    let truth = out.join("truth");
    std::fs::create_dir_all(&truth).unwrap();
    let mjcf = ground::salamander(LabFile::Stiff).unwrap().1;
    std::fs::write(truth.join("polymander.xml"), mjcf).unwrap();
    for (i, (lab, (name, hidden, channels))) in plans.enumerate() {
        if !wanted.is_empty() && !wanted.iter().any(|w| w == name) {
            continue;
        }
        let file = truth.join(format!("{name}.robot.toml"));
        std::fs::write(file, ground::true_salamander(lab, hidden).unwrap()).unwrap();
        let now = std::time::Instant::now();
        let plan = GroundPlan {
            name: name.to_owned(),
            file: lab,
            hidden,
            channels,
            seed: 300 + i as u64,
            repeats: 2,
        };
        let answer = ground::make(&plan, &out, &|| true).unwrap();
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
