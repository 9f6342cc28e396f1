//! What is asked over HTTP: the page, logging in and out, and the way to the WebSocket.

use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::rejection::JsonRejection;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{ConnectInfo, DefaultBodyLimit, Json, Request, State};
use axum::http::header::{HOST, ORIGIN, RETRY_AFTER, SET_COOKIE};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use carril_runtime::control_plane::LogLevel;
use serde::Deserialize;
use serde_json::json;

use super::doors::Peer;
use super::house::House;
use super::{messages, origin, page, sessions, view, viewer};
use crate::access;

type Shared = State<Arc<House>>;

/// No request has a larger body, B.
const MAX_BODY_BYTES: usize = 4 << 10;
/// Its body has come, and its answer begins, within this time.
const ONE_REQUEST: Duration = Duration::from_secs(10);

/// Everything that is served.
pub fn router(house: Arc<House>) -> Router {
    let mut router = Router::new()
        .route("/api/session", get(session))
        .route("/api/login", post(login))
        .route("/api/logout", post(logout))
        .route("/ws", get(open))
        .route("/ws/view", get(open_view));
    for file in page::files() {
        router = router.route(file.path, get(move |headers: HeaderMap| async move { file.answer(&headers) }));
    }
    let checks = middleware::from_fn_with_state(Arc::clone(&house), check);
    router
        .fallback(|| async { (StatusCode::NOT_FOUND, "not here\n") })
        .layer(DefaultBodyLimit::max(MAX_BODY_BYTES))
        .layer(checks)
        .with_state(house)
}

/// Lets in who names this machine, and of those with an origin only our own page where more than a file is asked for.
async fn check(State(house): Shared, ConnectInfo(peer): ConnectInfo<Peer>, request: Request, next: Next) -> Response {
    let answer = match refusal(&house, &peer, request.headers()) {
        Some(reason) => (StatusCode::FORBIDDEN, reason).into_response(),
        None => match tokio::time::timeout(ONE_REQUEST, next.run(request)).await {
            Ok(answer) => answer,
            Err(_) => (StatusCode::REQUEST_TIMEOUT, "the request took too long\n").into_response(),
        },
    };
    page::guard(answer)
}

fn refusal(house: &House, peer: &Peer, headers: &HeaderMap) -> Option<String> {
    let header = |name| headers.get(name).map(|value| value.to_str().unwrap_or_default());
    let host = header(HOST).unwrap_or_default();
    if !origin::is_ours(host, &house.names) {
        let names = house.names.join(", ");
        return Some(format!("this server is not called `{host}`; use its address, or one of its names: {names}\n"));
    }
    let foreign = header(ORIGIN).is_some_and(|from| !origin::is_same(from, host, peer.encrypted));
    foreign.then(|| "only the page that this server itself has sent may do that\n".into())
}

fn problem(status: StatusCode, error: impl Into<String>) -> Response {
    (status, Json(json!({ "error": error.into() }))).into_response()
}

async fn session(State(house): Shared, ConnectInfo(peer): ConnectInfo<Peer>, headers: HeaderMap) -> Response {
    let secret = sessions::of_request(&headers, house.robot());
    let access = house.access(&peer, secret.as_deref());
    Json(json!({ "robot": house.robot(), "access": access })).into_response()
}

#[derive(Deserialize)]
struct Login {
    name: String,
    token: String,
}

async fn login(
    State(house): Shared,
    ConnectInfo(peer): ConnectInfo<Peer>,
    login: Result<Json<Login>, JsonRejection>,
) -> Response {
    if !house.can_log_in(&peer) {
        let access = house.access(&peer, None);
        return problem(StatusCode::FORBIDDEN, access.why);
    }
    let (from, now) = (peer.address.ip().to_canonical(), Instant::now());
    if !house.tries.may_try(from, now) {
        let mut answer = problem(StatusCode::TOO_MANY_REQUESTS, "too many wrong tries; wait a minute");
        answer.headers_mut().insert(RETRY_AFTER, HeaderValue::from_static("60"));
        return answer;
    }
    let Json(login) = match login {
        Ok(login) => login,
        Err(rejection) => return problem(rejection.status(), rejection.body_text()),
    };
    let known = house.options.access.as_ref().and_then(|access| {
        let access = access.read().unwrap_or_else(PoisonError::into_inner);
        access.by_token(&login.name, &login.token).map(|grant| grant.id.clone())
    });
    let Some(id) = known else {
        if house.tries.was_wrong(from, now) {
            house.note(LogLevel::Warning, format!("refused: {from} tries to log in with wrong tokens"));
        }
        let error = "no key has this name and this token; on the car: carril grant --control NAME";
        return problem(StatusCode::UNAUTHORIZED, error);
    };
    let Ok(secret) = access::random_hex::<16>() else {
        return problem(StatusCode::INTERNAL_SERVER_ERROR, "the system gives no random numbers");
    };
    house.sessions.begin(secret.clone(), id, now);
    let access = house.access(&peer, Some(&secret));
    let cookie = sessions::cookie(house.robot(), Some(&secret), peer.encrypted);
    with_cookie(&cookie, Json(json!({ "access": access })).into_response())
}

async fn logout(State(house): Shared, ConnectInfo(peer): ConnectInfo<Peer>, headers: HeaderMap) -> Response {
    if let Some(secret) = sessions::of_request(&headers, house.robot()) {
        house.sessions.end(&secret);
    }
    let cookie = sessions::cookie(house.robot(), None, peer.encrypted);
    with_cookie(&cookie, Json(json!({ "access": house.access(&peer, None) })).into_response())
}

fn with_cookie(cookie: &str, mut answer: Response) -> Response {
    if let Ok(value) = HeaderValue::from_str(cookie) {
        answer.headers_mut().append(SET_COOKIE, value);
    }
    answer
}

async fn open(
    State(house): Shared,
    ConnectInfo(peer): ConnectInfo<Peer>,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    if !house.has_place() {
        return (StatusCode::SERVICE_UNAVAILABLE, "there are as many viewers as the car can serve\n").into_response();
    }
    let secret = sessions::of_request(&headers, house.robot());
    let limit = messages::MAX_MESSAGE_BYTES;
    upgrade.max_message_size(limit).max_frame_size(limit).on_upgrade(move |socket| async move {
        // Of several that came at once for the last place, one has it.
        if let Some(entered) = house.enter(peer, secret) {
            viewer::serve(house, entered, socket).await;
        }
    })
}

async fn open_view(State(house): Shared, ConnectInfo(peer): ConnectInfo<Peer>, upgrade: WebSocketUpgrade) -> Response {
    let limit = messages::MAX_MESSAGE_BYTES;
    let upgrade = upgrade.max_message_size(limit).max_frame_size(limit);
    upgrade.on_upgrade(move |socket| view::serve(house, peer, socket))
}
