//! Which keys a robot trusts, and whether they signed what they must have signed.

use std::collections::BTreeSet;
use std::path::Path;

use caudata_proto::checks::Check;
use caudata_proto::registry::question::{Facts, OtherQuestion};
use caudata_proto::registry::{LabelName, Manifest, NONCE_BYTES, SignedFreshness, StreamName};
use ed25519_dalek::VerifyingKey;
use serde::Deserialize;

use crate::error::{SigningError, check_kept, content, from_hex, read_small};
use crate::key::{TRUST_FORMAT, freshness_bytes, signed_bytes};

/// Most keys of a trust file.
const KEYS_MAX: usize = 64;

/// Why a manifest is not trusted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("it has {valid} valid signatures of trusted keys, {needed} are needed")]
pub struct Untrusted {
    /// Distinct trusted keys with a valid signature.
    pub valid: usize,
    /// How many there must be.
    pub needed: usize,
}

/// Why an answer about where a label leads does not count.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Stale {
    /// It answers another question, such as one of yesterday.
    #[error(transparent)]
    OtherQuestion(#[from] OtherQuestion),
    /// No trusted key signed it.
    #[error("no key that may say so signed the answer")]
    Unsigned,
}

/// Which keys a robot trusts, and how many of them must have signed.
#[derive(Clone, Debug)]
pub struct Trust {
    threshold: usize,
    keys: Vec<(String, VerifyingKey)>,
    fresh_keys: Vec<(String, VerifyingKey)>,
    pub(crate) version: u64,
    pub(crate) root_threshold: usize,
    pub(crate) root_keys: Vec<(String, VerifyingKey)>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TrustFile {
    format: String,
    /// Signatures that are needed.
    threshold: usize,
    /// Keys that were trusted once; their signatures do not count, also where they are listed below.
    #[serde(default)]
    revoked: Vec<String>,
    #[serde(default)]
    key: Vec<TrustedKey>,
    /// Keys of servers, which say where labels lead; they release nothing.
    #[serde(default)]
    fresh_key: Vec<TrustedKey>,
    /// Each successor's is one higher.
    #[serde(default = "one")]
    pub(crate) version: u64,
    /// Signatures of root keys that a successor needs.
    #[serde(default = "one")]
    root_threshold: u64,
    /// Keys that may name the next trust file; without any there is none. They release nothing.
    #[serde(default)]
    root_key: Vec<TrustedKey>,
}

const fn one() -> u64 {
    1
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TrustedKey {
    id: String,
    /// 64 hexadecimal digits.
    public: String,
}

impl Trust {
    /// Reads a trust file, and the successors beside it as far as they go: the last one is in force.
    ///
    /// # Errors
    /// [`SigningError`], also where a successor is there that does not follow.
    pub fn read(path: &Path) -> Result<Self, SigningError> {
        Self::first(path)?.newest(path)
    }

    /// The trust file at `path` alone.
    pub(crate) fn first(path: &Path) -> Result<Self, SigningError> {
        check_kept(path)?;
        let text = read_small(path)?;
        Self::parse(&text).map_err(|reason| content(path, reason))
    }

    /// Which of its successors it is.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// Parses and checks a trust file.
    ///
    /// # Errors
    /// What is wrong, in one line.
    pub fn parse(text: &str) -> Result<Self, String> {
        let file: TrustFile =
            toml::from_str(text).map_err(|e| e.to_string().trim().replace('\n', " "))?;
        if file.format != TRUST_FORMAT {
            return Err(format!("format is `{}`, not `{TRUST_FORMAT}`", file.format));
        }
        if file.key.len() + file.fresh_key.len() + file.root_key.len() > KEYS_MAX {
            return Err(format!("more than {KEYS_MAX} keys"));
        }
        let asks_freshness = !file.fresh_key.is_empty();
        let (mut ids, mut publics) = (BTreeSet::new(), BTreeSet::new());
        let mut lists = [Vec::new(), Vec::new(), Vec::new()];
        let all = [file.key, file.fresh_key, file.root_key];
        let all = all.into_iter().enumerate();
        for (kind, TrustedKey { id, public }) in
            all.flat_map(|(kind, keys)| keys.into_iter().map(move |key| (kind, key)))
        {
            let key = from_hex(&public).and_then(|bytes| VerifyingKey::from_bytes(&bytes).ok());
            let key = key.ok_or_else(|| format!("key `{id}`: `public` is not an Ed25519 key"))?;
            // One key under two names would count twice.
            if !publics.insert(key.to_bytes()) || !ids.insert(id.clone()) {
                return Err(format!("key `{id}` is listed twice"));
            }
            if !file.revoked.contains(&id) {
                lists[kind].push((id, key));
            }
        }
        // A name that no key bears revokes nothing: more likely than not it is misspelt.
        if let Some(unknown) = file.revoked.iter().find(|id| !ids.contains(*id)) {
            return Err(format!(
                "`revoked` names `{unknown}`, which is no key of this file: list the key as well, or correct the name"
            ));
        }
        let [keys, fresh_keys, root_keys] = lists;
        // Without any, answers of yesterday would be taken.
        if asks_freshness && fresh_keys.is_empty() {
            return Err(
                "every `fresh_key` is revoked: add the server's new one (`caudata policy keygen --fresh`)"
                    .to_owned(),
            );
        }
        let threshold = file.threshold;
        if threshold == 0 || threshold > keys.len() {
            return Err(format!("threshold {threshold} with {} keys", keys.len()));
        }
        if file.version == 0 {
            return Err("version 0: the first is 1".to_owned());
        }
        let root_threshold = usize::try_from(file.root_threshold).unwrap_or(usize::MAX);
        if root_threshold == 0 || (!root_keys.is_empty() && root_threshold > root_keys.len()) {
            let roots = root_keys.len();
            return Err(format!("root_threshold {root_threshold} with {roots} root keys"));
        }
        Ok(Self { threshold, keys, fresh_keys, version: file.version, root_threshold, root_keys })
    }

    /// Whether there is a key that can say where a label leads.
    pub fn knows_fresh_keys(&self) -> bool {
        !self.fresh_keys.is_empty()
    }

    /// Whether `answer` was signed by a key that may say so, for exactly this nonce, stream and label.
    pub fn check_fresh(
        &self,
        answer: &SignedFreshness,
        nonce: &[u8; NONCE_BYTES],
        stream: &StreamName,
        label: &LabelName,
    ) -> Result<(), Stale> {
        let proof = Proof {
            trust: self,
            answer,
            asked: Facts { nonce: Some(nonce), label: Some(label), ..Facts::of_stream(stream) },
        };
        proof.check(PROOF)
    }

    /// Whether enough trusted keys signed `manifest`.
    pub fn check(&self, manifest: &Manifest) -> Result<(), Untrusted> {
        let bytes = signed_bytes(manifest);
        let signed = |(id, key): &&(String, VerifyingKey)| {
            manifest.signatures.iter().any(|signature| {
                let form = ed25519_dalek::Signature::from_slice(&signature.signature);
                signature.key_id == *id && form.is_ok_and(|s| key.verify_strict(&bytes, &s).is_ok())
            })
        };
        // By trusted key, not by signature: the same one twice counts once.
        let valid = self.keys.iter().filter(signed).count();
        if valid >= self.threshold {
            return Ok(());
        }
        Err(Untrusted { valid, needed: self.threshold })
    }
}

/// What a server says about where a label leads, and whoever asked.
#[derive(Clone, Copy, Debug)]
struct Proof<'a> {
    trust: &'a Trust,
    answer: &'a SignedFreshness,
    asked: Facts<'a>,
}

type ProofCheck = fn(&Proof<'_>) -> Result<(), Stale>;

/// What such an answer must be.
const PROOF: &[Check<ProofCheck>] = &[
    // It answers this robot's own question of just now.
    Check { name: "question", refuse: |proof| Ok(proof.asked.answered_by(&proof.answer.said)?) },
    // A key that may say so signed it.
    Check::new("fresh signature", |proof| {
        let SignedFreshness { said, signature } = proof.answer;
        let bytes = freshness_bytes(said);
        let form = ed25519_dalek::Signature::from_slice(&signature.signature);
        let known = |(id, key): &(String, VerifyingKey)| {
            let fits = |s: &ed25519_dalek::Signature| key.verify_strict(&bytes, s).is_ok();
            *id == signature.key_id && form.as_ref().is_ok_and(fits)
        };
        if proof.trust.fresh_keys.iter().any(known) { Ok(()) } else { Err(Stale::Unsigned) }
    }),
];

impl Proof<'_> {
    fn check(&self, checks: &[Check<ProofCheck>]) -> Result<(), Stale> {
        checks.iter().try_for_each(|check| (check.refuse)(self))
    }
}

#[cfg(test)]
pub mod tests {
    use caudata_proto::checks::each_left_out;

