//! The images are built for real, without a container engine: buildah on a base of debootstrap. Long and
//! needs the network for the base, so it runs with `make test-faults`.

use std::path::Path;
use std::process::Command;

use caudata_launch_tests::{has_tool, program, read, repository, skipped};

/// The promise of the actor's image, bytes.
const ACTOR_BYTES_MAX: u64 = 120_000_000;

/// Runs to the end; its standard output.
fn output(command: &mut Command) -> String {
    let output = command.output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{command:?}: {errors}");
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

#[test]
#[ignore = "minutes, and fetches a base; make test-faults"]
fn images_are_built_and_the_actor_s_is_small_and_runs() {
    for tool in ["buildah", "debootstrap"] {
        if !has_tool(tool) {
            return skipped(&format!("{tool} is not installed"));
        }
    }
    let Some(actor) = program("caudata-actor") else {
        return skipped("caudata-actor is not built");
    };
    let target = actor.parent().unwrap();
    let dir = tempfile::tempdir().unwrap();
    let storage =
        format!("--root {0}/storage --runroot {0}/run --storage-driver vfs", dir.path().display());
    let buildah = |arguments: &[&str]| {
        output(Command::new("buildah").args(storage.split(' ')).args(arguments))
    };
    let base = dir.path().join("base");
    output(Command::new("debootstrap").args(["--variant=minbase", "bookworm"]).arg(&base));
    let container = buildah(&["from", "scratch"]);
    buildah(&["add", &container, base.to_str().unwrap(), "/"]);
    buildah(&["commit", &container, "localhost/base"]);
    output(
        Command::new("sh")
            .arg(repository().join("docker/images/build.sh"))
            .args(["--prebuilt", "actor", "policy-server"])
            .env("ENGINE", "buildah")
            .env("BUILDAH_FLAGS", &storage)
            .env("BUD_FLAGS", "--isolation chroot")
            .env("BASE", "localhost/base")
            .env("TARGET_DIR", target),
    );
    let container = buildah(&["from", "localhost/caudata/actor"]);
    let root = buildah(&["mount", &container]);
    let bytes = bytes_below(Path::new(&root));
    println!("the actor's image: {:.1} MB", bytes as f64 / 1e6);
    assert!(bytes < ACTOR_BYTES_MAX, "{bytes}");
    assert!(!Path::new(&root).join("bin/sh").exists(), "no shell");
    let said = output(Command::new("chroot").args([
        "--userspec=65532:65532",
        &root,
        "/usr/local/bin/caudata-actor",
        "--version",
    ]));
    assert!(said.starts_with("caudata-actor "), "{said}");
    buildah(&["umount", &container]);
}

fn bytes_below(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).unwrap().flatten();
    entries
        .map(|entry| match entry.file_type().unwrap() {
            kind if kind.is_dir() => bytes_below(&entry.path()),
            kind if kind.is_file() => entry.metadata().unwrap().len(),
            _ => 0,
        })
        .sum()
}

#[test]
fn images_go_to_the_registry_that_is_named() {
    // an engine that says what it is asked for
    let asked = output(
        Command::new("sh")
            .arg(repository().join("docker/images/build.sh"))
            .args(["--push", "actor"])
            .env("ENGINE", "echo")
            .env("IMAGES", "registry.example.org/lab")
            .env("TAG", "1"),
    );
    let last = asked.lines().last().unwrap();
    assert_eq!(last, "push registry.example.org/lab/actor:1");
    assert!(asked.contains("-t registry.example.org/lab/build:1"), "{asked}");
}

/// systemd reads every unit without a complaint, but for programs that are not installed here.
#[test]
fn systemd_takes_the_units() {
    if !has_tool("systemd-analyze") {
        return skipped("systemd-analyze is not installed");
    }
    let dir = tempfile::tempdir().unwrap();
    let units = std::fs::read_dir(repository().join("docker/systemd")).unwrap();
    let mut paths = Vec::new();
    for unit in units.flatten() {
        let text = std::fs::read_to_string(unit.path()).unwrap();
        let lines = text.lines().map(|line| match line.split_once("/opt/caudata/bin/") {
            Some((key, command)) => {
                let (_, arguments) = command.split_once(' ').unwrap_or_default();
                format!("{key}/bin/true {arguments}")
            }
            None => line.replace("User=caudata", "User=root"),
        });
        let path = dir.path().join(unit.file_name());
        std::fs::write(&path, lines.collect::<Vec<_>>().join("\n")).unwrap();
        paths.push(path);
    }
    assert!(paths.len() >= 7, "{paths:?}");
    let output = Command::new("systemd-analyze").arg("verify").args(&paths).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    let ours: Vec<&str> = said.lines().filter(|line| line.contains("caudata")).collect();
    assert!(output.status.success() && ours.is_empty(), "{said}");
}

/// What needs no tools: every file that a Dockerfile or its scripts copy out of the repository is there, no
/// image of a program runs as root, and each listens for SIGTERM.
#[test]
fn recipes_name_files_that_exist_and_run_as_nobody() {
    for image in ["actor", "learner", "policy-server"] {
        let text = read(&format!("docker/images/{image}.Dockerfile")).unwrap();
        assert!(text.contains("\nUSER 65532:65532\n"), "{image}");
        assert!(text.contains("\nSTOPSIGNAL SIGTERM\n"), "{image}");
        let entry = format!("\nENTRYPOINT [\"/usr/local/bin/caudata-{image}\"]\n");
        assert!(text.contains(&entry), "{image}");
        let last_stage = text.rsplit("\nFROM ").next().unwrap();
        assert!(last_stage.starts_with("scratch"), "{image}: the last stage holds nothing else");
        for line in text.lines().filter_map(|line| line.strip_prefix("COPY docker/")) {
            let file = line.split_whitespace().next().unwrap();
            assert!(repository().join("docker").join(file).is_file(), "{image}: {file}");
        }
    }
    let cuda = read("docker/images/learner-cuda.Dockerfile").unwrap();
    let torch = cuda.lines().find_map(|line| line.strip_prefix("ARG TORCH="));
    let pinned = format!("libtorch-{}-cpu-x86_64", torch.unwrap());
    assert!(
        read("setup/pins.py").unwrap().contains(&pinned),
        "{pinned}: the CUDA libraries are of the version that the learner is compiled against"
    );
    let actor = read("docker/images/actor.Dockerfile").unwrap();
    assert!(!actor.contains("libtorch/"), "an actor has no libtorch");
    for script in [
        "images/build.sh",
        "images/collect.sh",
        "images/root.sh",
        "kubernetes/components/renew/renew.sh",
        "slurm/submit.sh",
    ] {
        output(Command::new("sh").arg("-n").arg(repository().join("docker").join(script)));
    }
    for job in ["learner", "actors"] {
        let path = format!("docker/slurm/{job}.sbatch");
        output(Command::new("sh").arg("-n").arg(repository().join(&path)));
        let text = read(&path).unwrap();
        for option in ["--requeue", "--signal=B:TERM@", "--open-mode=append"] {
            assert!(text.contains(&format!("#SBATCH {option}")), "{job}: {option}");
        }
    }
}
