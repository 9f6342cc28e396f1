//! Who in this process reads which output. It changes while the graph runs: nodes come, go and are replaced.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, RwLock};

use carril_messages::Header;

use super::group::{Group, lock};
use crate::mailbox::Mailbox;
use crate::ports::{AnyMessage, Incoming};
use crate::transport::Guard;

/// The outputs that are read within this process, by name: `lane/lane`.
#[derive(Default)]
pub(super) struct Router(Mutex<HashMap<String, Arc<Readers>>>);

/// The readers of an output.
#[derive(Default)]
pub(super) struct Readers(RwLock<Vec<Arc<LocalReader>>>);

/// A reader in this process.
pub(super) struct LocalReader {
    pub mailbox: Arc<Mailbox>,
    pub triggers: bool,
    pub group: Arc<Group>,
    pub index: usize,
}

impl Router {
    /// The readers of an output, now and later.
    pub(super) fn readers(&self, output: &str) -> Arc<Readers> {
        Arc::clone(lock(&self.0).entry(output.to_owned()).or_default())
    }

    /// Adds a reader, for as long as the guard lives.
    pub(super) fn add(&self, output: &str, reader: LocalReader) -> Guard {
        let readers = self.readers(output);
        let reader = Arc::new(reader);
        readers.0.write().unwrap_or_else(PoisonError::into_inner).push(Arc::clone(&reader));
        Box::new(Reading { readers, reader })
    }
}

impl Readers {
    pub(super) fn is_empty(&self) -> bool {
        self.0.read().unwrap_or_else(PoisonError::into_inner).is_empty()
    }

    /// Gives a sample to all. `writer`: the group on whose thread this happens.
    pub(super) fn give(&self, writer: *const Group, header: &Arc<Header>, message: &Arc<dyn AnyMessage>) {
        for reader in self.0.read().unwrap_or_else(PoisonError::into_inner).iter() {
            reader.mailbox.push(Incoming::Local(Arc::clone(header), Arc::clone(message)));
            if reader.triggers {
                reader.group.input_from_within(reader.index, std::ptr::eq(Arc::as_ptr(&reader.group), writer));
            }
        }
    }
}

struct Reading {
    readers: Arc<Readers>,
    reader: Arc<LocalReader>,
}

impl Drop for Reading {
    fn drop(&mut self) {
        let mut readers = self.readers.0.write().unwrap_or_else(PoisonError::into_inner);
        readers.retain(|other| !Arc::ptr_eq(other, &self.reader));
    }
}
