//! Kubernetes, Compose, systemd and Slurm files against each other, against `docker/cluster.toml`, and
//! against the programs' flags.

use std::collections::{BTreeMap, BTreeSet};

use caudata_launch_tests::{flags_of, has_tool, program, read, repository, skipped, yaml};
use serde_json::Value;

const BASE: [&str; 5] =
    ["namespace.yaml", "learner.yaml", "actors.yaml", "policy-server.yaml", "network-policy.yaml"];

/// API groups of the kinds that are used, as the Kubernetes API reference (1.29) has them.
const KINDS: [(&str, &str); 7] = [
    ("Namespace", "v1"),
    ("Service", "v1"),
    ("ConfigMap", "v1"),
    ("StatefulSet", "apps/v1"),
    ("Deployment", "apps/v1"),
    ("PodDisruptionBudget", "policy/v1"),
    ("NetworkPolicy", "networking.k8s.io/v1"),
];

/// `docker/cluster.toml`; `cluster().text("a.b")` is one of its values.
struct Cluster(toml::Table);

fn cluster() -> Cluster {
    Cluster(read("docker/cluster.toml").unwrap().parse().unwrap())
}

impl Cluster {
    fn get(&self, key: &str) -> &toml::Value {
        let (section, name) = key.split_once('.').unwrap();
        &self.0[section][name]
    }

    fn text(&self, key: &str) -> &str {
        self.get(key).as_str().unwrap()
    }

    /// The port at the end of an address.
    fn port(&self, key: &str) -> u64 {
        self.text(key).rsplit(':').next().unwrap().parse().unwrap()
    }
}

/// Whether the programs take `docker/cluster.toml` with these keys set.
fn check_configuration(sets: &[String], place: &str) {
    let Some(caudata) = program("caudata") else {
        return skipped(&format!(
            "caudata is not built; the configuration in {place} is not checked"
        ));
    };
    let mut command = std::process::Command::new(caudata);
    command.args(["config", "check", "--config"]);
    command.arg(repository().join("docker/cluster.toml"));
    for set in sets {
        command.args(["--set", set]);
    }
    let output = command.current_dir(repository()).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{place}: {errors}");
}

/// All documents of the base and of the router component.
fn documents() -> Vec<Value> {
    let base = BASE.map(|file| format!("docker/kubernetes/base/{file}"));
    let router = "docker/kubernetes/components/router/router.yaml".to_owned();
    base.into_iter().chain([router]).flat_map(|file| yaml(&read(&file).unwrap()).unwrap()).collect()
}

fn name(document: &Value) -> &str {
    document["metadata"]["name"].as_str().unwrap()
}

fn text(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}

fn list(value: &Value) -> Vec<Value> {
    value.as_array().cloned().unwrap_or_default()
}

/// Deployments and stateful sets.
fn workloads() -> Vec<Value> {
    let is_workload = |d: &Value| matches!(text(&d["kind"]), "Deployment" | "StatefulSet");
    documents().into_iter().filter(is_workload).collect()
}

fn pod(workload: &Value) -> &Value {
    &workload["spec"]["template"]["spec"]
}

/// Image `caudata/X[:tag]` runs the program `caudata-X`.
fn program_of(image: &str) -> Option<String> {
    let name = image.strip_prefix("caudata/")?.split(':').next()?;
    Some(format!("caudata-{name}"))
}

/// Holds a command line against `--help` of the program and its `--set` flags against the configuration.
fn check_arguments(program: &str, subcommand: &[&str], arguments: &[String], place: &str) {
    let mut sets = Vec::new();
    let mut words = arguments.iter();
    let mut used = Vec::new();
    while let Some(word) = words.next() {
        let Some(word) = word.strip_prefix("--") else {
            continue;
        };
        let (flag, value) = match word.split_once('=') {
            Some((flag, value)) => (flag, value.to_owned()),
            None => (word, words.clone().next().cloned().unwrap_or_default()),
        };
        used.push(format!("--{flag}"));
        if flag == "set" {
            sets.push(value);
        }
    }
    check_configuration(&sets, place);
    match flags_of(program, subcommand).unwrap() {
        None => skipped(&format!("{program} is not built; its flags in {place} are not checked")),
        Some(known) => {
            for flag in used {
                assert!(known.contains(&flag), "{place}: {program} has no flag {flag}");
            }
        }
    }
}

