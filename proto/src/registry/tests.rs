//! Round trips and refusals of the registry's messages.

use super::*;
use crate::wire::registry as pb;

fn manifest() -> Manifest {
    Manifest {
        stream: StreamName::new("polymander/flat").unwrap(),
        version: 3,
        sha256: [1; 32],
        size: 900_000,
        created_unix_ms: 1_770_000_000_000,
        run_id: "2026-01-01_quick".into(),
        contract_hash: [2; 32],
        robot_name: "polymander".into(),
        robot_hash: [3; 32],
        env_steps: 1_000_000,
        training_commit: "abc123".into(),
        config_hash: "def456".into(),
        evaluation_json: Some(r#"{"speed_mps": 0.3}"#.into()),
        reverts_to: Some(2),
        signatures: vec![Signature { key_id: "release-1".into(), signature: vec![9; 64] }],
    }
}

fn label() -> LabelState {
    LabelState {
        stream: manifest().stream,
        label: LabelName::new("canary").unwrap(),
        version: 3,
        generation: 8,
        by: "operator:ana".into(),
        override_reason: None,
        unix_ms: 5,
    }
}

fn quarantined() -> QuarantineState {
    QuarantineState {
        stream: manifest().stream,
        version: 2,
        reason: "falls on gravel".into(),
        by: "local".into(),
        generation: 9,
        unix_ms: 6,
    }
}

fn report() -> RobotReport {
    RobotReport {
        robot: "robot-1".into(),
        stream: manifest().stream,
        version: 3,
        sha256: [1; 32],
        state: RobotState::Failed,
        reason: "fell".into(),
        walked_s: 3.5,
        falls: 1,
        attempts: 2,
        unix_ms: 7,
    }
}

/// To the wire and back.
fn round_trip<W, T>(value: &T)
where
    T: Clone + PartialEq + std::fmt::Debug + TryFrom<W, Error = RegistryError>,
    W: From<T>,
{
    assert_eq!(&T::try_from(W::from(value.clone())).unwrap(), value);
}

// What only the server says; it says it piece by piece.

impl From<FetchPart> for pb::FetchResponse {
    fn from(part: FetchPart) -> Self {
        let info = |status, i: Option<FetchInfo>| {
            pb::fetch_response::Part::Info(pb::FetchInfo {
                status: i32::from(status),
                sha256: i.as_ref().map(|i| i.sha256.to_vec()).unwrap_or_default(),
                size: i.as_ref().map_or(0, |i| i.size),
                offset: i.as_ref().map_or(0, |i| i.offset),
            })
        };
        let part = match part {
            FetchPart::Data(data) => pb::fetch_response::Part::Data(data.into()),
            FetchPart::NotModified => info(pb::fetch_info::Status::NotModified, None),
            FetchPart::Info(i) => info(pb::fetch_info::Status::ContentFollows, Some(i)),
        };
        Self { part: Some(part) }
    }
}

impl From<WatchEvent> for pb::WatchEvent {
    fn from(e: WatchEvent) -> Self {
        let event = match e.change {
            WatchChange::Snapshot(manifests) => pb::watch_event::Event::Snapshot(pb::Snapshot {
                manifests: manifests.into_iter().map(Into::into).collect(),
            }),
            WatchChange::Published(m) => pb::watch_event::Event::Published((*m).into()),
            WatchChange::Progress => pb::watch_event::Event::Progress(pb::Progress {}),
            WatchChange::LabelMoved(s) => pb::watch_event::Event::LabelMoved((*s).into()),
            WatchChange::Quarantined(s) => pb::watch_event::Event::Quarantined((*s).into()),
        };
        Self { generation: e.generation, event: Some(event) }
    }
}

#[test]
fn every_message_survives_the_round_trip() {
    let bare =
        Manifest { evaluation_json: None, reverts_to: None, signatures: vec![], ..manifest() };
    let stream = manifest().stream;
    round_trip::<pb::Manifest, _>(&manifest());
    round_trip::<pb::Manifest, _>(&bare);
    round_trip::<pb::PublishResponse, _>(&Published {
        manifest: manifest(),
        generation: 5,
        already_present: true,
    });
    for stream in [None, Some(stream.clone())] {
        round_trip::<pb::ListRequest, _>(&ListRequest {
            stream: stream.clone(),
            limit: 10,
            below_version: Some(0),
        });
        round_trip::<pb::WatchRequest, _>(&WatchRequest { stream, since_generation: 8 });
    }
    round_trip::<pb::ListResponse, _>(&ListPage {
        manifests: vec![manifest(), bare.clone()],
        generation: 6,
        more: true,
    });
    for version in [None, Some(0), Some(7)] {
        let request = ManifestRequest { stream: stream.clone(), version, label: None };
        round_trip::<pb::GetManifestRequest, _>(&request);
    }
    round_trip::<pb::GetManifestRequest, _>(&ManifestRequest {
        stream: stream.clone(),
        version: None,
        label: Some(LabelName::latest()),
    });
    round_trip::<pb::SetLabelRequest, _>(&SetLabel {
        stream: stream.clone(),
        label: LabelName::new("stable").unwrap(),
        version: 3,
        expected_generation: 9,
        override_reason: Some("für die Vorführung".into()),
    });
    round_trip::<pb::RobotReport, _>(&report());
    round_trip::<pb::FreshnessResponse, _>(&SignedFreshness {
        said: Freshness {
            nonce: [7; 32],
            stream: stream.clone(),
            label: LabelName::latest(),
            version: 3,
            sha256: [1; 32],
        },
        signature: manifest().signatures[0].clone(),
    });
    round_trip::<pb::OverviewResponse, _>(&Overview {
        labels: vec![label()],
        quarantined: vec![quarantined()],
        reports: vec![report()],
        generation: 12,
        read_only: Some("sync failed".into()),
    });
    for if_none_match in [None, Some([4; 32])] {
        let request = FetchRequest { sha256: [1; 32], offset: 65_536, if_none_match };
        round_trip::<pb::FetchRequest, _>(&request);
    }
    for part in [
        FetchPart::NotModified,
        FetchPart::Info(FetchInfo { sha256: [1; 32], size: 10, offset: 10 }),
        FetchPart::Data(vec![1, 2, 3]),
    ] {
        round_trip::<pb::FetchResponse, _>(&part);
    }
    for change in [
        WatchChange::Snapshot(vec![bare]),
        WatchChange::Published(Box::new(manifest())),
        WatchChange::Progress,
        WatchChange::LabelMoved(Box::new(label())),
        WatchChange::Quarantined(Box::new(quarantined())),
    ] {
        round_trip::<pb::WatchEvent, _>(&WatchEvent { generation: 4, change });
    }
}

#[test]
fn stream_names_are_safe_as_paths() {
    for good in ["flat", "polymander/flat", "a/b/c-1_2.x"] {
        assert_eq!(StreamName::new(good).unwrap().to_string(), good);
    }
    let long = "x".repeat(65);
    for bad in ["", "/", "/a", "a/", "a//b", "..", "a/../b", ".hidden", "A", "a b", "a\0", &long] {
        assert_eq!(StreamName::new(bad), Err(RegistryError::StreamName), "{bad:?}");
    }
}

#[test]
fn manifests_that_cannot_be_are_refused_by_name() {
    let refused = |change: fn(&mut pb::Manifest)| {
        let mut wire = pb::Manifest::from(manifest());
        change(&mut wire);
        Manifest::try_from(wire).unwrap_err()
    };
    let range = |field, found, min, max| RegistryError::Range { field, found, min, max };
    assert_eq!(refused(|m| m.size = 0), range("size", 0, 1, MAX_POLICY_BYTES));
    assert_eq!(
        refused(|m| m.size = (8 << 20) + 1),
        range("size", (8 << 20) + 1, 1, MAX_POLICY_BYTES)
    );
    assert_eq!(
        refused(|m| m.sha256.truncate(20)),
        RegistryError::HashLength { field: "sha256", found: 20 }
    );
    assert_eq!(
        refused(|m| m.run_id.clear()),
        RegistryError::Text { field: "run_id", min: 1, max: 128 }
    );
    assert_eq!(
        refused(|m| m.training_commit = "a\nb".into()),
        RegistryError::Text { field: "training_commit", min: 0, max: 64 }
    );
    assert_eq!(
        refused(|m| m.signatures = vec![m.signatures[0].clone(); 17]),
        range("signatures", 17, 0, 16)
    );
    assert_eq!(refused(|m| m.signatures[0].signature.clear()), range("signature", 0, 1, 512));
    for bad in ["[1]", "{", "{} {}", "null"] {
        let mut wire = pb::Manifest::from(manifest());
        wire.evaluation_json = bad.into();
        assert_eq!(Manifest::try_from(wire), Err(RegistryError::Evaluation), "{bad}");
    }
}

#[test]
fn fetched_pieces_are_bounded_and_never_empty() {
    let data = |bytes| {
        FetchPart::try_from(pb::FetchResponse {
            part: Some(pb::fetch_response::Part::Data(vec![0; bytes].into())),
        })
    };
    assert!(data(FETCH_CHUNK_BYTES).is_ok());
    assert!(data(FETCH_CHUNK_BYTES + 1).is_err());
    assert!(data(0).is_err(), "an endless stream of nothing must not look like progress");
    let beyond = FetchInfo { sha256: [0; 32], size: 10, offset: 11 };
    let beyond = pb::FetchResponse::from(FetchPart::Info(beyond));
    assert!(FetchPart::try_from(beyond).is_err());
    let none = FetchPart::try_from(pb::FetchResponse { part: None });
    assert_eq!(none, Err(RegistryError::Missing { field: "part" }));
}

#[test]
fn labels_are_safe_as_file_names_and_reasons_are_one_line() {
    for good in ["latest", "canary", "stable", "demo-2026"] {
        assert_eq!(LabelName::new(good).unwrap().as_str(), good);
    }
    for bad in ["", "../x", "A", "a/b", "a b", &"x".repeat(33)] {
        assert!(LabelName::new(bad).is_err(), "{bad}");
    }
    let mut wire = pb::RobotReport::from(report());
    wire.reason = String::new();
    assert!(RobotReport::try_from(wire.clone()).is_err(), "a Nack says why");
    wire.reason = "two\nlines".into();
    assert!(RobotReport::try_from(wire.clone()).is_err());
    wire.reason = "fell".into();
    wire.walked_s = f64::NAN;
    assert!(RobotReport::try_from(wire).is_err());
    for (walked_s, taken) in [(0.0, false), (9.9, false), (10.0, true), (1e18, false)] {
        let good =
            pb::RobotReport::from(RobotReport { state: RobotState::Good, walked_s, ..report() });
        assert_eq!(RobotReport::try_from(good).is_ok(), taken, "{walked_s}");
    }
    let mut both = pb::GetManifestRequest::from(ManifestRequest {
        stream: manifest().stream,
        version: Some(1),
        label: None,
    });
    both.label = "stable".into();
    assert!(ManifestRequest::try_from(both).is_err());
    let mut forward = pb::Manifest::from(manifest());
    forward.reverts_to = Some(forward.version);
    assert!(Manifest::try_from(forward).is_err(), "back means down");
}

#[test]
fn states_have_the_numbers_of_the_wire() {
    for (number, state) in (1..).zip(RobotState::ALL) {
        let wire = pb::robot_report::State::try_from(number).unwrap();
        assert_eq!(wire.as_str_name().to_lowercase(), state.name());
        assert_eq!((state.number(), RobotState::of_number(number)), (number, Some(state)));
    }
    assert!([0, 6, -1].into_iter().all(|number| RobotState::of_number(number).is_none()));
}