    use caudata_proto::hex::hex;
    use caudata_proto::registry::Freshness;
    use ed25519_dalek::Signer;

    use super::*;
    use crate::key::ReleaseKey;

    pub(crate) fn manifest() -> Manifest {
        Manifest {
            stream: StreamName::new("release/flat").unwrap(),
            version: 7,
            sha256: [1; 32],
            size: 1000,
            created_unix_ms: 5,
            run_id: "run".into(),
            contract_hash: [2; 32],
            robot_name: "polymander".into(),
            robot_hash: [3; 32],
            env_steps: 9,
            training_commit: String::new(),
            config_hash: "c".into(),
            evaluation_json: Some("{}".into()),
            reverts_to: None,
            signatures: Vec::new(),
        }
    }

    pub(crate) fn key(number: u8) -> ReleaseKey {
        ReleaseKey::from_seed(&format!("k{number}"), &[number; 32])
    }

    fn trust(numbers: &[u8], threshold: usize, revoked: &str) -> Result<Trust, String> {
        let mut text = format!(
            "format = \"{TRUST_FORMAT}\"\nthreshold = {threshold}\nrevoked = [{revoked}]\n"
        );
        for number in numbers {
            let own = key(*number).trust_file();
            text.push_str(own.split_once("\n\n").unwrap().1);
        }
        Trust::parse(&text)
    }

