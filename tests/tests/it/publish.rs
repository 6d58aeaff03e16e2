//! Policy files into a server's own store, and back.

use std::fs;

use caudata_tests::{command, finish};

use crate::siege::lab::started;

#[test]
fn a_policy_file_is_published_signed_and_comes_back_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let server = started(
        "caudata-policy-server",
        "policy_server",
        &["--data", &at("data"), "--addr", "127.0.0.1:0"],
    )
    .unwrap();
    let address = server.address.to_string();
    let policy = |args: &[&str]| {
        let all = [&["policy"], args, &["--server", &address, "--stream", "mine"]].concat();
        finish(command("caudata", &all).unwrap()).unwrap()
    };
    let made = ["policy", "keygen", "--key-id", "k", "--out", &at("k.key"), "--trust", &at("t")];
    assert_eq!(finish(command("caudata", &made).unwrap()).unwrap().code, Some(0));
    let signed = ["publish", "policies/flat.onnx", "--key", &at("k.key"), "--key-id", "k"];
    let first = policy(&signed);
    assert_eq!(first.code, Some(0), "{}", first.stderr);
    assert!(first.stdout.starts_with("mine version "), "{}", first.stdout);
    assert!(!first.stdout.contains("not signed"), "{}", first.stdout);
    // The same again is the same version; with other signatures it is another one, of the same number.
    let again = policy(&signed).stdout;
    assert_eq!(again.trim(), format!("{}, which was there already", first.stdout.trim()));
    // A key under another's name signs nothing.
    let misnamed =
        policy(&["publish", "policies/flat.onnx", "--key", &at("k.key"), "--key-id", "x"]);
    assert_eq!(misnamed.code, Some(65), "{}", misnamed.stderr);
    assert!(misnamed.stderr.contains("this key's name is `k`, not `x`"), "{}", misnamed.stderr);
    let unsigned = policy(&signed[..2]);
    assert_eq!(unsigned.code, Some(77), "{}", unsigned.stderr);
    assert!(unsigned.stderr.contains("was there already"), "{}", unsigned.stderr);
    let back = policy(&["pull", "--out", &at("back.onnx")]);
    assert_eq!(back.code, Some(0), "{}", back.stderr);
    let shipped = caudata_tests::repository_root().join("policies/flat.onnx");
    assert_eq!(fs::read(at("back.onnx")).unwrap(), fs::read(shipped).unwrap());
}
