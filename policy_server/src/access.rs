//! Who may call what: TLS with certificates on both sides, and a role for each call.

use std::pin::Pin;
use std::sync::atomic::Ordering;
use std::task::{Context, Poll};

use caudata_proto::registry::StreamName;
use caudata_signing::pki::{Role, identity_of_der};
use caudata_telemetry::Peer;
use tonic::{Request, Status};

use crate::audit::Origin;

/// The service's name in the path of a call.
const REGISTRY: &str = "/caudata.registry.v1.PolicyRegistry/";
/// Calls that change what others see, and the roles that may make them. All other calls of the registry read.
const WRITES: [(&str, &[Role]); 7] = [
    // What robots follow outside of the lab is for operators: see `Caller::check_publication`.
    ("Publish", &[Role::Learner, Role::Operator]),
    ("Ack", &[Role::Robot]),
    ("Nack", &[Role::Robot]),
    ("SetLabel", &[Role::Operator]),
    ("Revert", &[Role::Operator]),
    ("Quarantine", &[Role::Operator]),
    // Who did what is nobody's business but the operators'.
    ("Audit", &[Role::Operator]),
];
/// Who may read.
const READERS: &[Role] = &[Role::Learner, Role::Operator, Role::Robot];

/// Streams that begin so are what an operator released.
const RELEASES: &str = "release/";

/// Whether `role` may make the call with this path. Health and reflection are open to every certificate of
/// the lab.
fn allowed(path: &str, role: Role) -> bool {
    let Some(call) = path.strip_prefix(REGISTRY) else { return path.starts_with("/grpc.") };
    let write = WRITES.iter().find(|(name, _)| *name == call);
    write.map_or(READERS, |(_, roles)| roles).contains(&role)
}

/// Who makes a call, as the certificate of its connection says; not there on a plain connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Caller {
    /// What it is.
    pub role: Role,
    /// Its name.
    pub name: String,
}

impl Caller {
    /// Who makes `request`; `None`: somebody on this host.
    pub fn of<T>(request: &Request<T>) -> Option<Self> {
        request.extensions().get::<Self>().cloned()
    }

    /// Who is written down for `request`.
    pub fn origin<T>(request: &Request<T>) -> Origin {
        match Self::of(request) {
            Some(Self { role, name }) => Origin::of(&format!("{role}:{name}")),
            None => Origin::local(),
        }
    }

    /// Whether it may publish into `stream`: a learner's machine is not trusted with what operators release,
    /// and an operator releases nothing that is not signed.
    ///
    /// # Errors
    /// `PERMISSION_DENIED`.
    pub fn check_publication(&self, stream: &StreamName, signed: bool) -> Result<(), Status> {
        if self.role == Role::Operator && !signed {
            return Err(Status::permission_denied(
                "an operator publishes signed policies only: `caudata policy release`",
            ));
        }
        let released = format!("{stream}/").starts_with(RELEASES);
        if self.role != Role::Learner || !released {
            return Ok(());
        }
        Err(Status::permission_denied(format!(
            "learner `{}` may not publish into {stream}: `{RELEASES}` is for operators",
            self.name
        )))
    }
}

/// Puts [`Guard`] around a service.
#[derive(Clone, Copy, Debug)]
pub struct GuardLayer {
    /// False on a plain connection, which is on loopback: whoever is on this host may do everything.
    pub enforced: bool,
}

impl<S> tower_layer::Layer<S> for GuardLayer {
    type Service = Guard<S>;

    fn layer(&self, inner: S) -> Guard<S> {
        Guard { inner, enforced: self.enforced }
    }
}

/// Lets a call through when the certificate of its connection has a role that may make it; answers
/// `UNAUTHENTICATED` or `PERMISSION_DENIED` otherwise.
#[derive(Clone, Debug)]
pub struct Guard<S> {
    inner: S,
    enforced: bool,
}

impl<S, B, R> tower_service::Service<http::Request<B>> for Guard<S>
where
    S: tower_service::Service<http::Request<B>, Response = http::Response<R>>,
    S::Future: Send + 'static,
    S::Error: Send + 'static,
    R: Default + Send + 'static,
{
    type Response = http::Response<R>;
    type Error = S::Error;
    type Future =
        Pin<Box<dyn Future<Output = Result<http::Response<R>, S::Error>> + Send + 'static>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<B>) -> Self::Future {
        // Nothing that came over the wire may stand for a certificate.
        request.extensions_mut().remove::<Caller>();
        if let Some(peer) = request.extensions().get::<Peer>() {
            peer.called.store(true, Ordering::Relaxed);
        }
        let checked = if self.enforced { check(&request).map(Some) } else { Ok(None) };
        match checked {
            Ok(caller) => {
                if let Some(caller) = caller {
                    request.extensions_mut().insert(caller);
                }
                Box::pin(self.inner.call(request))
            }
            Err(status) => {
                tracing::warn!(path = request.uri().path(), reason = status.message(), "refused");
                Box::pin(std::future::ready(Ok(status.into_http())))
            }
        }
    }
}

fn check<B>(request: &http::Request<B>) -> Result<Caller, Status> {
    let peer = request.extensions().get::<Peer>();
    let own = peer.and_then(|peer| peer.certificate.as_deref());
    let Some(own) = own else {
        return Err(Status::unauthenticated("a certificate of the lab is needed"));
    };
    let identity = identity_of_der(own).map_err(Status::unauthenticated)?;
    let path = request.uri().path();
    let (role, name) = (identity.role, identity.name);
    if allowed(path, role) {
        return Ok(Caller { role, name });
    }
    let call = path.rsplit('/').next().unwrap_or_default();
    Err(Status::permission_denied(format!("{role} `{name}` may not {call}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_learners_and_operators_publish_and_an_actor_has_no_business_here() {
        let path = |call: &str| format!("{REGISTRY}{call}");
        for (role, publishes, reads) in [
            (Role::Learner, true, true),
            (Role::Operator, true, true),
            (Role::Robot, false, true),
            (Role::Actor, false, false),
            (Role::Router, false, false),
            (Role::Server, false, false),
        ] {
            assert_eq!(allowed(&path("Publish"), role), publishes, "{role}");
            for call in ["Fetch", "Watch", "List", "GetManifest"] {
                assert_eq!(allowed(&path(call), role), reads, "{role} {call}");
            }
            assert!(allowed("/grpc.health.v1.Health/Check", role));
            assert!(!allowed("/other.Service/Call", role));
        }
    }

    #[test]
    fn a_learner_stays_out_of_what_operators_release() {
        for (role, stream, may) in [
            (Role::Learner, "release/flat", false),
            (Role::Learner, "release", false),
            (Role::Learner, "released/flat", true),
            (Role::Learner, "polymander/flat", true),
            (Role::Operator, "release/flat", true),
        ] {
            let name = "x".to_owned();
            let stream = StreamName::new(stream).unwrap();
            assert_eq!(Caller { role, name }.check_publication(&stream, true).is_ok(), may);
        }
        let (role, name) = (Role::Operator, "x".to_owned());
        let stream = StreamName::new("release/flat").unwrap();
        assert!(Caller { role, name }.check_publication(&stream, false).is_err());
    }
}