fn strings(value: &Value) -> Vec<String> {
    list(value).iter().map(|v| text(v).to_owned()).collect()
}

#[test]
fn the_configuration_of_the_cluster_is_valid_and_meant_for_several_hosts() {
    check_configuration(&[], "docker/cluster.toml");
    let config = cluster();
    assert_eq!(config.text("transport.kind"), "zenoh");
    assert!(!config.text("cluster.tls_dir").is_empty());
    for endpoint in config.get("transport.zenoh_listen").as_array().unwrap() {
        assert!(endpoint.as_str().unwrap().starts_with("quic/"), "{endpoint}");
    }
    assert!(config.text("cluster.policy_server").starts_with("https://"));
}

#[test]
fn every_document_has_a_known_kind_and_its_own_name() {
    let mut seen = BTreeSet::new();
    for document in documents() {
        let kind = text(&document["kind"]).to_owned();
        let (_, version) = KINDS.iter().find(|(k, _)| *k == kind).unwrap_or_else(|| {
            panic!("unknown kind {kind}");
        });
        assert_eq!(text(&document["apiVersion"]), *version, "{kind}");
        assert!(seen.insert((kind.clone(), name(&document).to_owned())), "{kind} twice");
    }
}

#[test]
fn containers_run_our_programs_with_flags_that_they_have() {
    for workload in workloads() {
        for container in list(&pod(&workload)["containers"]) {
            let image = text(&container["image"]);
            if let Some(program) = program_of(image) {
                check_arguments(&program, &[], &strings(&container["args"]), name(&workload));
            }
        }
    }
}

/// The router is the library of Cargo.lock as a program.
#[test]
fn the_router_has_the_version_of_the_library() {
    let lock = read("Cargo.lock").unwrap();
    let version = lock
        .split("[[package]]")
        .find(|package| package.contains("\nname = \"zenoh\"\n"))
        .and_then(|package| package.split("version = \"").nth(1)?.split('"').next())
        .unwrap();
    let router = read("docker/kubernetes/components/router/router.yaml").unwrap();
    assert!(router.contains(&format!("eclipse/zenoh:{version}")), "{version}");
}

#[test]
fn containers_have_no_privileges_and_a_bound_on_memory() {
    for workload in workloads() {
        let place = name(&workload);
        let pod = pod(&workload);
        assert_eq!(pod["automountServiceAccountToken"], false, "{place}");
        assert_eq!(pod["securityContext"]["runAsNonRoot"], true, "{place}");
        assert_eq!(pod["securityContext"]["seccompProfile"]["type"], "RuntimeDefault", "{place}");
        for container in list(&pod["containers"]) {
            let security = &container["securityContext"];
            assert_eq!(security["allowPrivilegeEscalation"], false, "{place}");
            assert_eq!(security["readOnlyRootFilesystem"], true, "{place}");
            assert_eq!(strings(&security["capabilities"]["drop"]), ["ALL"], "{place}");
            let resources = &container["resources"];
            assert!(!resources["requests"]["cpu"].is_null(), "{place}");
            assert!(!resources["requests"]["memory"].is_null(), "{place}");
            assert!(!resources["limits"]["memory"].is_null(), "{place}");
            assert!(!container["livenessProbe"].is_null(), "{place}");
        }
    }
}

