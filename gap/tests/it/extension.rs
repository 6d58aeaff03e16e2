//! Extended robot files: written, read back, refused where they are wrong.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use caudata_gap::effects::{self, Place};
use caudata_gap::extension::{self, Extension, ExtensionEffect, ExtensionParameter};
use caudata_gap::replay::Term;
use caudata_model::RobotModel;
use caudata_sim::batch::BatchEngine;
use caudata_sim::{EngineConfig, LaneParams, Terrain, TerrainConfig};

fn files() -> (String, Vec<u8>) {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    (
        std::fs::read_to_string(dir.join("polymander.robot.toml")).unwrap(),
        std::fs::read(dir.join("polymander.xml")).unwrap(),
    )
}

fn load(toml: &str) -> Result<Arc<RobotModel>, String> {
    let (_, mjcf) = files();
    RobotModel::from_bytes("r.robot.toml", toml.as_bytes(), &mjcf)
        .map(Arc::new)
        .map_err(|e| e.to_string())
}

/// The front left knee's loop at 80 %.
fn soft_knee(model: &Arc<RobotModel>) -> Extension {
    let effect = effects::find("kp_error").unwrap();
    let names = vec!["FL_knee".to_owned()];
    let place = Place::named(model, effect.domain, &names).unwrap();
    let term = Term { effect, place, values: vec![0.8] };
    let value = ExtensionParameter {
        value: 0.8,
        unit: String::new(),
        ci_low: 0.78,
        ci_high: 0.82,
        at_bound: false,
    };
    Extension {
        base: model.hash_hex(),
        effect: vec![ExtensionEffect {
            id: "kp_error".to_owned(),
            location: names,
            confidence: 0.9,
            alternatives: vec!["stale_gains".to_owned()],
            elsewhere: vec![vec!["FR_knee".to_owned()]],
            evidence: vec!["the droop".to_owned()],
            parameters: BTreeMap::from([("scale".to_owned(), value)]),
            randomise: BTreeMap::from([("scale".to_owned(), [0.77, 0.83])]),
        }],
        lane: extension::lane(model, &[term]),
        ..Extension::default()
    }
}

#[test]
fn written_and_read_back() {
    let (toml, _) = files();
    let plain = load(&toml).unwrap();
    let written = soft_knee(&plain);
    // 15 N·m/rad at 80 %
    assert_eq!(written.lane, BTreeMap::from([("kp_nm_per_rad.FL_knee".to_owned(), 12.0)]));
    let text = extension::append(&written, &toml).unwrap();
    assert_eq!(extension::read(&text).unwrap(), Some(written.clone()));
    let extended = load(&text).unwrap();
    assert_eq!(extended.extension(), Some(&written));
    // policy order: eight of spine and tail, FL_hip, FL_knee
    let lane = LaneParams::nominal(&extended);
    assert_eq!((lane.kp_nm_per_rad[8], lane.kp_nm_per_rad[9]), (15.0, 12.0));
    assert_eq!(LaneParams::bare(&extended), LaneParams::nominal(&plain));
    let terms = extension::terms(&written, &plain).unwrap();
    assert_eq!((terms.len(), terms[0].values.clone()), (1, vec![0.8]));
    // once more: replaced, not doubled
    assert_eq!(extension::append(&written, &text).unwrap(), text);
    assert_eq!(extension::read(&toml).unwrap(), None);
}

#[test]
fn what_does_not_fit_is_refused() {
    let (toml, _) = files();
    let plain = load(&toml).unwrap();
    let good = soft_knee(&plain);
    let mut unknown = good.clone();
    unknown.effect[0].id = "gremlins".to_owned();
    let message = extension::terms(&unknown, &plain).unwrap_err().to_string();
    assert!(message.contains("`gremlins`"), "{message}");
    let mut nowhere = good.clone();
    nowhere.effect[0].location = vec!["wing".to_owned()];
    assert!(extension::terms(&nowhere, &plain).unwrap_err().to_string().contains("wing"));
    let text = extension::append(&good, &toml).unwrap();
    let message = load(&text.replace("[extension]", "[extension]\nsurprise = 1")).unwrap_err();
    assert!(message.contains("surprise"), "{message}");
    // engines refuse parameters that do not exist
    let mut odd = good;
    odd.lane.insert("kp_nm_per_rad.wing".to_owned(), 1.0);
    let model = load(&extension::append(&odd, &toml).unwrap()).unwrap();
    let ground = Arc::new(Terrain::generate(&TerrainConfig::default(), 1).unwrap());
    let built = BatchEngine::new(model, 1, EngineConfig::default(), ground, 1);
    let message = built.err().unwrap().to_string();
    assert!(message.contains("kp_nm_per_rad.wing"), "{message}");
}
