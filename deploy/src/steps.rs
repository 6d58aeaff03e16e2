//! The verification steps by name, so that tests can show what each of them is there for: with one step left out, exactly the policy
//! that it keeps out gets through.

/// One check, somewhere in this crate, that stands between a bad policy and the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// The announcement is for this robot.
    RobotName,
    /// And for this model of it.
    RobotModel,
    /// Trusted keys signed the announcement.
    Signature,
    /// These keys are not older than any that this robot trusted.
    TrustVersion,
    /// The bytes are the announced ones.
    Hash,
    /// The file bears the announced version.
    Version,
    /// What the policy may not choose itself is as on this robot. (What it may choose is in range: reading the file checks that.)
    Contract,
    /// Its actions are numbers.
    FiniteActions,
    /// ONNX Runtime computes what the file says.
    SameActions,
    /// It was not refused before.
    Quarantine,
    /// It is not older than what this robot has.
    Older,
    /// It is not older than anything this robot has seen.
    Seen,
    /// Its version does not shut out all later ones.
    Jump,
    /// It was not begun with too often.
    Attempts,
    /// The bytes on the disk are those that were put there.
    StoredHash,
    /// The announcement on the disk is this policy's, and signed.
    StoredSignature,
    /// The server's proof of what is newest answers this robot's own question of just now.
    Fresh,
    /// The server shows what it proved.
    Proved,
    /// A robot whose state is lost takes nothing before a server proved what is newest.
    Torn,
    /// The child process that tried it came back.
    ChildLived,
    /// And found nothing wrong.
    ChildContent,
    /// A command over the network was made with the link's key.
    CommandTag,
    /// For this start of the robot.
    CommandNonce,
    /// And after the newest that counted.
    CommandSequence,
}

impl Step {
    /// Whether the check is made; always, outside of tests.
    #[cfg(not(test))]
    pub(crate) const fn on(self) -> bool {
        true
    }

