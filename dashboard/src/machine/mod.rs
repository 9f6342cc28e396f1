//! What joins the run of a car with that of another machine: on the machine the [`link`], on the car the gateway's
//! [`machines`](crate::gateway::machines). Both carry only the newest sample of a port, images compressed.

mod carrier;
pub mod link;

pub use carrier::{Carrier, Latest, Sample};

use carril_messages::{CompressedImage, Header, Image, MAX_IMAGE_BYTES, Message};

use crate::pictures;

/// A sample as nodes read it: a compressed image becomes an image of the size and the pixels that it was made from.
pub fn unpacked((mut header, payload): Sample) -> Result<Sample, String> {
    if header.message_type != CompressedImage::TYPE {
        return Ok((header, payload));
    }
    let compressed = CompressedImage::decode(&header.meta, &payload).map_err(|error| error.to_string())?;
    let image = pictures::restore(&compressed, MAX_IMAGE_BYTES).map_err(|error| error.to_string())?;
    let encoded = image.encode().map_err(|error| error.to_string())?;
    header.message_type = Image::TYPE;
    header.meta = encoded.meta;
    Ok((header, encoded.payload))
}

/// A sample as it goes over a link: an image is scaled down and compressed.
pub fn packed((mut header, payload): Sample, max_width: u32, quality: u8) -> Result<Sample, String> {
    if header.message_type != Image::TYPE {
        return Ok((header, payload));
    }
    let text = |error: &dyn std::fmt::Display| error.to_string();
    let image = Image::decode(&header.meta, &payload).map_err(|error| text(&error))?;
    let compressed = pictures::compressed(&image, max_width, quality).map_err(|error| text(&error))?;
    let encoded = compressed.encode().map_err(|error| text(&error))?;
    header.message_type = CompressedImage::TYPE;
    header.meta = encoded.meta;
    Ok((header, encoded.payload))
}

/// Whether a sample of this type may come on a port of that type.
pub(crate) fn fits(header: &Header, port_type: &str) -> bool {
    let name = &header.message_type.name;
    *name == port_type || (port_type == Image::TYPE.name && *name == CompressedImage::TYPE.name)
}

#[cfg(test)]
mod tests {
    use carril_messages::{Encoding, Meta, Origins, Payload, Stamp};

    use super::*;

    fn sample(image: &Image) -> Sample {
        let encoded = image.encode().expect("an image encodes");
        let (stamp, origins) = (Stamp::from_nanos(7), Origins::none());
        let header = Header { epoch: 3, seq: 5, stamp, origins, message_type: Image::TYPE, meta: encoded.meta };
        (header, encoded.payload)
    }

    #[test]
    fn an_image_comes_out_of_a_link_in_its_own_size_and_encoding() {
        for encoding in [Encoding::Rgb8, Encoding::Bgr8, Encoding::Mono8] {
            let pixels = vec![120; 64 * 48 * encoding.bytes_per_pixel()];
            let image = Image::packed(64, 48, encoding, Payload::from(pixels)).expect("it fits");
            let on_the_way = packed(sample(&image), 32, 90).expect("it can be compressed");
            assert!(fits(&on_the_way.0, "carril/Image"), "it may come on a port of images");
            assert!(on_the_way.1.len() < image.pixels().len() / 4, "smaller: {} B", on_the_way.1.len());
            let (header, payload) = unpacked(on_the_way).expect("and restored");
            let back = Image::decode(&header.meta, &payload).expect("it is an image");
            assert_eq!((back.width(), back.height(), back.encoding()), (64, 48, encoding), "as it was");
            assert!(back.row(20)[30].abs_diff(120) < 8, "{encoding}: the colours are about the same");
            assert_eq!((header.epoch, header.seq, header.stamp), (3, 5, Stamp::from_nanos(7)), "its place and time");
        }
    }

    #[test]
    fn what_is_no_image_passes_as_it_is_and_damaged_pictures_are_refused() {
        let (stamp, origins, meta) = (Stamp::ZERO, Origins::none(), Meta::new());
        let message_type = carril_messages::Command::TYPE;
        let header = Header { epoch: 0, seq: 0, stamp, origins, message_type, meta };
        let command = (header, Payload::from(vec![1, 2]));
        assert_eq!(unpacked(command.clone()), Ok(command.clone()), "out");
        assert_eq!(packed(command.clone(), 480, 60), Ok(command.clone()), "in");
        assert!(!fits(&command.0, "carril/Image"), "and is no image");
        let image = Image::packed(8, 8, Encoding::Bgr8, Payload::from(vec![0; 192])).expect("it fits");
        let (header, _) = packed(sample(&image), 8, 60).expect("it can be compressed");
        assert!(unpacked((header, Payload::from(vec![0xff; 20]))).is_err(), "no JPEG");
    }
}
