//! Two policies in one network.

use caudata_task::ObservationLayout;

use super::{FEET, metadata, normals, stream};
use crate::{
    Activation, Dense, MlpSpec, PolicyError, PolicyFile, PolicyMetadata, build_onnx, evaluate_mlp,
    join,
};

const OBS_DIM: usize = 97;
/// Where the default layout has the z component of gravity.
const GRAVITY_Z: usize = 37;

/// Random layers of 8 and as many units between them as asked.
fn file(seed: u64, hidden: &[usize], metadata: &PolicyMetadata) -> PolicyFile {
    let mut stream = stream(seed);
    let obs_dim = metadata.contract.obs_dim();
    let sizes: Vec<usize> =
        [obs_dim].into_iter().chain(hidden.iter().copied()).chain([16]).collect();
    let layers = sizes.windows(2).map(|io| Dense {
        out: io[1],
        input: io[0],
        weight: normals(&mut stream, io[0] * io[1], 0.3),
        bias: normals(&mut stream, io[1], 0.3),
    });
    let spec = MlpSpec {
        layers: layers.collect(),
        obs_mean: normals(&mut stream, obs_dim, 0.2),
        obs_std: (0..obs_dim).map(|i| 0.4 + ((seed as usize + i) % 5) as f32 / 5.0).collect(),
        obs_clip: Some(10.0),
        activation: Activation::Elu,
    };
    PolicyFile::parse(build_onnx(&spec, metadata).unwrap().into()).unwrap()
}

fn actions(policy: &PolicyFile, obs: &[f32]) -> Vec<f32> {
    let mut actions = vec![0.0; 16];
    evaluate_mlp(policy.spec(), obs, 1, &mut actions).unwrap();
    actions
}

#[test]
fn below_it_is_the_one_and_above_the_other() {
    for hidden in [&[12, 9][..], &[12, 9, 7][..]] {
        let (low, high) = (file(1, hidden, &metadata()), file(2, hidden, &metadata()));
        let joined = join(&low, &high, GRAVITY_Z, -0.5).unwrap();
        let mut obs = normals(&mut stream(3), OBS_DIM, 1.0);
        for (gravity_z, acts) in [(-1.0, &low), (-0.8, &low), (-0.2, &high), (1.0, &high)] {
            obs[GRAVITY_Z] = gravity_z;
            let (got, want) = (actions(&joined, &obs), actions(acts, &obs));
            for (got, want) in got.iter().zip(want) {
                assert!((got - want).abs() < 2e-4, "{gravity_z}: {got} {want}");
            }
        }
        assert_eq!(joined.metadata().version, low.metadata().version);
        assert_eq!(joined.metadata().evaluation, None);
    }
}

/// A walker that knows nothing of water and a swimmer that observes the medium, either way round.
#[test]
fn who_observes_less_does_not_look_at_the_rest() {
    let mut wet = metadata();
    wet.contract.observation = ObservationLayout::new(16, &FEET.map(str::to_owned), true);
    wet.contract.command.vx_mps = [-0.1, 0.9];
    let (walker, swimmer) = (file(1, &[12, 9], &metadata()), file(2, &[12, 9], &wet));
    let joined = join(&walker, &swimmer, OBS_DIM, 0.5).unwrap();
    let mut obs = normals(&mut stream(3), OBS_DIM + 1, 1.0);
    for medium in [0.0, 1.0] {
        obs[OBS_DIM] = medium;
        let want = match medium {
            0.0 => actions(&walker, &obs[..OBS_DIM]),
            _ => actions(&swimmer, &obs),
        };
        for (got, want) in actions(&joined, &obs).iter().zip(want) {
            assert!((got - want).abs() < 2e-4, "{medium}: {got} {want}");
        }
    }
    assert_eq!(joined.metadata().contract.command.vx_mps, [-0.1, 0.5]);
    assert_eq!(joined.metadata().contract.observation, wet.contract.observation);
    assert!(join(&swimmer, &walker, OBS_DIM, 0.5).is_ok());
    wet.contract.command.vx_mps = [5.0, 6.0];
    assert!(join(&walker, &file(2, &[12, 9], &wet), OBS_DIM, 0.5).is_err());
}

/// One that looks back beside one that does not.
#[test]
fn who_does_not_look_back_does_not_look_at_the_past() {
    let mut keen = metadata();
    let observation = keen.contract.observation.clone().with_past(&[2]).unwrap();
    keen.contract.observation = observation.clone();
    let (low, high) = (file(1, &[12, 9], &keen), file(2, &[12, 9], &metadata()));
    let joined = join(&low, &high, GRAVITY_Z, -0.5).unwrap();
    assert_eq!(joined.metadata().contract.observation, observation);
    let mut obs = normals(&mut stream(3), observation.dim(), 1.0);
    for gravity_z in [-1.0, 1.0] {
        obs[GRAVITY_Z] = gravity_z;
        let want = match gravity_z < -0.5 {
            true => actions(&low, &obs),
            false => actions(&high, &obs[..OBS_DIM]),
        };
        for (got, want) in actions(&joined, &obs).iter().zip(want) {
            assert!((got - want).abs() < 2e-4, "{gravity_z}: {got} {want}");
        }
    }
    keen.contract.observation = observation.with_past(&[3]).unwrap();
    assert!(join(&low, &file(2, &[12, 9], &keen), GRAVITY_Z, -0.5).is_err());
}

#[test]
fn what_does_not_go_together_is_refused() {
    let low = file(1, &[12, 9], &metadata());
    let mut other = metadata();
    other.contract.action.scale = 0.25;
    for high in
        [file(2, &[12, 9], &other), file(2, &[12], &metadata()), file(2, &[12, 9, 7], &metadata())]
    {
        let refused = join(&low, &high, GRAVITY_Z, -0.5).unwrap_err();
        assert!(matches!(refused, PolicyError::NotJoinable { .. }), "{refused}");
    }
    assert!(join(&low, &low, OBS_DIM, 0.0).is_err());
    for at in [f32::NAN, 50.0] {
        assert!(join(&low, &low, GRAVITY_Z, at).is_err(), "{at}");
    }
}
