//! ONNX Runtime computes what the plain evaluation computes.

use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::thread;

use super::{file, network, normals, small, stream};
use crate::{Activation, Inference, MlpSpec, PolicyError, PolicyFile, evaluate_mlp};

/// Largest difference between ONNX Runtime's actions and the plain evaluation's.
fn difference(spec: &MlpSpec, lanes: &[usize]) -> f32 {
    let mut inference = Inference::new(&file(spec), 1).unwrap();
    let mut random = stream(2);
    let mut largest = 0.0_f32;
    for &lanes in lanes {
        // Wide enough that clips, tails and both signs of every activation are visited.
        let obs = normals(&mut random, lanes * 97, 4.0);
        let mut expected = vec![0.0; lanes * 16];
        let mut found = vec![f32::NAN; lanes * 16];
        evaluate_mlp(spec, &obs, lanes, &mut expected).unwrap();
        inference.run(&obs, lanes, &mut found).unwrap();
        for (a, b) in expected.iter().zip(&found) {
            // Relative where actions are large: f32 sums of hundreds of terms.
            largest = largest.max((a - b).abs() / a.abs().max(1.0));
            assert!(b.is_finite());
        }
    }
    largest
}

#[test]
fn onnx_runtime_agrees_with_the_plain_evaluation() {
    for activation in Activation::ALL {
        for (hidden, clip) in [(&[128, 128][..], None), (&[64, 32, 16], Some(5.0)), (&[], None)] {
            let spec = network(hidden, activation, clip);
            // Back to a number of lanes seen before: the tensors are bound anew each time.
            let worst = difference(&spec, &[1, 3, 64, 257, 64, 1]);
            assert!(worst < 1e-5, "{activation:?} {hidden:?}: {worst}");
        }
    }
}

#[test]
fn a_run_depends_on_its_observations_only() {
    let mut inference = Inference::new(&file(&small()), 1).unwrap();
    let mut random = stream(3);
    let (a, b) = (normals(&mut random, 97, 1.0), normals(&mut random, 97, 1.0));
    let mut run = |obs: &[f32]| {
        let mut out = [0.0; 16];
        inference.run(obs, 1, &mut out).unwrap();
        out
    };
    let (first, other, again) = (run(&a), run(&b), run(&a));
    assert_eq!(first, again);
    assert_ne!(first, other);
}

#[test]
fn sessions_in_several_threads_give_the_same_bits() {
    let file = file(&network(&[128, 128], Activation::Elu, None));
    let obs = normals(&mut stream(4), 64 * 97, 1.0);
    let run = || {
        let mut inference = Inference::new(&file, 1).unwrap();
        let mut out = vec![0.0; 64 * 16];
        for _ in 0..20 {
            inference.run(&obs, 64, &mut out).unwrap();
        }
        out
    };
    let reference = run();
    thread::scope(|scope| {
        let threads: Vec<_> = (0..4).map(|_| scope.spawn(run)).collect();
        for thread in threads {
            assert_eq!(thread.join().unwrap(), reference);
        }
    });
}

#[test]
fn a_session_moves_between_threads() {
    let mut inference = Inference::new(&file(&small()), 1).unwrap();
    let mut out = [0.0; 16];
    inference.run(&[0.5; 97], 1, &mut out).unwrap();
    let there = thread::spawn(move || {
        let mut out = [0.0; 16];
        inference.run(&[0.5; 97], 1, &mut out).unwrap();
        out
    });
    assert_eq!(there.join().unwrap(), out);
}

#[test]
fn slices_of_the_wrong_length_are_refused() {
    let mut inference = Inference::new(&file(&small()), 1).unwrap();
    assert_eq!((inference.obs_dim(), inference.act_dim()), (97, 16));
    let wrong = |what, found, expected| Err(PolicyError::Length { what, found, expected });
    assert_eq!(inference.run(&[0.0; 96], 1, &mut [0.0; 16]), wrong("obs", 96, 97));
    assert_eq!(inference.run(&[0.0; 194], 2, &mut [0.0; 16]), wrong("actions", 16, 32));
    assert_eq!(inference.run(&[], usize::MAX, &mut []), wrong("obs", 0, usize::MAX));
    assert_eq!(inference.run(&[], 0, &mut []), Ok(()));
}

/// Set for the child process of the test below.
const CHILD: &str = "CAUDATA_TEST_BROKEN_LIBRARY";

/// The library is loaded once per process, so each broken one gets a process of its own.
#[test]
fn a_missing_or_broken_library_is_an_error_and_no_panic() {
    let dir = tempfile::tempdir().unwrap();
    let broken = dir.path().join("libonnxruntime.so");
    std::fs::write(&broken, "no library").unwrap();
    for (library, expected) in [
        (broken, "cannot load ONNX Runtime from"),
        (dir.path().join("missing.so"), "which is no file"),
    ] {
        let output = Command::new(std::env::current_exe().unwrap())
            .args([
                "--exact",
                "tests::running::child_with_another_library",
                "--ignored",
                "--nocapture",
            ])
            .env("ORT_DYLIB_PATH", &library)
            .env(CHILD, "1")
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && text.contains(expected), "{text}");
    }
}

#[test]
#[ignore = "run by the test above, in a process whose ORT_DYLIB_PATH is wrong"]
#[allow(clippy::print_stdout)]
fn child_with_another_library() {
    // Whoever runs all ignored tests has a library that works.
    if std::env::var_os(CHILD).is_none() {
        return;
    }
    let first = Inference::new(&file(&small()), 1).unwrap_err();
    let second = Inference::new(&file(&small()), 1).unwrap_err();
    assert_eq!(first, second, "a failed load can be tried again");
    println!("{first}");
}

/// The policies of this repository on observations drawn by number, as x86-64 computed them once. Any other
/// processor computes the same (`make test-arm`); `CAUDATA_WRITE_DOCS=1` on x86-64 writes them again.
#[test]
fn every_processor_computes_the_same_actions() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let golden = root.join("src/tests/golden_actions.json");
    let lanes = 4;
    let mut found = std::collections::BTreeMap::new();
    for (number, name) in (5..).zip(["flat", "rough", "amphibious"]) {
        let bytes = std::fs::read(root.join(format!("../../policies/{name}.onnx"))).unwrap();
        let policy = PolicyFile::parse(Arc::from(bytes)).unwrap();
        let mut inference = Inference::new(&policy, 1).unwrap();
        let obs = normals(&mut stream(number), lanes * inference.obs_dim(), 1.0);
        let mut actions = vec![f32::NAN; lanes * inference.act_dim()];
        inference.run(&obs, lanes, &mut actions).unwrap();
        found.insert(name.to_owned(), actions);
    }
    if std::env::var_os("CAUDATA_WRITE_DOCS").is_some() && cfg!(target_arch = "x86_64") {
        std::fs::write(&golden, serde_json::to_string_pretty(&found).unwrap()).unwrap();
    }
    let known: std::collections::BTreeMap<String, Vec<f32>> =
        serde_json::from_str(&std::fs::read_to_string(&golden).unwrap()).unwrap();
    let mut worst = 0.0_f32;
    for (name, actions) in &known {
        assert_eq!(actions.len(), found[name].len());
        for (a, b) in actions.iter().zip(&found[name]) {
            worst = worst.max((a - b).abs());
        }
    }
    eprintln!("largest difference from x86-64: {worst:e}");
    assert!(worst <= 1e-6, "{worst}");
}
