//! What Zenoh is told: for the links between the processes of a run, for the gateway to the outside, and for a tool far away.

use std::fmt::Display;
use std::net::SocketAddr;
use std::time::Duration;

use ::zenoh::Config;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use carril_messages::key;
use serde_json::{Value, json};

use super::{ZenohOptions, failed};
use crate::control_plane;
use crate::transport::TransportError;

/// A link to the outside that says nothing for this long is dead. Zenoh says something four times in it.
const FAR_LEASE: Duration = Duration::from_secs(2);
/// To open a link takes five round trips, TCP, TLS and Zenoh together, and somebody computes in between. One that takes longer than this many
/// round trips and this time on top is tried again: after an outage the next try must not wait for an old one, whose first packet TCP
/// repeats only after a second.
const FAR_OPEN: (u32, Duration) = (8, Duration::from_millis(350));
/// Where nobody knows the round trip.
const FAR_OPEN_UNKNOWN: Duration = Duration::from_millis(1500);
/// Between two tries, ms.
const FAR_TRY_AGAIN_MS: u32 = 50;
/// What the kernel keeps for a link to the outside before Zenoh drops, B (it takes twice as much). At 2 Mbit/s it is an eighth of a second:
/// what waits longer is old when it arrives.
const FAR_SEND_BUFFER: u32 = 16 << 10;

/// A certificate with its key and the authority that signed it, each as a PEM text.
#[derive(Clone)]
pub struct Identity {
    /// The authority's certificate.
    pub authority: String,
    /// The certificate.
    pub certificate: String,
    /// Its private key.
    pub key: String,
}

impl std::fmt::Debug for Identity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Never the key: this lands in logs.
        f.write_str("Identity")
    }
}

/// How the gateway listens, and who may do what there. All else is refused by Zenoh itself.
#[derive(Clone, Debug)]
pub struct GatewayOptions {
    /// The robot.
    pub robot: String,
    /// Where anybody may read. `None`: only granted names may.
    pub listen: Option<SocketAddr>,
    /// Where granted names read and control, over TLS with a certificate of theirs.
    pub listen_tls: SocketAddr,
    /// The car's own certificate.
    pub identity: Identity,
    /// The granted names: each may ask below `carril/<robot>/@/as/<name>`.
    pub granted: Vec<String>,
    /// The names of machines: each may ask and put below `carril/<robot>/@/as/<name>/machine`.
    pub machines: Vec<String>,
    /// Anybody who may read may say `estop`.
    pub estop_for_all: bool,
    /// Answers those who look for cars by multicast.
    pub scouting: Scouting,
}

/// Looking for each other by multicast.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Scouting {
    /// Neither asks nor answers.
    Off,
    /// On the network interface of that name; `auto`: on all that can.
    On(String),
}

/// To whom a tool far away connects.
#[derive(Clone, Debug)]
pub struct FarOptions {
    /// `tcp/car.local:7447`; with a key `tls/car.local:7448`.
    pub endpoint: String,
    /// The key that was granted.
    pub identity: Option<Identity>,
}

