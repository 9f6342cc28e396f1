//! What a page may ask for, and who may ask. What blocks is done aside, so much at a time.

use std::sync::Arc;
use std::time::Duration;

use carril_messages::{CompressedImage, Control, Image, Message, dynamic};
use carril_runtime::control_plane::{Access, AccessLevel, Change, LogLevel, NodeEntry, SwapRequest, SwapTerms};
use serde_json::{Map, Value, json};
use tokio::sync::Semaphore;

use super::house::{House, Viewer};
use super::messages::{self, FromPage, Word};
use super::outbox::Arrival;
use super::wheel;
use crate::pictures::{self, Colour};

/// The first image of a port comes within this time, if at all.
const FIRST_IMAGE: Duration = Duration::from_secs(2);
/// Whoever asked for a pixel asks for another soon.
const NEXT_PIXEL: Duration = Duration::from_secs(1);

/// Does something that blocks, on a thread where that is allowed.
async fn aside<T: Send + 'static>(
    limit: &Semaphore,
    work: impl FnOnce() -> Result<T, String> + Send + 'static,
) -> Result<T, String> {
    let _place = limit.acquire().await.map_err(|error| error.to_string())?;
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|_| Err("the server failed at it; its log says why".into()))
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// Answers a request.
pub async fn answer(house: &Arc<House>, viewer: &Viewer, request: FromPage) -> Result<Value, String> {
    let access = house.access(&viewer.peer, viewer.session.as_deref());
    match request {
        FromPage::Pixel { key, x, y, .. } => {
            needs_sight(house, &access)?;
            pixel(house, &key, x, y).await
        }
        FromPage::Control { word, .. } => control(house, viewer, &access, word).await,
        FromPage::Set { node, values, .. } => {
            let what = format!("set {node} {}", in_words(&values));
            change(house, viewer, &access, what, Change::Set { node, values }).await
        }
        FromPage::Swap { node, operator, values, fresh, .. } => {
            let to = operator.as_ref().map(|operator| format!(" --operator {operator}")).unwrap_or_default();
            let what = format!("swap {node}{to} {}", in_words(&values));
            let terms = SwapTerms { fresh, ..SwapTerms::default() };
            change(
                house,
                viewer,
                &access,
                what,
                Change::Swap(SwapRequest { node, operator, exec: None, values, terms }),
            )
            .await
        }
        FromPage::Restart { node, .. } => {
            let what = format!("restart {node}");
            change(house, viewer, &access, what, Change::Restart { node, terms: SwapTerms::restart(true) }).await
        }
        FromPage::Rollback { node, .. } => {
            let what = format!("rollback {node}");
            change(house, viewer, &access, what, Change::Rollback { node, terms: SwapTerms::default() }).await
        }
        FromPage::Pub { key, value, .. } => publish(house, viewer, &access, key, value).await,
        _ => Err("that is no question".into()),
    }
}

fn needs_sight(house: &House, access: &Access) -> Result<(), String> {
    if house.may_read(access) { Ok(()) } else { Err(access.why.clone()) }
}

/// Whoever only looks on is told why; whoever would interfere with somebody who drives, who that is.
fn needs_control(house: &House, viewer: &Viewer, access: &Access, what: &str) -> Result<(), String> {
    if access.level != AccessLevel::Control {
        return Err(format!("{what} needs control: {}", access.why));
    }
    match house.wheel.another_driver(viewer.id) {
        Some(name) => Err(format!("{what}: {name} drives by hand; only `stop` and the e-stop are for all meanwhile")),
        None => Ok(()),
    }
}

fn in_words(values: &Map<String, Value>) -> String {
    values.iter().map(|(path, value)| format!("{path}={value}")).collect::<Vec<_>>().join(" ")
}

async fn control(house: &Arc<House>, viewer: &Viewer, access: &Access, word: Word) -> Result<Value, String> {
    let (word, is_open) = (Control::from(word), word == Word::Estop && house.options.estop_for_all);
    let what = format!("`{word}`");
    match word {
        Control::EStop if is_open => {}
        Control::EStop | Control::Stop if access.level == AccessLevel::Control => {}
        _ => needs_control(house, viewer, access, &what)?,
    }
    house.note(LogLevel::Info, format!("{}: {word}", viewer.name(access)));
    let limit = if word == Control::EStop { &house.limits.stops } else { &house.limits.words };
    let client = Arc::clone(&house.client);
    let answers = aside(limit, move || client.control(word).map_err(text)).await?;
    let (mut nodes, mut errors) = (Vec::new(), Vec::new());
    for answer in answers {
        match answer {
            Ok(reply) => nodes.extend(reply.nodes),
            Err(error) => errors.push(error),
        }
    }
    nodes.sort();
    Ok(json!({ "nodes": nodes, "errors": errors }))
}

