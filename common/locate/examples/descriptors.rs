//! Writes the descriptors of photos to stdout, 128 f32 each, for `train_codes.py`: `descriptors PHOTO...`.

use std::io::{self, Write};

use slag_locate::{Grey, features};

const LIMIT: usize = 800;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut out = io::BufWriter::new(io::stdout().lock());
    for path in std::env::args_os().skip(1) {
        let photo = image::open(&path)?.into_rgb8();
        let grey = Grey::from_rgb8(photo.width() as usize, photo.height() as usize, photo.as_raw());
        for number in features(&grey, LIMIT).iter().flat_map(|feature| feature.descriptor) {
            out.write_all(&number.to_le_bytes())?;
        }
    }
    Ok(out.flush()?)
}
