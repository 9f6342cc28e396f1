//! Little-endian fields in a fixed buffer. Neither end can run over: writing past the buffer is a bug that tests see, reading
//! past it gives zeros (frames have fixed sizes, which are checked before their fields are read).

/// Writes fields one after the other.
pub(super) struct Writer<const N: usize> {
    bytes: [u8; N],
    len: usize,
}

impl<const N: usize> Writer<N> {
    pub(super) fn new() -> Self {
        Self { bytes: [0; N], len: 0 }
    }

    pub(super) fn put(&mut self, field: &[u8]) -> &mut Self {
        let end = self.len + field.len();
        self.bytes.get_mut(self.len..end).expect("every frame of the protocol fits").copy_from_slice(field);
        self.len = end;
        self
    }

    pub(super) fn u8(&mut self, value: u8) -> &mut Self {
        self.put(&[value])
    }

    pub(super) fn u16(&mut self, value: u16) -> &mut Self {
        self.put(&value.to_le_bytes())
    }

    pub(super) fn i16(&mut self, value: i16) -> &mut Self {
        self.put(&value.to_le_bytes())
    }

    pub(super) fn u32(&mut self, value: u32) -> &mut Self {
        self.put(&value.to_le_bytes())
    }

    pub(super) fn i32(&mut self, value: i32) -> &mut Self {
        self.put(&value.to_le_bytes())
    }

    pub(super) fn written(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Reads fields one after the other.
pub(super) struct Reader<'a>(pub(super) &'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let Some((field, rest)) = self.0.split_first_chunk::<N>() else { return [0; N] };
        self.0 = rest;
        *field
    }

    pub(super) fn u8(&mut self) -> u8 {
        u8::from_le_bytes(self.take())
    }

    pub(super) fn u16(&mut self) -> u16 {
        u16::from_le_bytes(self.take())
    }

    pub(super) fn i16(&mut self) -> i16 {
        i16::from_le_bytes(self.take())
    }

    pub(super) fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }

    pub(super) fn i32(&mut self) -> i32 {
        i32::from_le_bytes(self.take())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_was_written_and_then_nothing() {
        let mut writer = Writer::<13>::new();
        writer.u8(1).u16(0x0302).i16(-2).u32(0x0a09_0807).i32(-3);
        let written = [1, 2, 3, 0xfe, 0xff, 7, 8, 9, 10, 0xfd, 0xff, 0xff, 0xff];
        assert_eq!(writer.written(), written, "little endian, in order");
        let mut reader = Reader(writer.written());
        let read = (reader.u8(), reader.u16(), reader.i16(), reader.u32(), reader.i32());
        assert_eq!(read, (1, 0x0302, -2, 0x0a09_0807, -3), "the same values");
        assert_eq!(reader.u16(), 0, "the end");
    }
}