    /// Whether the check is made: a test may leave one out.
    #[cfg(test)]
    pub(crate) fn on(self) -> bool {
        tests::LEFT_OUT.get() != Some(self)
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::path::Path;

    use caudata_left_out::{each_left_out, steps_in};
    use caudata_policy::{Dense, PolicyFile};
    use caudata_proto::registry::{Freshness, LabelName, Manifest, StreamName};
    use caudata_registry_client::RegistryClient;
    use caudata_signing::{ReleaseKey, Trust};
    use sha2::{Digest, Sha256};

    use super::Step;
    use crate::DeployError;
    use crate::command_link::{Kind, LinkKey, Message, Receiver};
    use crate::keeper::{Keeper, reference};
    use crate::metrics::AgentMetrics;
    use crate::probe::ProbeProgram;
    use crate::state::{ATTEMPTS_MAX, Blame, Decision, PolicyRef, RobotState, Sha256Digest};
    use crate::store::{PolicyStore, manifest_file, read_policy};
    use crate::testing::{model, policy_file};
    use crate::verify::{check_fresh, check_manifest, check_proved, check_signatures, verify};

    thread_local! {
        pub(super) static LEFT_OUT: Cell<Option<Step>> = const { Cell::new(None) };
    }

    const HERE: Sha256Digest = Sha256Digest([7; 32]);

    fn of(bytes: &[u8], version: u64) -> PolicyRef {
        PolicyRef {
            stream: "s".to_owned(),
            version,
            sha256: Sha256Digest(Sha256::digest(bytes).into()),
            reverts_to: None,
        }
    }

    fn announcement(bytes: &[u8], version: u64) -> Manifest {
        let file = PolicyFile::parse(bytes.into()).unwrap();
        let stream = StreamName::new("s").unwrap();
        let mut manifest = caudata_registry_client::manifest_of(stream, &file, 5).unwrap();
        manifest.version = version;
        manifest
    }

    fn key() -> ReleaseKey {
        ReleaseKey::from_seed("release", &[7; 32])
    }

    fn trust() -> Trust {
        Trust::parse(&key().trust_file()).unwrap()
    }

    fn verified(bytes: Vec<u8>, policy: &PolicyRef) -> Result<(), String> {
        let verified = verify(bytes.into(), policy, &model());
        verified.map(drop).map_err(|e| e.to_string())
    }

    /// Its own file, whole and announced as it is.
    fn own(bytes: Vec<u8>) -> Result<(), String> {
        let policy = of(&bytes, 1);
        verified(bytes, &policy)
    }

    fn decided(state: &RobotState, policy: &PolicyRef) -> Result<(), String> {
        match state.decide(policy, HERE) {
            Decision::Fetch | Decision::HaveIt => Ok(()),
            other => Err(format!("{other:?}")),
        }
    }

    /// Tries to get past `step` with what it alone keeps out.
    fn attempt(step: Step) -> Result<(), String> {
        let good = || policy_file(1, |_, _| {});
        let mut manifest = announcement(&good(), 1);
        let mut state = RobotState::default();
        match step {
            Step::RobotName => {
                manifest.robot_name = "newt".to_owned();
                check_manifest(&manifest, &model()).map_err(|e| e.to_string())
            }
            Step::RobotModel => {
                manifest.robot_hash = [0; 32];
                check_manifest(&manifest, &model()).map_err(|e| e.to_string())
            }
            Step::Signature => {
                // Signed, and then one digit of its version was changed.
                key().sign(&mut manifest);
                manifest.version += 1;
                check_signatures(&manifest, Some(&trust())).map_err(|e| e.to_string())
            }
            Step::TrustVersion => {
                let folder = tempfile::tempdir().unwrap();
                let mut store = PolicyStore::open(folder.path()).unwrap();
                let path = Path::new("trust.toml");
                store.trust(path, 2).unwrap();
                store.trust(path, 1).map_err(|e| e.to_string())
            }
            Step::Hash => verified(good(), &of(b"other bytes", 1)),
            Step::Version => verified(good(), &of(&good(), 2)),
            Step::Contract => own(policy_file(1, |_, m| m.contract.joint_names.swap(2, 3))),
            Step::FiniteActions => own(policy_file(1, |spec, _| {
                spec.layers[0].weight.fill(3e38);
            })),
            Step::SameActions => own(rounding_matters()),
            Step::Quarantine => {
                let policy = of(&good(), 1);
                state.quarantine(policy.clone(), "falls".to_owned(), Blame::Policy);
                decided(&state, &policy)
            }
            Step::Older => {
                // Of a state written before versions were remembered by stream.
                state.adopt(of(b"two", 2));
                state.seen.clear();
                decided(&state, &of(b"one", 1))
            }
            Step::Seen => {
                state.adopt(of(b"one", 1));
                state.adopt(of(b"three", 3));
                state.quarantine(of(b"three", 3), "falls".to_owned(), Blame::Policy);
                decided(&state, &of(b"two", 2))
            }
            Step::Jump => decided(&state, &of(b"last", u64::MAX)),
            Step::Attempts => {
                let folder = tempfile::tempdir().unwrap();
                let keeper = keeper(folder.path());
                let policy = of(b"one", 1);
                (0..ATTEMPTS_MAX).for_each(|_| assert!(!keeper.begin(&policy).unwrap()));
                keeper.begin(&policy).map(drop).map_err(|e| e.to_string())
            }
            Step::StoredHash => {
                let (folder, policy) = stored(&good(), &mut manifest);
                let path = folder.path().join(format!("blobs/{}.onnx", policy.sha256));
                std::fs::write(path, b"other bytes").unwrap();
                read(folder.path(), &policy)
            }
            Step::StoredSignature => {
                let (folder, policy) = stored(&good(), &mut manifest);
                let path = manifest_file(folder.path(), &policy);
                manifest.signatures.clear();
                std::fs::write(path, manifest.to_bytes()).unwrap();
                read(folder.path(), &policy)
            }
            Step::Fresh => {
                let server = ReleaseKey::from_seed("server", &[9; 32]);
                let text = key().trust_file() + &server.fresh_trust_lines();
                let trust = Trust::parse(&text).unwrap();
                let label = LabelName::new("latest").unwrap();
                // Signed by the right key, for a question of yesterday.
                let answer = server.vouch(proof(&manifest, 1));
                check_fresh(&trust, &answer, &[2; 32], &manifest.stream, &label)
                    .map_err(|e| e.to_string())
            }
            Step::Proved => {
                let proof = proof(&manifest, 1);
                manifest.version -= 1;
                check_proved(&manifest, &proof).map_err(str::to_owned)
            }
            Step::Torn => {
                let folder = tempfile::tempdir().unwrap();
                for copy in ["state.json", "state.copy.json"] {
                    std::fs::write(folder.path().join(copy), "{").unwrap();
                }
                std::fs::create_dir(folder.path().join("blobs")).unwrap();
                let store = PolicyStore::open_torn(folder.path()).unwrap();
                fetched(&keeper_over(store), &manifest)
            }
            Step::ChildLived => tried("kill -SEGV $$"),
            Step::ChildContent => tried("cat > /dev/null; echo 'error: bad' >&2; exit 77"),
            Step::CommandTag | Step::CommandNonce | Step::CommandSequence => commanded(step),
        }
    }

    fn keeper(folder: &Path) -> Keeper {
        keeper_over(PolicyStore::open(folder).unwrap())
    }

    fn keeper_over(store: PolicyStore) -> Keeper {
        let metrics = AgentMetrics::register(&caudata_telemetry::Metrics::new());
        Keeper::new(store, model(), metrics)
    }

    /// What a server says about where `latest` leads, asked with a nonce of these bytes.
    fn proof(manifest: &Manifest, nonce: u8) -> Freshness {
        Freshness {
            nonce: [nonce; 32],
            stream: manifest.stream.clone(),
            label: LabelName::new("latest").unwrap(),
            version: manifest.version,
            sha256: manifest.sha256,
        }
    }

    /// Whether `keeper` would fetch what is announced. Nobody is there: whoever asks the network finds that out.
    fn fetched(keeper: &Keeper, manifest: &Manifest) -> Result<(), String> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        runtime.block_on(async {
            let mut client = RegistryClient::new("127.0.0.1:1").unwrap();
            match keeper.take(&mut client, manifest).await {
                Ok(_) | Err(DeployError::Server(_)) => Ok(()),
                Err(error) => Err(error.to_string()),
            }
        })
    }