fn build(settings: impl IntoIterator<Item = (&'static str, Value)>) -> Result<Config, TransportError> {
    let mut config = Config::default();
    let common = [
        ("open/return_conditions/connect_scouted", json!(false)),
        ("scouting/gossip/enabled", json!(false)),
        ("connect/exit_on_failure", json!(false)),
        ("connect/timeout_ms", json!(-1)),
        ("connect/retry", json!({"period_init_ms": 20, "period_max_ms": 250, "period_increase_factor": 1.5})),
        ("transport/shared_memory/transport_optimization/enabled", json!(false)),
        ("adminspace/enabled", json!(false)),
    ];
    for (name, value) in common.into_iter().chain(settings) {
        config.insert_json5(name, &value.to_string()).map_err(failed(format!("zenoh setting `{name}`")))?;
    }
    Ok(config)
}

/// Between the processes of a run.
pub(super) fn near(options: &ZenohOptions) -> Result<Config, TransportError> {
    build([
        ("mode", json!("peer")),
        ("scouting/multicast/enabled", json!(false)),
        ("listen/endpoints", json!(options.listen.iter().collect::<Vec<_>>())),
        ("connect/endpoints", json!(options.connect)),
    ])
}

fn far_links() -> [(&'static str, Value); 2] {
    [
        ("transport/link/tx/lease", json!(FAR_LEASE.as_millis() as u64)),
        ("transport/shared_memory/enabled", json!(false)),
    ]
}

/// To a gateway that is `round_trip` away.
pub(super) fn far(options: &FarOptions, round_trip: Option<Duration>) -> Result<Config, TransportError> {
    let (round_trips, more) = FAR_OPEN;
    let open = round_trip.map_or(FAR_OPEN_UNKNOWN, |round_trip| round_trip * round_trips + more);
    let again = json!({"period_init_ms": 20, "period_max_ms": FAR_TRY_AGAIN_MS, "period_increase_factor": 1.5});
    let mut settings = vec![
        ("transport/unicast/open_timeout", json!(open.as_millis() as u64)),
        ("connect/retry", again),
        ("mode", json!("peer")),
        ("scouting/multicast/enabled", json!(false)),
        ("listen/endpoints", json!([])),
        ("connect/endpoints", json!([format!("{}#so_sndbuf={FAR_SEND_BUFFER}", options.endpoint)])),
    ];
    settings.extend(far_links());
    if let Some(identity) = &options.identity {
        let tls = json!({
            "root_ca_certificate_base64": STANDARD.encode(&identity.authority),
            "connect_certificate_base64": STANDARD.encode(&identity.certificate),
            "connect_private_key_base64": STANDARD.encode(&identity.key),
            "enable_mtls": true,
            "verify_name_on_connect": true,
        });
        settings.push(("transport/link/tls", tls));
    }
    build(settings)
}

/// Of the gateway.
pub(super) fn gateway(options: &GatewayOptions) -> Result<Config, TransportError> {
    let buffer = |scheme: &dyn Display, address: &SocketAddr| format!("{scheme}/{address}#so_sndbuf={FAR_SEND_BUFFER}");
    let plain = options.listen.iter().map(|address| buffer(&"tcp", address));
    let listen: Vec<String> = plain.chain([buffer(&"tls", &options.listen_tls)]).collect();
    let identity = &options.identity;
    let tls = json!({
        "root_ca_certificate_base64": STANDARD.encode(&identity.authority),
        "listen_certificate_base64": STANDARD.encode(&identity.certificate),
        "listen_private_key_base64": STANDARD.encode(&identity.key),
        "enable_mtls": true,
    });
    let mut settings = vec![
        // Others are served, but no links are opened to them.
        ("mode", json!("router")),
        ("listen/endpoints", json!(listen)),
        ("connect/endpoints", json!([])),
        ("transport/link/tls", tls),
        ("access_control", access(options)),
    ];
    settings.extend(far_links());
    settings.extend(match &options.scouting {
        Scouting::Off => vec![("scouting/multicast/enabled", json!(false))],
        Scouting::On(interface) => vec![
            ("scouting/multicast/enabled", json!(true)),
            ("scouting/multicast/interface", json!(interface)),
            ("scouting/multicast/autoconnect", json!({"router": [], "peer": [], "client": []})),
        ],
    });
    build(settings)
}

/// For those who look for cars.
pub(super) fn scout(interface: &str) -> Result<Config, TransportError> {
    build([("scouting/multicast/enabled", json!(true)), ("scouting/multicast/interface", json!(interface))])
}

/// Who may send what to the gateway. What is not named is refused: above all, putting anything on any key.
fn access(options: &GatewayOptions) -> Value {
    let robot = &options.robot;
    let rule = |id: String, messages: Value, keys: Value| json!({"id": id, "permission": "allow", "flows": ["ingress"], "messages": messages, "key_exprs": keys});
    let mut for_all = vec!["look".to_owned(), "ask".to_owned(), "hear".to_owned()];
    let mut questions = vec![control_plane::run_key("*")];
    questions.extend(control_plane::OPEN_QUESTIONS.iter().map(|path| key::control_key(robot, path)));
    // Keys of the control plane begin with `@`, and `**` does not match those.
    let all = json!(["**", key::control_key("*", "**")]);
    let mut rules = vec![
        json!({
            "id": "hear", "permission": "allow", "flows": ["egress"], "key_exprs": all.clone(), "messages": [
                "put", "delete", "declare_subscriber", "query", "declare_queryable", "reply", "liveliness_token",
                "declare_liveliness_subscriber", "liveliness_query"
            ],
        }),
        rule("look".into(), json!(["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]), all),
        rule("ask".into(), json!(["query"]), json!(questions)),
        rule("estop".into(), json!(["query"]), json!([control_plane::open_estop_key(robot)])),
    ];
    if options.estop_for_all {
        for_all.push("estop".into());
    }
    let mut subjects = vec![json!({"id": "anybody"})];
    let mut policies = vec![json!({"rules": for_all, "subjects": ["anybody"]})];
    for name in &options.granted {
        let id = format!("granted-{name}");
        let keys = json!([control_plane::granted_key(robot, name, "**"), control_plane::open_estop_key(robot)]);
        rules.push(rule(id.clone(), json!(["query"]), keys));
        subjects.push(json!({"id": id, "cert_common_names": [name], "link_protocols": ["tls"]}));
        policies.push(json!({"rules": [id], "subjects": [id]}));
    }
    for name in &options.machines {
        let id = format!("machine-{name}");
        rules.push(rule(
            id.clone(),
            json!(["query", "put"]),
            json!([control_plane::machine_key(robot, name, "*", "**")]),
        ));
        subjects.push(json!({"id": id, "cert_common_names": [name], "link_protocols": ["tls"]}));
        policies.push(json!({"rules": [id], "subjects": [id]}));
    }
    json!({
        "enabled": true, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    })
}
