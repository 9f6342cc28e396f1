//! How old what a node publishes is: from the exposure of a frame to its publication, as the car itself stamps it.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use carril_runtime::client::Client;
use carril_runtime::messages::{Header, SourceId};
use carril_runtime::transport::Guard;

/// Hears the outputs of a node.
pub struct Ages {
    /// From the exposure of the frame to the end of the step, us.
    ages_us: Arc<Mutex<Vec<f64>>>,
    _guard: Guard,
}

impl Ages {
    /// Of this output, from the frames of `world/camera`.
    pub fn listen(client: &Client, node: &str, port: &str) -> Self {
        let ages_us: Arc<Mutex<Vec<f64>>> = Arc::default();
        let into = Arc::clone(&ages_us);
        let camera = SourceId::of("world", "camera");
        let hear = move |header: Header, _, _| {
            if let Some(exposed) = header.origins.of(camera) {
                let age_us = header.stamp.since(exposed).as_secs_f64() * 1e6;
                into.lock().unwrap_or_else(PoisonError::into_inner).push(age_us);
            }
        };
        let guard = client.subscribe(node, port, hear).expect("a subscription");
        Self { ages_us, _guard: guard }
    }

    /// What comes from now on, for so long.
    pub fn window(&self, length: Duration) -> Vec<f64> {
        let take = || std::mem::take(&mut *self.ages_us.lock().unwrap_or_else(PoisonError::into_inner));
        drop(take());
        std::thread::sleep(length);
        take()
    }
}