/// Services lead to ports that pods have, pods have the ports of the configuration, volumes are there.
#[test]
fn ports_volumes_and_selectors_meet() {
    let config = cluster();
    let listen = config.get("transport.zenoh_listen")[0].as_str().unwrap();
    let listen: u64 = listen.rsplit(':').next().unwrap().parse().unwrap();
    let ports = [
        ("caudata-learner", "rollouts", listen),
        ("caudata-learner", "metrics", config.port("telemetry.metrics_addr")),
        ("caudata-policy-server", "grpc", config.port("policy_server.addr")),
    ];
    let workloads: BTreeMap<String, Value> =
        workloads().into_iter().map(|workload| (name(&workload).to_owned(), workload)).collect();
    let port_of = |workload: &Value, port: &str| {
        let containers = list(&pod(workload)["containers"]);
        let ports = containers.iter().flat_map(|c| list(&c["ports"]));
        let mut found = ports.filter(|p| text(&p["name"]) == port);
        found.next().and_then(|p| p["containerPort"].as_u64())
    };
    for (workload, port, number) in ports {
        assert_eq!(port_of(&workloads[workload], port), Some(number), "{workload} {port}");
    }
    for service in documents().iter().filter(|d| d["kind"] == "Service") {
        let app = text(&service["spec"]["selector"]["app.kubernetes.io/name"]).to_owned();
        for port in list(&service["spec"]["ports"]) {
            let target = text(&port["targetPort"]);
            let found = port_of(&workloads[&app], target);
            assert_eq!(found, port["port"].as_u64(), "{} {target}", name(service));
        }
    }
    for (place, workload) in &workloads {
        let labels = &workload["spec"]["template"]["metadata"]["labels"];
        assert_eq!(&workload["spec"]["selector"]["matchLabels"], labels, "{place}");
        let claims = list(&workload["spec"]["volumeClaimTemplates"]);
        let volumes: BTreeSet<String> = list(&pod(workload)["volumes"])
            .iter()
            .map(|v| text(&v["name"]).to_owned())
            .chain(claims.iter().map(|c| name(c).to_owned()))
            .collect();
        for container in list(&pod(workload)["containers"]) {
            for mount in list(&container["volumeMounts"]) {
                assert!(volumes.contains(text(&mount["name"])), "{place}: {mount}");
            }
        }
    }
}

#[test]
fn network_policies_and_the_disruption_budget_speak_of_pods_that_exist() {
    let apps: BTreeSet<String> = workloads().iter().map(|w| name(w).to_owned()).collect();
    fn selectors(value: &Value, found: &mut Vec<String>) {
        match value {
            Value::Object(map) => {
                if let Some(app) = map.get("app.kubernetes.io/name").and_then(Value::as_str) {
                    found.push(app.to_owned());
                }
                map.values().for_each(|inner| selectors(inner, found));
            }
            Value::Array(items) => items.iter().for_each(|inner| selectors(inner, found)),
            _ => {}
        }
    }
    let mut checked = 0;
    for document in documents() {
        if matches!(text(&document["kind"]), "NetworkPolicy" | "PodDisruptionBudget") {
            let mut found = Vec::new();
            selectors(&document["spec"], &mut found);
            for app in found {
                assert!(apps.contains(&app), "{}: no pods {app}", name(&document));
                checked += 1;
            }
        }
    }
    assert!(checked >= 10, "{checked}");
    let denies_all = documents().into_iter().any(|d| {
        d["kind"] == "NetworkPolicy"
            && d["spec"]["podSelector"] == serde_json::json!({})
            && d["spec"]["ingress"].is_null()
            && d["spec"]["egress"].is_null()
            && list(&d["spec"]["policyTypes"]).len() == 2
    });
    assert!(denies_all, "what is not allowed is denied");
}

/// The secrets that pods mount are those that the README makes.
#[test]
fn every_secret_is_one_that_the_readme_makes() {
    let readme = read("docker/README.md").unwrap();
    let parts = readme
        .lines()
        .find_map(|line| line.strip_prefix("for part in ")?.strip_suffix("; do"))
        .unwrap();
    let made: BTreeSet<String> =
        parts.split_whitespace().map(|part| format!("caudata-{part}-tls")).collect();
    for workload in workloads() {
        for volume in list(&pod(&workload)["volumes"]) {
            if let Some(secret) = volume["secret"]["secretName"].as_str() {
                assert!(made.contains(secret), "{}: {secret}", name(&workload));
            }
        }
    }
}

/// A process may take as long to end as it says it needs.
#[test]
fn time_to_end_is_longer_than_what_the_programs_need() {
    /// `actors.flush_timeout_s` by default (docs/reference/configuration.md).
    const FLUSH_S: f64 = 10.0;
    let grace = |app: &str| {
        let workloads = workloads();
        let workload = workloads.iter().find(|w| name(w) == app).unwrap();
        pod(workload)["terminationGracePeriodSeconds"].as_f64().unwrap()
    };
    assert!(grace("caudata-actor") > FLUSH_S + 5.0);
    // 60 s: the deadline after which a process ends itself (crates/telemetry/src/stop.rs).
    assert!(grace("caudata-learner") > 60.0);
}

