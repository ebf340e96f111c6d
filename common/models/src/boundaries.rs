//! The embedded segmentation model: predicts boundaries between objects of any kind in a photo.
//!
//! A small U-Net (Ronneberger et al. 2015), trained on generated photos
//! (`embedded/train_segmenter.py`). The graph segmenter joins pixels by its predictions.

use std::path::Path;

use ::image::{Rgb, RgbImage};
use ort::value::TensorElementType;
use sha2::{Digest, Sha256};

use crate::{
    ModelFile,
    session::{Model, SessionError, SessionOptions},
};

const SEGMENT: &[u8] = include_bytes!("../embedded/segment.onnx");
const INPUT: &str = "pixel_values";
const OUTPUT: &str = "boundaries";
/// Width and height must be multiples of this: the model halves them four times.
const MULTIPLE: u32 = 16;
/// Neighbours of a pixel with a predicted boundary: right, below left, below, below right.
pub const N_NEIGHBOURS: usize = 4;

/// The opened model.
#[derive(Debug)]
pub struct Boundaries(Model);

impl Boundaries {
    /// Opens the embedded model.
    /// # Errors
    /// [`SessionError`] if ONNX Runtime does not load.
    pub fn open(options: &SessionOptions) -> Result<Self, SessionError> {
        let model = Model::open(&ModelFile::embedded(Path::new("segment.onnx"), SEGMENT), options)?;
        model.expect_input(INPUT, TensorElementType::Float32, &[1, 3, -1, -1])?;
        Ok(Self(model))
    }

    /// Returns the SHA-256 of the embedded model file, in hexadecimal.
    pub fn sha256() -> String {
        hex::encode(Sha256::digest(SEGMENT))
    }

    /// Returns the probability that each pixel and its neighbour show different objects, `[4][height][width]`:
    /// right, below left, below, below right.
    /// # Errors
    /// [`SessionError::Run`].
    pub fn of(&mut self, image: &RgbImage) -> Result<Vec<f32>, SessionError> {
        let (width, height) = image.dimensions();
        let [wide, high] = [width, height].map(|side| side.next_multiple_of(MULTIPLE));
        let mut pixels = Vec::with_capacity(3 * wide as usize * high as usize);
        for channel in 0..3 {
            for y in 0..high {
                // The last row and column are repeated beyond the border.
                pixels.extend((0..wide).map(|x| {
                    let Rgb(rgb) = image.get_pixel(x.min(width - 1), y.min(height - 1));
                    f32::from(rgb[channel]) / 127.5 - 1.0
                }));
            }
        }
        let shape = [i64::from(high), i64::from(wide)];
        let input = self.0.tensor(vec![1, 3, shape[0], shape[1]], &pixels)?;
        let padded =
            self.0.run(vec![(INPUT, input)], OUTPUT, &[1, N_NEIGHBOURS as i64, shape[0], shape[1]])?;
        let rows = padded.chunks_exact(wide as usize);
        let inside = rows.enumerate().filter(|(row, _)| *row as u32 % high < height);
        Ok(inside.flat_map(|(_, row)| row[..width as usize].iter().copied()).collect())
    }
}
