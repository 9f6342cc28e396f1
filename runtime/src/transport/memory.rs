//! The transport within one program: for tests of the live executor, and as the yardstick of the other transport. Samples
//! take their wire form here, too, so that both behave alike.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use carril_messages::{Header, Key, Payload};

use super::{Guard, Publisher, Sink, Transport, TransportError, Wire, receive};
use crate::ports::AnyMessage;
use crate::setup::{BufferPool, HeapPool};

type Readers = Arc<Mutex<Vec<Weak<dyn Sink>>>>;

/// Samples stay in the program. Clones share the same keys.
#[derive(Clone, Default)]
pub struct MemoryTransport(Arc<Mutex<HashMap<Key, Readers>>>);

struct MemoryPublisher(Readers);

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The readers that are still there.
fn living(readers: &Readers) -> Vec<Arc<dyn Sink>> {
    let mut readers = lock(readers);
    readers.retain(|sink| sink.strong_count() > 0);
    readers.iter().filter_map(Weak::upgrade).collect()
}

fn deliver(readers: &Readers, header: &[u8], payload: &Payload) {
    for sink in living(readers) {
        match receive(header, payload.clone()) {
            Ok(incoming) => sink.deliver(incoming),
            Err(refusal) => sink.refuse(refusal.to_string()),
        }
    }
}

impl MemoryTransport {
    fn readers(&self, port: &Key) -> Readers {
        Arc::clone(lock(&self.0).entry(port.clone()).or_default())
    }
}

impl Transport for MemoryTransport {
    fn publish_on(&self, port: &Key, _reliable: bool) -> Result<Box<dyn Publisher>, TransportError> {
        Ok(Box::new(MemoryPublisher(self.readers(port))))
    }

    fn subscribe(&self, port: &Key, _reliable: bool, sink: Arc<dyn Sink>) -> Result<Guard, TransportError> {
        lock(&self.readers(port)).push(Arc::downgrade(&sink));
        Ok(Box::new(sink))
    }

    fn put_raw(&self, port: &Key, header: &[u8], payload: Payload) -> Result<(), TransportError> {
        deliver(&self.readers(port), header, &payload);
        Ok(())
    }

    fn buffers(&self) -> Arc<dyn BufferPool> {
        Arc::new(HeapPool)
    }
}

impl Publisher for MemoryPublisher {
    fn matched(&self) -> bool {
        !living(&self.0).is_empty()
    }

    fn publish(&self, header: &Header, message: &dyn AnyMessage) -> Result<usize, TransportError> {
        let wire = Wire::of(header, message)?;
        deliver(&self.0, &wire.header, &wire.payload);
        Ok(wire.payload.len())
    }
}
