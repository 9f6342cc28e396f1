//! Memory that processes of one machine share, for large payloads.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use ::zenoh::Wait;
use ::zenoh::bytes::ZBytes;
use ::zenoh::shm::{PosixShmProviderBackend, ShmProvider, ShmProviderBuilder, ZShm, ZShmMut};
use carril_messages::{Payload, PayloadMut, Writable};

use super::{SHARED_FROM_BYTES, is_shared};
use crate::setup::BufferPool;

/// Memory shared between processes. Made when it is first used: most processes never need it.
pub(super) struct SharedPool {
    pub(super) bytes: usize,
    provider: OnceLock<Option<ShmProvider<PosixShmProviderBackend>>>,
    pub(super) fallbacks: AtomicU64,
}

struct SharedBuffer(ZShmMut);

impl SharedPool {
    pub(super) fn new(bytes: usize) -> Self {
        let shm = nix::sys::statvfs::statvfs("/dev/shm");
        let free = shm.map(|shm| (shm.blocks_available() * shm.fragment_size()) as usize);
        // Pages beyond what /dev/shm holds would kill the process with SIGBUS when they are written.
        let bytes = free.map_or(bytes, |free| bytes.min(free / 4));
        Self { bytes, provider: OnceLock::new(), fallbacks: AtomicU64::new(0) }
    }

    /// `None` when there is no room. What readers gave back is taken first: it is warm in the cache, and its pages exist.
    fn allocate(&self, len: usize) -> Option<ZShmMut> {
        let provider = self.provider.get_or_init(|| provider(self.bytes)).as_ref()?;
        provider.garbage_collect();
        provider.alloc(len).wait().ok()
    }

    /// The payload in shared memory, if it is large: copied once, unless it is there already.
    pub(super) fn share(&self, payload: Payload) -> Payload {
        if payload.len() < SHARED_FROM_BYTES || is_shared(&payload) {
            return payload;
        }
        let Some(mut buffer) = self.allocate(payload.len()) else {
            // Counted here only: whoever asked for a buffer in vain publishes from the heap, and comes by here, too.
            if self.fallbacks.fetch_add(1, Ordering::Relaxed) == 0 {
                tracing::warn!(
                    "shared memory is full ({} B): large payloads are copied until readers give some back",
                    self.bytes
                );
            }
            return payload;
        };
        buffer.copy_from_slice(&payload);
        Box::new(SharedBuffer(buffer)).freeze()
    }
}

fn provider(bytes: usize) -> Option<ShmProvider<PosixShmProviderBackend>> {
    match ShmProviderBuilder::default_backend(bytes).wait() {
        Ok(provider) => Some(provider),
        Err(error) => {
            tracing::warn!("no shared memory ({bytes} B): {error}; large payloads are copied through the socket");
            None
        }
    }
}

pub(super) fn to_wire(payload: &Payload) -> ZBytes {
    match payload.backing::<ZShm>() {
        Some(shared) => ZBytes::from((*shared).clone()),
        None => ZBytes::from(payload.bytes().clone()),
    }
}

impl BufferPool for SharedPool {
    fn buffer(&self, len: usize) -> PayloadMut {
        if len >= SHARED_FROM_BYTES
            && let Some(buffer) = self.allocate(len)
        {
            return PayloadMut::new(Box::new(SharedBuffer(buffer)));
        }
        PayloadMut::heap(len)
    }
}

impl Writable for SharedBuffer {
    fn bytes(&self) -> &[u8] {
        &self.0
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        &mut self.0
    }

    fn freeze(self: Box<Self>) -> Payload {
        Payload::from_shared(Arc::new(ZShm::from(self.0)))
    }
}
