//! Keeps viewers up to date: graph, status, log, receipts, and what each of them may do. Nothing is asked of the run while nobody looks.

use std::sync::Arc;
use std::time::{Duration, Instant};

use carril_runtime::client::ClientError;
use carril_runtime::control_plane::AccessLevel;
use carril_runtime::transport::Guard;

use super::graph::GraphNow;
use super::house::{House, Viewer, lock};
use super::messages;
use super::outbox::News;

/// The graph is looked at this often, besides whenever a change is told.
const LOOK: Duration = Duration::from_secs(2);
/// The same over a network: it is some kilobytes.
const LOOK_FAR: Duration = Duration::from_secs(10);
/// What viewers may do is looked at this often.
const LOOK_AT_ACCESS: Duration = Duration::from_millis(250);
/// What the client itself may do, over a network.
const LOOK_AT_OWN_ACCESS: Duration = Duration::from_secs(2);

/// Tells viewers of the run, as long as there are any.
pub async fn keep_graph(house: Arc<House>) {
    let mut guards: Option<Vec<Guard>> = None;
    loop {
        if house.viewers().is_empty() {
            house.graph.send_replace(None);
            let ended = guards.take();
            let _ = tokio::task::spawn_blocking(move || drop(ended)).await;
            house.look.notified().await;
            continue;
        }
        let own = Arc::clone(&house);
        let first = guards.is_none();
        let looked = tokio::task::spawn_blocking(move || {
            let watching = first.then(|| watch(&own)).transpose()?;
            look(&own)?;
            Ok::<_, ClientError>(watching)
        });
        match looked.await {
            Ok(Ok(watching)) => guards = watching.or(guards),
            Ok(Err(error)) => tracing::debug!("looking at the graph: {error}"),
            // It panicked, and has said so.
            Err(_) => {}
        }
        let pause = if house.client.is_far() { LOOK_FAR } else { LOOK };
        let _ = tokio::time::timeout(pause, house.look.notified()).await;
    }
}

/// The graph as it is now, to everybody if it has changed.
fn look(house: &House) -> Result<(), ClientError> {
    let (run, live) = (house.client.run()?, house.client.graph()?);
    let now = Arc::new(GraphNow::of(run, &live));
    if house.graph.borrow().as_ref().is_some_and(|known| known.text == now.text) {
        return Ok(());
    }
    house.hub.name_sources(&now.sources);
    let before = house.graph.send_replace(Some(Arc::clone(&now)));
    // The first graph is part of the greeting.
    let other_drive = before.is_some_and(|before| before.drive != now.drive);
    for viewer in readers(house) {
        if other_drive {
            viewer.outbox.news(News::Drive, messages::drive(now.drive.as_ref()));
        }
        viewer.outbox.news(News::Graph, now.text.clone());
    }
    Ok(())
}

fn readers(house: &House) -> impl Iterator<Item = Arc<Viewer>> {
    let viewers = house.viewers().into_iter();
    viewers.filter(|viewer| house.may_read(&lock(&viewer.told)))
}

fn watch(house: &Arc<House>) -> Result<Vec<Guard>, ClientError> {
    let client = &house.client;
    let weak = || Arc::downgrade(house);
    let (of_status, of_receipts, of_applied, of_log) = (weak(), weak(), weak(), weak());
    Ok(vec![
        client.watch_status(move |status| {
            let Some(house) = of_status.upgrade() else { return };
            let text = messages::status(&status, &house.link(), house.client.clock().now());
            readers(&house).for_each(|viewer| viewer.outbox.news(News::Status, text.clone()));
        })?,
        client.watch_receipts(move |receipt| {
            let Some(house) = of_receipts.upgrade() else { return };
            let text = messages::receipt(&receipt);
            readers(&house).for_each(|viewer| viewer.outbox.receipt(text.clone()));
            house.look.notify_one();
        })?,
        client.watch_applied(move |_| {
            if let Some(house) = of_applied.upgrade() {
                house.look.notify_one();
            }
        })?,
        client.watch_log(move |line| {
            let Some(house) = of_log.upgrade() else { return };
            readers(&house).for_each(|viewer| viewer.outbox.log(line.clone()));
        })?,
    ])
}

/// Tells viewers when they may do more or less than before. Whoever may no longer drive drives no more.
pub async fn keep_access(house: Arc<House>) {
    let mut looked = Instant::now();
    loop {
        tokio::time::sleep(LOOK_AT_ACCESS).await;
        if house.client.is_far() && looked.elapsed() >= LOOK_AT_OWN_ACCESS && !house.viewers().is_empty() {
            let own = Arc::clone(&house);
            let _ = tokio::task::spawn_blocking(move || {
                let access = own.client.access();
                *lock(&own.own_access) = access;
            })
            .await;
            looked = Instant::now();
        }
        for viewer in house.viewers() {
            look_at_access(&house, &viewer);
        }
    }
}

fn look_at_access(house: &House, viewer: &Viewer) {
    let access = house.access(&viewer.peer, viewer.session.as_deref());
    let mut told = lock(&viewer.told);
    if *told == access {
        return;
    }
    let could_read = house.may_read(&told);
    told.clone_from(&access);
    drop(told);
    if access.level != AccessLevel::Control {
        house.wheel.let_go(viewer.id);
    }
    viewer.outbox.news(News::Access, messages::access(&access));
    if could_read && !house.may_read(&access) {
        viewer.outbox.close(&access.why);
    }
}
