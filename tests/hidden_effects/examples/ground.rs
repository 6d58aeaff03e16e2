//! Writes cases of the salamander on the ground: `ground OUT`.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use caudata_hidden_effects::ground::{self, GroundPlan, OnGround};
use caudata_hidden_effects::truth::free::Channels;
fn main() {
    let out = std::path::PathBuf::from(std::env::args().nth(1).unwrap());
    let all = Channels { imu: true, mocap: true };
    let plans = [
        ("ground_null", OnGround::Nothing, all),
        ("play_hind_x_4deg", OnGround::Play { hinge: 2, half_width_deg: 4.0 }, all),
        ("play_hind_x_joints_only", OnGround::Play { hinge: 2, half_width_deg: 4.0 }, Channels { imu: false, mocap: false }),
        ("slippery", OnGround::Friction(0.5), all),
        ("payload_0.4kg", OnGround::Payload(0.4), all),
    ];
    for (i, (name, hidden, channels)) in plans.into_iter().enumerate() {
        let now = std::time::Instant::now();
        let plan = GroundPlan { name: name.to_owned(), hidden, channels, seed: 300 + i as u64, repeats: 2 };
        let answer = ground::make(&plan, &out).unwrap();
        println!("{name} {:?} {:.1} s", answer.effects.iter().map(|e| (&e.effect, &e.joint)).collect::<Vec<_>>(), now.elapsed().as_secs_f64());
    }
}