    /// A good policy, and a child that does as `script` says.
    fn tried(script: &str) -> Result<(), String> {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("child.sh");
        std::fs::write(&program, format!("#!/bin/sh\n{script}\n")).unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o700)).unwrap();
        let keeper = keeper(&folder.path().join("state")).probing(ProbeProgram {
            program,
            robot: "r.toml".into(),
            deadline: std::time::Duration::from_secs(60),
        });
        let bytes = policy_file(1, |_, _| {});
        let policy = of(&bytes, 1);
        let tried = keeper.tried(bytes.into(), &policy);
        tried.map(drop).map_err(|e| e.to_string())
    }

    /// One command counted; whether the next one moves the robot, which somebody without the key, of another start of the robot or of a moment
    /// ago sends.
    fn commanded(step: Step) -> Result<(), String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("link.key");
        std::fs::write(&path, [7; 32]).unwrap();
        let key = LinkKey::read(&path).unwrap();
        let message = |nonce, sequence, vx| Message {
            kind: Kind::Velocity,
            nonce,
            sequence,
            command: [vx, 0.0, 0.0],
        };
        let mut receiver = Receiver::new(3);
        let now = std::time::Duration::from_secs(1);
        receiver.take(&message(3, 5, 0.1).encode(&key), &key, now);
        let datagram = match step {
            Step::CommandTag => {
                let mut bytes = message(3, 6, 0.1).encode(&key);
                bytes[21..25].copy_from_slice(&0.2_f32.to_le_bytes());
                bytes
            }
            Step::CommandNonce => message(2, 6, 0.2).encode(&key),
            _ => message(3, 5, 0.2).encode(&key),
        };
        receiver.take(&datagram, &key, now);
        match receiver.view(now).command[0] {
            0.2 => Ok(()),
            vx => Err(format!("{} ignored, vx stays {vx}", receiver.ignored)),
        }
    }

    fn stored(bytes: &[u8], manifest: &mut Manifest) -> (tempfile::TempDir, PolicyRef) {
        let folder = tempfile::tempdir().unwrap();
        let store = PolicyStore::open(folder.path()).unwrap();
        let policy = reference(manifest);
        key().sign(manifest);
        store.put(&policy, bytes).unwrap();
        store.put_manifest(manifest).unwrap();
        (folder, policy)
    }

    fn read(folder: &Path, policy: &PolicyRef) -> Result<(), String> {
        let read = read_policy(folder, policy, Some(&trust()));
        read.map(drop).map_err(|e| e.to_string())
    }

    /// A network of two layers in which sums of millions cancel: what is left depends on how each product is rounded, so that two
    /// correct evaluations differ.
    fn rounding_matters() -> Vec<u8> {
        policy_file(1, |spec, _| {
            let (input, out) = (spec.layers[0].input, spec.layers[0].out);
            let hidden = 128;
            let sign = |i: usize| if i.is_multiple_of(2) { 1.0 } else { -1.0 };
            let first = Dense {
                out: hidden,
                input,
                weight: (0..hidden * input)
                    .map(|i| (i as f32 * 0.7).sin())
                    .collect(),
                bias: vec![1.0e6; hidden],
            };
            let second = Dense {
                out,
                input: hidden,
                weight: (0..out * hidden)
                    .map(|i| sign(i) * (0.7 + 1e-3 * (i / hidden) as f32))
                    .collect(),
                bias: vec![0.0; out],
            };
            spec.layers = vec![first, second];
        })
    }

    const ALL: [Step; 24] = [
        Step::RobotName,
        Step::RobotModel,
        Step::Signature,
        Step::TrustVersion,
        Step::Hash,
        Step::Version,
        Step::Contract,
        Step::FiniteActions,
        Step::SameActions,
        Step::Quarantine,
        Step::Older,
        Step::Seen,
        Step::Jump,
        Step::Attempts,
        Step::StoredHash,
        Step::StoredSignature,
        Step::Fresh,
        Step::Proved,
        Step::Torn,
        Step::ChildLived,
        Step::ChildContent,
        Step::CommandTag,
        Step::CommandNonce,
        Step::CommandSequence,
    ];

    #[test]
    fn each_step_and_no_other_keeps_its_bad_policy_out() {
        let table = each_left_out(&LEFT_OUT, &ALL, attempt);
        // Seen with --nocapture: `make mutants`.
        eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
    }

    #[test]
    fn the_table_holds_every_step() {
        let table = ALL.map(|step| format!("{step:?}"));
        assert_eq!(steps_in(include_str!("steps.rs")), table);
    }
}
