//! The bytes of a message, on the heap or in memory that a transport shares between processes.

use std::any::Any;
use std::fmt;
use std::ops::{Deref, DerefMut};
use std::sync::Arc;

use bytes::Bytes;

/// Read-only bytes, cheap to clone. Whoever owns the memory (a `Vec`, a shared-memory segment) is kept alive by it.
#[derive(Clone, Default)]
pub struct Payload {
    bytes: Bytes,
    backing: Option<Arc<dyn Any + Send + Sync>>,
}

impl Payload {
    /// Wraps memory owned by `owner` without a copy.
    ///
    /// A transport finds its own buffer again through [`Payload::backing`] and then publishes it without a copy either.
    pub fn from_shared<T: AsRef<[u8]> + Send + Sync + 'static>(owner: Arc<T>) -> Self {
        struct View<T>(Arc<T>);
        impl<T: AsRef<[u8]>> AsRef<[u8]> for View<T> {
            fn as_ref(&self) -> &[u8] {
                (*self.0).as_ref()
            }
        }
        Self { bytes: Bytes::from_owner(View(Arc::clone(&owner))), backing: Some(owner) }
    }

    /// The owner given to [`Payload::from_shared`], if it is a `T`.
    pub fn backing<T: Send + Sync + 'static>(&self) -> Option<Arc<T>> {
        Arc::clone(self.backing.as_ref()?).downcast().ok()
    }

    /// The bytes as a cheaply cloned handle.
    pub fn bytes(&self) -> &Bytes {
        &self.bytes
    }
}

impl From<Vec<u8>> for Payload {
    fn from(bytes: Vec<u8>) -> Self {
        Self { bytes: Bytes::from(bytes), backing: None }
    }
}

impl From<Bytes> for Payload {
    fn from(bytes: Bytes) -> Self {
        Self { bytes, backing: None }
    }
}

impl Deref for Payload {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes
    }
}

impl PartialEq for Payload {
    fn eq(&self, other: &Self) -> bool {
        self.bytes == other.bytes
    }
}

impl fmt::Debug for Payload {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Payload({} B)", self.bytes.len())
    }
}

/// Bytes that are still being written, on the heap or in shared memory; [`PayloadMut::freeze`] makes them a [`Payload`].
pub struct PayloadMut(Box<dyn Writable>);

/// Memory that a transport lends out for writing.
pub trait Writable: Send {
    /// The bytes.
    fn bytes(&self) -> &[u8];
    /// The bytes, to write to.
    fn bytes_mut(&mut self) -> &mut [u8];
    /// Ends the writing.
    fn freeze(self: Box<Self>) -> Payload;
}

impl PayloadMut {
    /// Wraps memory that a transport lends.
    pub fn new(memory: Box<dyn Writable>) -> Self {
        Self(memory)
    }

    /// `len` zero bytes on the heap.
    pub fn heap(len: usize) -> Self {
        Self(Box::new(vec![0; len]))
    }

    /// Ends the writing; the bytes are not copied.
    pub fn freeze(self) -> Payload {
        self.0.freeze()
    }
}

impl Writable for Vec<u8> {
    fn bytes(&self) -> &[u8] {
        self
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        self
    }

    fn freeze(self: Box<Self>) -> Payload {
        Payload::from(*self)
    }
}

impl Deref for PayloadMut {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        self.0.bytes()
    }
}

impl DerefMut for PayloadMut {
    fn deref_mut(&mut self) -> &mut [u8] {
        self.0.bytes_mut()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_its_backing_again_without_a_copy() {
        let owner = Arc::new(vec![1_u8, 2, 3]);
        let payload = Payload::from_shared(Arc::clone(&owner)).clone();
        let found: Arc<Vec<u8>> = payload.backing().expect("a payload remembers its owner");
        assert!(Arc::ptr_eq(&owner, &found), "the owner itself, not a copy");
        assert_eq!(payload.as_ptr(), owner.as_ptr(), "same memory");
        assert!(payload.backing::<String>().is_none(), "another type is not found");
    }
}
