//! The mean of versions.

use super::{metadata, small};
use crate::{PolicyError, PolicyFile, PolicyMetadata, average, build_onnx};

fn file(shift: f32, metadata: &PolicyMetadata) -> PolicyFile {
    let mut spec = small();
    for layer in &mut spec.layers {
        layer.weight.iter_mut().chain(&mut layer.bias).for_each(|x| *x += shift);
    }
    PolicyFile::parse(build_onnx(&spec, metadata).unwrap().into()).unwrap()
}

#[test]
fn every_number_is_the_mean_and_the_last_version_gives_the_name() {
    let at = |version| PolicyMetadata { version, ..metadata() };
    // weights shifted by 0.25 and 0.75: their mean is shifted by 0.5
    let mean = average(&[file(0.25, &at(1)), file(0.75, &at(2))]).unwrap();
    let (got, want) = (&mean.spec().layers[0].weight, &small().layers[0].weight);
    for (got, want) in got.iter().zip(want) {
        assert!((got - want - 0.5).abs() < 1e-6, "{got} {want}");
    }
    assert_eq!((mean.metadata().version, &mean.metadata().evaluation), (2, &None));
    assert_eq!(mean.spec().obs_std, small().obs_std);
}

#[test]
fn versions_of_two_trainings_have_none() {
    let other = PolicyMetadata { run_id: "other".to_owned(), ..metadata() };
    let refused = |files: &[PolicyFile]| average(files).unwrap_err() == PolicyError::NotOneTraining;
    assert!(refused(&[file(0.0, &metadata()), file(0.0, &other)]));
    assert!(refused(&[]));
}
