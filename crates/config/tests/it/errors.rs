//! Each way a configuration can be wrong has its own error, and the error names the place.

use caudata_config::{Config, ConfigError, PRESETS, Source};

fn load_text(text: &str) -> Result<Config, ConfigError> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("my.toml");
    std::fs::write(&path, text).unwrap();
    Config::load(&Source::file(&path))
}

fn load_with(assignment: &str) -> Result<Config, ConfigError> {
    Config::load(&Source::default().set(assignment))
}

/// The error's text, checked to be one line.
fn complaint(result: Result<Config, ConfigError>) -> String {
    let text = result.expect_err("must be refused").to_string();
    assert!(!text.contains('\n'), "{text}");
    text
}

#[test]
fn defaults_and_presets_are_valid_and_survive_being_written() {
    let mut sources = vec![Source::default()];
    sources.extend(PRESETS.iter().map(|preset| Source::preset(preset.name)));
    for source in sources {
        let config = Config::load(&source).unwrap();
        assert_eq!(load_text(&config.to_toml().unwrap()).unwrap(), config, "{source:?}");
    }
}

#[test]
fn a_file_without_an_end_is_not_read_to_it() {
    let endless = complaint(Config::load(&Source::file("/dev/zero".as_ref())));
    assert!(endless.contains("more than 1048576 bytes"), "{endless}");
}

#[test]
fn terrain_that_is_not_finite_is_refused() {
    for key in ["size_m", "cell_m", "height_m", "wavelength_m", "patch_friction"] {
        for value in ["inf", "-inf", "nan"] {
            let found = complaint(load_with(&format!("terrain.{key}={value}")));
            assert!(found.contains(&format!("terrain.{key}")), "{found}");
        }
    }
}

#[test]
fn later_layers_win() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("my.toml");
    std::fs::write(&path, "[run]\nseed = 5\niterations = 7\n").unwrap();
    let source = Source {
        preset: Some("quick".into()),
        file: Some(path),
        overrides: vec!["run.seed=6".into()],
    };
    let config = Config::load(&source).unwrap();
    assert_eq!((config.run.name.as_str(), config.run.iterations, config.run.seed), ("quick", 7, 6));
}

#[test]
fn overrides_take_toml_values_and_bare_words() {
    let config = Config::load(
        &Source::default()
            .set("learner.network.policy_hidden=[64, 32]")
            .set("transport.kind=zenoh")
            .set("learner.ppo.gamma = 0.98")
            .set("learner.ppo.max_grad_norm=2"),
    )
    .unwrap();
    assert_eq!(config.learner.network.policy_hidden, [64, 32]);
    assert_eq!(config.transport.kind.name(), "zenoh");
    assert_eq!(config.learner.ppo.gamma, 0.98);
    assert_eq!(config.learner.ppo.max_grad_norm, 2.0);
}

#[test]
fn an_unknown_key_is_named_with_the_nearest_known_one() {
    let text = complaint(load_text("[learner.ppo]\ngama = 0.9\n"));
    assert!(text.contains("unknown key `learner.ppo.gama`"), "{text}");
    assert!(text.contains("did you mean `learner.ppo.gamma`?"), "{text}");
    let text = complaint(load_with("learner.gamma=0.9"));
    assert!(text.contains("did you mean `learner.ppo.gamma`?"), "{text}");
    let text = complaint(load_text("xyzzy = 1\n"));
    assert!(text.contains("unknown key `xyzzy`") && !text.contains("did you mean"), "{text}");
}

#[test]
fn a_wrong_type_names_its_key() {
    let text = complaint(load_with("actors.count=many"));
    assert!(text.contains("`actors.count`") && text.contains("many"), "{text}");
    let text = complaint(load_with("transport.kind=carrier-pigeon"));
    assert!(text.contains("`transport.kind`") && text.contains("iceoryx2"), "{text}");
}

#[test]
fn not_toml_names_file_line_and_column() {
    let error = load_text("[run]\nseed = = 1\n").unwrap_err();
    let ConfigError::Syntax { line, column, .. } = error else { panic!("{error:?}") };
    assert_eq!((line, column), (2, 8));
}

#[test]
fn a_missing_file_a_missing_preset_and_a_bad_override_are_told_apart() {
    let missing = Config::load(&Source::file("/nowhere/at/all.toml".as_ref()));
    assert!(matches!(missing, Err(ConfigError::Read { .. })));
    let text = complaint(Config::load(&Source::preset("fast")));
    assert!(text.contains("quick, flat"), "{text}");
    for bad in ["no-equals-sign", "=1", "a..b=1"] {
        assert!(matches!(load_with(bad), Err(ConfigError::BadOverride(_))), "{bad}");
    }
}