    #[test]
    fn the_signature_of_rfc_8032_test_1() {
        // Section 7.1: seed and public key of the empty message's test vector.
        let seed =
            from_hex("9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60").unwrap();
        let key = ReleaseKey::from_seed("rfc", &seed);
        assert!(
            key.trust_file()
                .contains("d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a")
        );
        let signature = hex(&key.key.sign(b"").to_bytes());
        assert!(
            signature
                .starts_with("e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e06522490155")
        );
    }

    #[test]
    fn fault_20_every_field_is_bound() {
        let mut signed = manifest();
        key(1).sign(&mut signed);
        let trust = trust(&[1], 1, "").unwrap();
        assert_eq!(trust.check(&signed), Ok(()));
        let changes: [fn(&mut Manifest); 14] = [
            |m| m.stream = StreamName::new("release/other").unwrap(),
            |m| m.version += 1,
            |m| m.sha256[31] ^= 1,
            |m| m.size += 1,
            |m| m.created_unix_ms += 1,
            |m| m.run_id.push('x'),
            |m| m.contract_hash[0] ^= 1,
            |m| m.robot_name.push('x'),
            |m| m.robot_hash[0] ^= 1,
            |m| m.env_steps += 1,
            |m| m.training_commit.push('x'),
            |m| m.config_hash.clear(),
            |m| m.evaluation_json = None,
            // A letter that moves from one field to the next is another message, too.
            |m| {
                m.training_commit = "c".into();
                m.config_hash.clear();
            },
        ];
        for (index, change) in changes.iter().enumerate() {
            let mut other = signed.clone();
            change(&mut other);
            assert!(trust.check(&other).is_err(), "change {index}");
        }
    }