async fn change(
    house: &Arc<House>,
    viewer: &Viewer,
    access: &Access,
    what: String,
    change: Change,
) -> Result<Value, String> {
    needs_control(house, viewer, access, &what)?;
    house.note(LogLevel::Info, format!("{}: {}", viewer.name(access), what.trim_end()));
    let client = Arc::clone(&house.client);
    let receipt = aside(&house.limits.changes, move || client.change(&change).map_err(text)).await?;
    // Told to all when it is published; whoever asked sees it in the graph at once.
    house.look.notify_one();
    Ok(json!(receipt))
}

async fn publish(
    house: &Arc<House>,
    viewer: &Viewer,
    access: &Access,
    key: String,
    value: Value,
) -> Result<Value, String> {
    needs_control(house, viewer, access, &format!("publishing on `{key}`"))?;
    let graph = house.graph.borrow().clone().ok_or("the graph is not known yet; try again")?;
    let closed = || format!("`{key}` is no input that is open to people");
    let (node, port) = messages::split(&key).ok_or_else(closed)?;
    let fits = |entry: &&NodeEntry| entry.name == node;
    let entry = graph.run.nodes.iter().find(fits).ok_or_else(closed)?;
    let input = entry.inputs.iter().find(|input| input.port == port && input.external).ok_or_else(closed)?;
    let known = dynamic::find(&input.message_type).and_then(|known| Some((known.message_type, known.from_json?)));
    let (message_type, from_json) =
        known.ok_or_else(|| format!("`{key}` takes `{}`, which JSON cannot carry", input.message_type))?;
    let encoded = from_json(value).map_err(text)?;
    house.note(LogLevel::Info, format!("{}: pub {key}", viewer.name(access)));
    let (client, node, port) = (Arc::clone(&house.client), node.to_owned(), port.to_owned());
    aside(&house.limits.words, move || client.publisher(&node, &port, message_type).put(encoded).map_err(text)).await?;
    Ok(Value::Null)
}

async fn pixel(house: &Arc<House>, key: &str, x: f64, y: f64) -> Result<Value, String> {
    let (own, wanted) = (Arc::clone(house), key.to_owned());
    let port = aside(&house.limits.looks, move || own.hub.listen(&wanted)).await?;
    let newest = tokio::time::timeout(FIRST_IMAGE, port.newest()).await;
    tokio::spawn(async move {
        tokio::time::sleep(NEXT_PIXEL).await;
        drop(port);
    });
    let newest = newest.ok().flatten().ok_or_else(|| format!("`{key}` sends nothing"))?;
    aside(&house.limits.looks, move || {
        let colour = colour_of(&newest, x, y)?;
        let mut value = json!(colour);
        value["seq"] = newest.header.seq.into();
        Ok(value)
    })
    .await
}

fn colour_of(arrival: &Arrival, x: f64, y: f64) -> Result<Colour, String> {
    let (meta, payload) = (&arrival.header.meta, &arrival.payload);
    if arrival.header.message_type != CompressedImage::TYPE {
        arrival.header.expect::<Image>().map_err(|error| format!("`{}`: {error}", arrival.key))?;
        let image = Image::decode(meta, payload).map_err(text)?;
        return pictures::colour_at(&image, x, y).map_err(text);
    }
    // Far away only the picture is there: its colours are close, and the place is told in pixels of the image itself.
    let image = CompressedImage::decode(meta, payload).map_err(text)?;
    let picture = pictures::decompress(&image.jpeg).map_err(text)?;
    let colour = pictures::colour_at(&picture, x, y).map_err(text)?;
    let at = |share: f64, size: u32| ((share.clamp(0.0, 1.0) * f64::from(size)) as u32).min(size.saturating_sub(1));
    Ok(Colour { x: at(x, image.source_width), y: at(y, image.source_height), ..colour })
}

/// A command by hand. Never waits.
pub fn drive(
    house: &House,
    viewer: &Viewer,
    steering_rad: Option<f64>,
    speed_m_s: Option<f64>,
    seen_ms: f64,
) -> Result<(), String> {
    let access = house.access(&viewer.peer, viewer.session.as_deref());
    if access.level != AccessLevel::Control {
        return Err(format!("driving by hand needs control: {}", access.why));
    }
    let graph = house.graph.borrow().clone();
    let drive = graph.as_ref().and_then(|graph| graph.drive.as_ref()).ok_or("this graph has no manual drive")?;
    let now_ms = messages::ms(house.client.clock().now());
    let command = wheel::check(drive, steering_rad, speed_m_s, seen_ms, now_ms)?;
    house.wheel.turn(viewer.id, &viewer.name(&access), drive, command)
}
