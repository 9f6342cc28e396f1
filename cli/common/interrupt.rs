//! Ctrl-C and SIGTERM, as something to wait for instead of a sudden end: commands print what they saw before they go.

use anyhow::{Context, Result};
use tokio::signal::unix::{SignalKind, signal};

/// Calls `then` at each Ctrl-C and SIGTERM from now on, on a thread of its own.
pub fn on_interrupt(then: impl Fn() + Send + 'static) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build();
    let runtime = runtime.context("cannot listen for Ctrl-C")?;
    let (mut interrupt, mut terminate) = {
        let _inside = runtime.enter();
        let listen = |kind| signal(kind).context("cannot listen for Ctrl-C");
        (listen(SignalKind::interrupt())?, listen(SignalKind::terminate())?)
    };
    std::thread::spawn(move || {
        runtime.block_on(async {
            loop {
                tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {} }
                then();
            }
        });
    });
    Ok(())
}
