//! The hash over all outputs of a lockstep run: two runs are the same to the byte when their hashes are.

use carril_messages::CodecError;
use xxhash_rust::xxh3::Xxh3;

use crate::node::Published;

/// XXH3-64 over key, sequence number, stamp, origins, metadata and payload of each sample, in the order of publication.
pub(super) struct OutputHash {
    hasher: Xxh3,
    /// Reused, so that hashing a small message allocates nothing.
    buffer: Vec<u8>,
}

impl OutputHash {
    pub(super) fn new() -> Self {
        Self { hasher: Xxh3::new(), buffer: Vec::with_capacity(4096) }
    }

    /// Takes in a sample of the output `key` (`node/port`); how many bytes its payload has.
    pub(super) fn update(&mut self, key: &str, published: &Published) -> Result<usize, CodecError> {
        let header = &published.header;
        self.buffer.clear();
        self.text(key);
        self.number(header.seq);
        self.number(header.stamp.as_nanos() as u64);
        for origin in header.origins.iter() {
            self.number(u64::from(origin.source.0));
            self.number(origin.stamp.as_nanos() as u64);
        }
        let before = self.buffer.len();
        let bytes = if published.message.encode_into(&mut self.buffer)? {
            let bytes = self.buffer.len() - before;
            // A length at the end keeps apart what two samples would otherwise share.
            self.number(self.buffer.len() as u64);
            bytes
        } else {
            let encoded = published.message.encode()?;
            self.number(encoded.meta.len() as u64);
            self.buffer.extend_from_slice(&encoded.meta);
            self.hasher.update(&self.buffer);
            self.hasher.update(&encoded.payload);
            self.buffer.clear();
            self.number(encoded.payload.len() as u64);
            encoded.payload.len()
        };
        self.hasher.update(&self.buffer);
        Ok(bytes)
    }

    pub(super) fn value(&self) -> u64 {
        self.hasher.digest()
    }

    fn text(&mut self, text: &str) {
        self.number(text.len() as u64);
        self.buffer.extend_from_slice(text.as_bytes());
    }

    fn number(&mut self, number: u64) {
        self.buffer.extend_from_slice(&number.to_le_bytes());
    }
}