    #[test]
    fn fault_22_unknown_revoked_duplicate_and_too_few_are_refused() {
        let by = |numbers: &[u8]| {
            let mut signed = manifest();
            numbers.iter().for_each(|n| key(*n).sign(&mut signed));
            signed
        };
        let untrusted = |valid, needed| Err(Untrusted { valid, needed });
        let one = trust(&[1], 1, "").unwrap();
        assert_eq!(one.check(&manifest()), untrusted(0, 1));
        assert_eq!(one.check(&by(&[2])), untrusted(0, 1));
        let revoked = trust(&[1, 2], 1, "\"k1\"").unwrap();
        assert_eq!(revoked.check(&by(&[1])), untrusted(0, 1));
        assert_eq!(revoked.check(&by(&[2])), Ok(()));
        let two = trust(&[1, 2, 3], 2, "").unwrap();
        let mut twice = by(&[1]);
        twice.signatures.push(twice.signatures[0].clone());
        assert_eq!(two.check(&twice), untrusted(1, 2));
        assert_eq!(two.check(&by(&[1, 3])), Ok(()));
        // The signature of one key under the name of another.
        let mut renamed = by(&[1]);
        renamed.signatures[0].key_id = "k2".into();
        assert_eq!(two.check(&renamed), untrusted(0, 2));
        // Cut short, or of another length.
        let mut cut = by(&[1]);
        cut.signatures[0].signature.pop();
        assert_eq!(one.check(&cut), untrusted(0, 1));
    }

    #[test]
    fn trust_files_that_would_trust_too_much_are_refused() {
        assert!(trust(&[1], 0, "").is_err(), "nobody needs to sign");
        assert!(trust(&[1], 2, "").is_err(), "can never be met");
        assert!(trust(&[1, 1], 2, "").is_err(), "one key twice");
        assert!(trust(&[1], 1, "\"k1\"").is_err(), "only revoked keys");
        let unknown = trust(&[1, 2], 1, "\"K1\"").unwrap_err();
        assert!(unknown.contains("`K1`"), "{unknown}");
        let roots = |number: usize| {
            let own = key(1).trust_file();
            let root = key(2).trust_lines("root_key");
            Trust::parse(&own.replacen(
                "\n\n",
                &format!("\nroot_threshold = {number}\n\n{root}\n"),
                1,
            ))
        };
        assert!(roots(1).is_ok());
        assert!(roots(0).is_err(), "anybody may name the next file");
        assert!(roots(2).is_err(), "nobody ever could");
        assert!(Trust::parse("format = \"caudata.trust.v2\"\nthreshold = 1\n").is_err());
        let fresh = |revoked: &str, ids: &[u8]| {
            let own = key(1).trust_file();
            let own = own.replacen("\n\n", &format!("\nrevoked = [{revoked}]\n\n"), 1);
            let lines: String = ids.iter().map(|n| key(*n).trust_lines("fresh_key")).collect();
            Trust::parse(&format!("{own}\n{lines}"))
        };
        assert!(fresh("", &[2]).unwrap().knows_fresh_keys());
        assert!(fresh("\"k2\"", &[2]).is_err(), "yesterday's answers would do");
        assert!(fresh("\"k2\"", &[2, 3]).unwrap().knows_fresh_keys());
    }

    #[test]
    fn a_trust_file_that_anybody_may_write_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trust.toml");
        std::fs::write(&path, key(1).trust_file()).unwrap();
        for (mode, taken) in [(0o644, true), (0o664, true), (0o666, false), (0o646, false)] {
            let mode = std::os::unix::fs::PermissionsExt::from_mode(mode);
            std::fs::set_permissions(&path, mode).unwrap();
            assert_eq!(Trust::read(&path).is_ok(), taken);
        }
    }