#[test]
fn the_run_has_one_name_everywhere() {
    let run_id = cluster().text("cluster.run_id").to_owned();
    let compose = yaml(&read("docker/compose/compose.yaml").unwrap()).unwrap();
    let mut arguments: Vec<String> = compose[0]["services"]
        .as_object()
        .unwrap()
        .values()
        .flat_map(|service| strings(&service["command"]))
        .collect();
    for workload in workloads() {
        for container in list(&pod(&workload)["containers"]) {
            arguments.extend(strings(&container["args"]));
        }
    }
    arguments.extend(
        read("docker/systemd/caudata-learner.service")
            .unwrap()
            .split_whitespace()
            .map(str::to_owned),
    );
    let ids: Vec<&str> =
        arguments.iter().filter_map(|argument| argument.strip_prefix("--run-id=")).collect();
    assert!(ids.len() >= 5, "{ids:?}");
    assert!(ids.iter().all(|id| *id == run_id), "{ids:?}");
}

#[test]
fn compose_runs_our_programs_with_flags_that_they_have() {
    let compose = yaml(&read("docker/compose/compose.yaml").unwrap()).unwrap();
    let services = compose[0]["services"].as_object().unwrap();
    assert_eq!(services.len(), 3);
    for (service, body) in services {
        let program = program_of(text(&body["image"])).unwrap();
        let arguments: Vec<String> = strings(&body["command"])
            .into_iter()
            // What Compose puts in where the variable is not set.
            .map(|word| word.replace("${ACTORS_CONNECT:-", "").replace("7447\"]}", "7447\"]"))
            .collect();
        check_arguments(&program, &[], &arguments, service);
        assert_eq!(strings(&body["cap_drop"]), ["ALL"], "the shared part reaches {service}");
        let mounts = strings(&body["volumes"]);
        assert!(
            mounts.iter().any(|mount| mount.contains(":/etc/caudata/tls/")),
            "{service} has no certificates"
        );
    }
}

#[test]
fn units_run_our_programs_with_flags_that_they_have() {
    for unit in [
        "caudata-learner",
        "caudata-policy-server",
        "caudata-actors@",
        "caudata-pki-renew",
        "caudata-robot-agent",
        "caudata-robot-rt",
    ] {
        let text = read(&format!("docker/systemd/{unit}.service")).unwrap();
        // what a timer starts is not enabled
        let sections = ["[Unit]", "[Service]", "[Install]"];
        let timed = unit == "caudata-pki-renew";
        for section in &sections[..if timed { 2 } else { 3 }] {
            assert!(text.contains(section), "{unit}: {section}");
        }
        let command = text.lines().find_map(|line| line.strip_prefix("ExecStart=")).unwrap();
        let mut words = command.split_whitespace().map(|word| word.replace("=\"/", "=/"));
        let program = words.next().unwrap();
        let program = program.strip_prefix("/opt/caudata/bin/").unwrap().to_owned();
        let mut arguments: Vec<String> = words.map(|word| word.replace('"', "")).collect();
        let subcommand: Vec<String> =
            arguments.iter().take_while(|word| !word.starts_with("--")).cloned().collect();
        arguments.drain(..subcommand.len());
        let subcommand: Vec<&str> = subcommand.iter().map(String::as_str).collect();
        check_arguments(&program, &subcommand, &arguments, unit);
        assert!(text.contains("\nUser=caudata\n") && text.contains("\nNoNewPrivileges=yes\n"));
    }
}

/// The commands in the README are ones that the command line has.
#[test]
fn the_readme_s_commands_have_flags_that_exist() {
    let readme = read("docker/README.md").unwrap();
    for (subcommand, at_least) in [(["pki", "init"], 1), (["pki", "issue"], 5)] {
        let start = format!("caudata {} {} ", subcommand[0], subcommand[1]);
        let lines: Vec<&str> = readme.lines().filter(|line| line.starts_with(&start)).collect();
        assert!(lines.len() >= at_least, "{start}");
        for line in lines {
            let arguments: Vec<String> =
                line.split_whitespace().skip(3).map(str::to_owned).collect();
            check_arguments("caudata", &subcommand, &arguments, "docker/README.md");
        }
    }
}

