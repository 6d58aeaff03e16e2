//! Certificates renewed in a cluster: what the CronJob runs, against a `kubectl` that keeps secrets in folders.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use caudata_launch_tests::{has_tool, program, read, repository, skipped, yaml};

const COMPONENT: &str = "docker/kubernetes/components/renew";

/// `kubectl get`, `create --dry-run`, `apply` and `rollout` as the script uses them; what is asked for is kept.
const KUBECTL: &str = r#"#!/bin/sh
echo "$*" >> "$STORE/asked"
case "$1 $2" in
    "get secret")
        secret=$STORE/$3
        [ -d "$secret" ] || exit 1
        [ $# -eq 3 ] || base64 "$secret/$(printf %s "$5" | cut -d '"' -f 2)"
        ;;
    "create secret")
        secret=$STORE/$4
        from=${5#--from-file=}
        cp "$from"/* "$secret/"
        echo "$4"
        ;;
    "apply -f") cat > /dev/null ;;
esac
"#;

fn caudata(arguments: &[&str]) {
    let output = Command::new(program("caudata").unwrap()).args(arguments).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {errors}");
}

/// A folder on the path with this `kubectl`, and the caudata that is built.
fn path_with_kubectl(folder: &Path) -> String {
    let kubectl = folder.join("kubectl");
    std::fs::write(&kubectl, KUBECTL).unwrap();
    std::fs::set_permissions(&kubectl, PermissionsExt::from_mode(0o755)).unwrap();
    let built = program("caudata").unwrap();
    let built = built.parent().unwrap().display();
    format!("{}:{built}:{}", folder.display(), std::env::var("PATH").unwrap())
}

#[test]
fn what_ends_soon_is_made_again_put_into_its_secret_and_restarted() {
    if program("caudata").is_none() {
        return skipped("caudata is not built");
    }
    let dir = tempfile::tempdir().unwrap();
    let folder = |name: &str| {
        let folder = dir.path().join(name);
        std::fs::create_dir_all(&folder).unwrap();
        folder
    };
    let (store, pki) = (folder("store"), folder("pki"));
    let authority = dir.path().join("authority");
    let authority_word = authority.to_str().unwrap();
    caudata(&["pki", "init", "--dir", authority_word]);
    for (role, days) in [("learner", "1"), ("server", "1"), ("actor", "7")] {
        let issue = ["pki", "issue", "--dir", authority_word, "--role", role];
        caudata(&[&issue[..], &["--days", days, "--host", "here"]].concat());
        let secret = store.join(format!("caudata-{role}-tls"));
        std::fs::rename(authority.join(role), secret).unwrap();
    }
    let certificate = |role: &str| {
        let secret = store.join(format!("caudata-{role}-tls"));
        std::fs::read_to_string(secret.join("tls.crt")).unwrap()
    };
    let roles = ["learner", "server", "actor"];
    let before = roles.map(certificate);
    let output = Command::new("sh")
        .arg(repository().join(COMPONENT).join("renew.sh"))
        .env("PATH", path_with_kubectl(dir.path()))
        .envs([("STORE", &store), ("PKI", &pki), ("AUTHORITY", &authority)])
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{errors}");
    let after = roles.map(certificate);
    let changed = [0, 1, 2].map(|role| before[role] != after[role]);
    assert_eq!(changed, [true, true, false]);
    let asked = std::fs::read_to_string(store.join("asked")).unwrap();
    let restarted: Vec<&str> = asked
        .lines()
        .filter_map(|line| line.strip_prefix("rollout restart statefulset/"))
        .collect();
    assert_eq!(restarted, ["caudata-learner", "caudata-policy-server"]);
    assert!(!asked.contains("rollout restart deployment"), "{asked}");
}

/// The pod may do what the script asks for and no more, to secrets and workloads that exist.
#[test]
fn the_component_builds_and_may_touch_what_is_there() {
    let documents = yaml(&read(&format!("{COMPONENT}/renew.yaml")).unwrap()).unwrap();
    let role = documents.iter().find(|d| d["kind"] == "Role").unwrap();
    let named = |rule: usize| {
        let names = role["rules"][rule]["resourceNames"].as_array().unwrap();
        let names = names.iter().map(|name| name.as_str().unwrap().to_owned());
        names.collect::<Vec<String>>()
    };
    let folder = "docker/kubernetes";
    let all: String = ["learner", "actors", "policy-server"]
        .map(|part| read(&format!("{folder}/base/{part}.yaml")).unwrap())
        .concat()
        + &read(&format!("{folder}/components/router/router.yaml")).unwrap();
    for secret in named(0) {
        assert!(all.contains(&format!("secretName: {secret}\n")), "{secret}");
    }
    for workload in named(1) {
        assert!(all.contains(&format!("  name: {workload}\n")), "{workload}");
    }
    if !has_tool("kubectl") {
        return skipped("kubectl is not installed");
    }
    let beside = tempfile::tempdir_in(repository().join("target")).unwrap();
    let overlay = "resources: [../../docker/kubernetes/base]\ncomponents: [../../docker/kubernetes/components/renew]\n";
    std::fs::write(beside.path().join("kustomization.yaml"), overlay).unwrap();
    let output = Command::new("kubectl")
        .args(["kustomize", "--load-restrictor", "LoadRestrictionsNone"])
        .arg(beside.path())
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{errors}");
    let built = yaml(&String::from_utf8(output.stdout).unwrap()).unwrap();
    let job = built.iter().find(|d| d["kind"] == "CronJob").unwrap();
    let pod = &job["spec"]["jobTemplate"]["spec"]["template"]["spec"];
    let script = pod["volumes"][0]["configMap"]["name"].as_str().unwrap();
    assert!(script.starts_with("caudata-renew-"), "{script}");
}