    #[test]
    fn fault_17_an_answer_of_yesterday_or_by_a_release_key_is_stale() {
        let said = |nonce| Freshness {
            nonce: [nonce; 32],
            stream: manifest().stream,
            label: LabelName::latest(),
            version: 7,
            sha256: [1; 32],
        };
        let server = key(9);
        let text = format!("{}{}", key(1).trust_file(), server.trust_lines("fresh_key"));
        let trust = Trust::parse(&text).unwrap();
        assert!(trust.knows_fresh_keys());
        let check = |answer: &SignedFreshness, nonce: u8| {
            trust.check_fresh(answer, &[nonce; 32], &manifest().stream, &LabelName::latest())
        };
        let answer = server.vouch(said(1));
        assert_eq!(check(&answer, 1), Ok(()));
        // The same answer to the nonce of today.
        let other = |checked| matches!(checked, Err(Stale::OtherQuestion(_)));
        assert!(other(check(&answer, 2)));
        let mut relabelled = answer.clone();
        relabelled.said.nonce = [2; 32];
        assert_eq!(check(&relabelled, 2), Err(Stale::Unsigned));
        for change in [|f: &mut Freshness| f.version = 8, |f: &mut Freshness| f.sha256[0] ^= 1] {
            let mut forged = answer.clone();
            change(&mut forged.said);
            assert_eq!(check(&forged, 1), Err(Stale::Unsigned));
        }
        let mut elsewhere = said(1);
        elsewhere.label = LabelName::new("stable").unwrap();
        assert!(other(check(&server.vouch(elsewhere), 1)));
        // A release key says nothing about labels, and a server's key releases nothing.
        assert_eq!(check(&key(1).vouch(said(1)), 1), Err(Stale::Unsigned));
        let mut by_server = manifest();
        server.sign(&mut by_server);
        assert!(trust.check(&by_server).is_err());
    }

    #[test]
    fn each_step_and_no_other_keeps_its_proof_out() {
        let server = key(9);
        let text = format!("{}{}", key(1).trust_file(), server.trust_lines("fresh_key"));
        let trust = Trust::parse(&text).unwrap();
        let stream = manifest().stream;
        let said = Freshness {
            nonce: [1; 32],
            stream: stream.clone(),
            label: LabelName::latest(),
            version: 7,
            sha256: [1; 32],
        };
        let table = each_left_out(PROOF, |name, checks| {
            let mut answer = server.vouch(said.clone());
            let mut nonce = [1; 32];
            match name {
                "question" => nonce = [2; 32],
                // It says a lower version than was signed.
                _ => answer.said.version = 6,
            }
            let asked = Facts { nonce: Some(&nonce), ..Facts::of_stream(&stream) };
            let proof = Proof { trust: &trust, answer: &answer, asked };
            proof.check(checks)
        });
        // Seen with --nocapture: `make mutants`.
        eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
    }

    #[test]
    fn a_secret_that_others_may_use_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("release.key");
        key(1).write(&path).unwrap();
        for (mode, private) in [
            (0o600, true),
            (0o400, true),
            (0o640, true),
            (0o644, false),
            (0o660, false),
            (0o602, false),
        ] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            let read = ReleaseKey::read(&path, "k1").map(drop);
            let exposed = matches!(read, Err(SigningError::Exposed { .. }));
            assert_eq!((read.is_ok(), exposed), (private, !private), "{mode:o}");
        }
    }

    #[test]
    fn a_key_is_read_by_its_own_name_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("release.key");
        key(1).write(&path).unwrap();
        let other = ReleaseKey::read(&path, "k2").map(drop).unwrap_err().to_string();
        assert!(other.ends_with("this key's name is `k1`, not `k2`"), "{other}");
        // Older files have no name: what is said counts.
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, text.split(' ').next().unwrap()).unwrap();
        let expected = ReleaseKey::from_seed("k2", &[1; 32]).trust_file();
        assert_eq!(ReleaseKey::read(&path, "k2").unwrap().trust_file(), expected);
    }

    #[test]
    fn a_revert_is_bound_and_a_manifest_without_one_is_signed_as_before() {
        let (mut plain, mut back) = (manifest(), manifest());
        back.reverts_to = Some(3);
        assert_ne!(signed_bytes(&plain), signed_bytes(&back));
        key(1).sign(&mut plain);
        back.signatures = plain.signatures;
        assert!(trust(&[1], 1, "").unwrap().check(&back).is_err());
    }
}