#[test]
fn values_out_of_range_name_key_value_and_rule() {
    let cases = [
        ("run.iterations=0", "run.iterations"),
        ("run.name=a/b", "run.name"),
        ("actors.count=0", "actors.count"),
        ("actors.max_lead=5", "learner.staleness.max_lag"),
        ("learner.ppo.gamma=1", "learner.ppo.gamma"),
        ("learner.ppo.gamma=nan", "learner.ppo.gamma"),
        ("learner.ppo.minibatches=1024", "learner.ppo.minibatches"),
        ("learner.ppo.value_learning_rate=-1", "learner.ppo.value_learning_rate"),
        ("learner.ppo.value_learning_rate=nan", "learner.ppo.value_learning_rate"),
        ("learner.ppo.target_kl_final=0.02", "learner.ppo.target_kl_final"),
        ("learner.network.init_std=9", "learner.network.init_std"),
        ("learner.network.policy_hidden=[]", "learner.network.policy_hidden"),
        ("learner.min_batch_share=0", "learner.min_batch_share"),
        ("learner.starve_timeout_s=1", "learner.starve_timeout_s"),
        ("transport.peer_timeout_ms=500", "transport.peer_timeout_ms"),
        ("engine.substeps=4", "task.control_period_s"),
        ("policy_server.stream=a/b", "policy_server.stream"),
        ("telemetry.trace_every=0", "telemetry.trace_every"),
        // Plain beyond this host, encrypted without certificates, and no address at all.
        ("telemetry.otlp_endpoint=\"http://collector:4317\"", "telemetry.otlp_endpoint"),
        ("telemetry.otlp_endpoint=\"https://collector:4317\"", "telemetry.otlp_endpoint"),
        ("telemetry.otlp_endpoint=\"127.0.0.1:4317\"", "telemetry.otlp_endpoint"),
    ];
    for (assignment, key) in cases {
        // Few steps, so that 1,024 minibatches are too many.
        let source =
            Source::default().set("actors.lanes=2").set("actors.chunk_steps=2").set(assignment);
        match Config::load(&source) {
            Err(ConfigError::OutOfRange { key: named, .. }) => {
                assert_eq!(named, key, "{assignment}")
            }
            other => panic!("{assignment}: {other:?}"),
        }
    }
}

#[test]
fn traces_go_to_this_host_or_are_encrypted() {
    for endpoint in ["http://127.0.0.1:4317", "http://localhost:4317", "http://[::1]:4317"] {
        let config = load_with(&format!("telemetry.otlp_endpoint={endpoint:?}")).unwrap();
        assert_eq!(config.telemetry.otlp_endpoint, endpoint);
    }
    let encrypted = Source::default()
        .set("telemetry.otlp_endpoint=\"https://collector:4317\"")
        .set("cluster.tls_dir=/etc/caudata/tls");
    Config::load(&encrypted).unwrap();
}

#[test]
fn what_other_hosts_reach_is_encrypted() {
    let set = |words: &[&str]| {
        let source = words.iter().fold(Source::default(), |s, word| s.set(*word));
        Config::load(&source)
    };
    let (zenoh, certificates) = ("transport.kind=zenoh", "cluster.tls_dir=pki/{role}");
    for (key, value) in [
        ("transport.zenoh_listen", "[\"tcp/0.0.0.0:7447\"]"),
        ("transport.zenoh_listen", "[\"quic/0.0.0.0:7447\"]"),
        ("transport.zenoh_connect", "[\"tcp/learner.lab:7447\"]"),
        ("transport.zenoh_connect", "[\"learner.lab:7447\"]"),
        ("policy_server.addr", "\"0.0.0.0:7401\""),
    ] {
        let assignment = format!("{key}={value}");
        let text = complaint(set(&[zenoh, &assignment]));
        assert!(text.contains(key), "{text}");
        let with = set(&[zenoh, &assignment, certificates]);
        let encrypted = value.contains("quic/") || key.starts_with("policy_server");
        assert_eq!(with.is_ok(), encrypted, "{assignment}");
    }
    let config = set(&[certificates]).unwrap();
    let folder = config.cluster.certificates("actor");
    assert_eq!(folder.as_deref(), Some("pki/actor".as_ref()));
    assert_eq!(Config::default().cluster.certificates("actor"), None);
}

#[test]
fn the_hash_covers_what_decides_training_and_nothing_else() {
    let hash = |assignment: &str| load_with(assignment).unwrap().hash_hex();
    let base = Config::default().hash_hex();
    for same in
        ["run.iterations=9", "run.name=x", "telemetry.metrics=false", "transport.kind=zenoh"]
    {
        assert_eq!(hash(same), base, "{same}");
    }
    for other in
        ["run.seed=2", "learner.ppo.gamma=0.9", "actors.lanes=2", "engine.solver_iterations=3"]
    {
        assert_ne!(hash(other), base, "{other}");
    }
}

/// An actor on another machine may have a vector width and threads of its own, but no reward of its own.
#[test]
fn two_machines_have_one_world_where_policies_meet_the_same() {
    let world = |assignment: &str| load_with(assignment).unwrap().world();
    let base = Config::default().world();
    for same in ["run.seed=2", "actors.lanes=2", "learner.ppo.gamma=0.9", "engine.lane_width=4"] {
        assert_eq!(world(same), base, "{same}");
    }
    for other in [
        "task.reward.weights.alive=1000",
        "engine.self_collision=true",
        "terrain.kind=rough",
        "task.critic.sees=[\"push\"]",
    ] {
        assert_ne!(world(other), base, "{other}");
    }
    assert_ne!(base.seal([1; 32]), base.seal([2; 32]));
}