#[test]
fn overlays_build() {
    if !has_tool("kubectl") {
        return skipped("kubectl is not installed");
    }
    for (overlay, actors, kinds) in [("cpu", 8, 14), ("gpu", 128, 18)] {
        let output = std::process::Command::new("kubectl")
            .args(["kustomize", "--load-restrictor", "LoadRestrictionsNone"])
            .arg(repository().join("docker/kubernetes/overlays").join(overlay))
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{overlay}: {errors}");
        let built = yaml(&String::from_utf8(output.stdout).unwrap()).unwrap();
        assert_eq!(built.len(), kinds, "{overlay}");
        let find = |kind: &str, wanted: &str| {
            let mut found = built.iter().filter(|d| d["kind"] == kind && name(d) == wanted);
            found.next().unwrap_or_else(|| panic!("{overlay}: {kind} {wanted}"))
        };
        assert_eq!(find("Deployment", "caudata-actor")["spec"]["replicas"], actors);
        let learner = find("StatefulSet", "caudata-learner");
        let container = &pod(learner)["containers"][0];
        let arguments = strings(&container["args"]);
        check_arguments("caudata-learner", &[], &arguments, overlay);
        let routed = arguments.iter().any(|a| a.contains("caudata-router"));
        let gpu = &container["resources"]["limits"]["nvidia.com/gpu"];
        assert_eq!((routed, gpu.is_null()), (overlay == "gpu", overlay == "cpu"));
        // The configuration is in the cluster as it is in the repository.
        let map = built
            .iter()
            .find(|d| d["kind"] == "ConfigMap" && name(d).starts_with("caudata-cluster-"));
        let text = text(&map.unwrap()["data"]["cluster.toml"]).to_owned();
        assert_eq!(text, read("docker/cluster.toml").unwrap());
    }
}

/// Every metric that a dashboard or an alert asks for is one that a program registers.
#[test]
fn dashboards_and_alerts_ask_for_metrics_that_exist() {
    let registered = registered_metrics();
    assert!(registered.len() > 30, "{registered:?}");
    let dashboard: Value =
        serde_json::from_str(&read("docker/monitoring/dashboard.json").unwrap()).unwrap();
    let alerts = yaml(&read("docker/monitoring/alerts.yaml").unwrap()).unwrap();
    let mut expressions = Vec::new();
    for panel in list(&dashboard["panels"]) {
        for target in list(&panel["targets"]) {
            expressions.push((text(&panel["title"]).to_owned(), text(&target["expr"]).to_owned()));
        }
    }
    for group in list(&alerts[0]["groups"]) {
        for rule in list(&group["rules"]) {
            let place = text(&rule["alert"]).to_owned();
            assert!(!text(&rule["annotations"]["action"]).is_empty(), "{place}: what to do?");
            expressions.push((place, text(&rule["expr"]).to_owned()));
        }
    }
    assert!(expressions.len() > 30);
    for (place, expression) in expressions {
        let names = expression
            .split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'))
            .filter(|word| word.starts_with("caudata_"));
        for name in names {
            let histogram =
                ["_sum", "_count", "_bucket"].iter().find_map(|suffix| name.strip_suffix(suffix));
            let known = registered.contains(name)
                || histogram.is_some_and(|base| registered.contains(base));
            assert!(known, "{place}: no program registers {name}");
        }
    }
}

/// Names in the calls that register metrics. The learner's registry is private to a crate that needs
/// libtorch, so the source is read.
fn registered_metrics() -> BTreeSet<String> {
    let files = [
        "learner/src/train/metrics.rs",
        "actor/src/metrics.rs",
        "policy_server/src/metrics.rs",
        "deploy/src/metrics.rs",
    ];
    files
        .iter()
        .flat_map(|file| {
            let text = read(file).unwrap();
            let quoted: Vec<String> = text.split('"').map(str::to_owned).collect();
            quoted.into_iter().filter(|word| {
                word.starts_with("caudata_") && !word.contains(|c: char| c.is_whitespace())
            })
        })
        .collect()
}
