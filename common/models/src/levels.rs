//! Turns squares of 8-bit levels into pixel values on the image model's GPU: one byte per value crosses to the
//! GPU, where it becomes two or four; the processor only splits pixels into planes.

use std::path::Path;

use half::f16;
use image::RgbImage;
use ort::value::DynTensor;

use crate::bound::Place;
use crate::floats::bytes_mut;
use crate::placement::DeviceMemory;
use crate::preprocess::Preprocess;
use crate::session::{Model, SessionOptions};
use crate::{ModelError, ModelFile};

/// Made by `embedded/levels.py`.
const F16: &[u8] = include_bytes!("../embedded/levels_f16.onnx");
const F32: &[u8] = include_bytes!("../embedded/levels_f32.onnx");

/// Threads that split a batch into planes: one alone would take longer than the model.
const N_THREADS: usize = 4;

/// A batch of squares, converted to pixel values by a GPU.
#[derive(Debug)]
pub(crate) struct Levels {
    model: Model,
    /// `[batch][3][size_px][size_px]`, u8; reused by every batch.
    squares: DynTensor,
    square_bytes: usize,
    scale: DynTensor,
    offset: DynTensor,
}

impl Levels {
    /// Opens the conversion of `batch` squares; `is_f16`: the type of pixel values.
    pub(crate) fn open(
        batch: usize,
        preprocess: &Preprocess,
        is_f16: bool,
        memory: &DeviceMemory,
        options: &SessionOptions,
    ) -> Result<Self, ModelError> {
        let (name, bytes) = if is_f16 { ("levels_f16.onnx", F16) } else { ("levels_f32.onnx", F32) };
        let model = Model::open(&ModelFile::embedded(Path::new(name), bytes), options)?;
        let size = i64::from(preprocess.size_px());
        let shape = [batch as i64, 3, size, size];
        let squares = memory.bytes(&model.session, &shape).map_err(|cause| model.run_error(cause))?;
        let of_channels = |values: [f32; 3]| match is_f16 {
            true => model.owned(vec![3, 1, 1], values.map(f16::from_f32).to_vec()),
            false => model.owned(vec![3, 1, 1], values.to_vec()),
        };
        let (scale, offset) = preprocess.scale_and_offset();
        let (scale, offset) = (of_channels(scale)?, of_channels(offset)?);
        Ok(Self { squares, square_bytes: (3 * size * size) as usize, model, scale, offset })
    }

    /// Returns the pixel values of a batch, `[batch][3][size_px][size_px]`, on the GPU. Unused places have
    /// arbitrary values: all batches have one shape, so that a vector does not depend on the number of others.
    pub(crate) fn values<'a>(
        &mut self,
        memory: &DeviceMemory,
        squares: impl Iterator<Item = std::borrow::Cow<'a, RgbImage>>,
    ) -> Result<DynTensor, ModelError> {
        let failed = |cause| self.model.run_error(cause);
        let (places, square_bytes) = (bytes_mut(&mut self.squares).map_err(failed)?, self.square_bytes);
        let squares: Vec<_> = squares.collect();
        let n_of_thread = squares.len().div_ceil(N_THREADS).max(1);
        std::thread::scope(|scope| {
            let places = places.chunks_mut(n_of_thread * square_bytes);
            for (squares, places) in squares.chunks(n_of_thread).zip(places) {
                let places = places.chunks_exact_mut(square_bytes);
                scope.spawn(|| {
                    squares.iter().zip(places).for_each(|(square, place)| part(square.as_raw(), place))
                });
            }
        });
        let inputs = [("levels", &self.squares), ("scale", &self.scale), ("offset", &self.offset)];
        let mut found = self.model.run_bound(memory, &inputs, &[("values", Place::Device)])?;
        Ok(found.swap_remove(0))
    }
}

/// Splits pixels `[n][3]` into planes `[3][n]`.
fn part(pixels: &[u8], planes: &mut [u8]) {
    let (reds, rest) = planes.split_at_mut(planes.len() / 3);
    let (greens, blues) = rest.split_at_mut(reds.len());
    let places = reds.iter_mut().zip(greens).zip(blues);
    for (pixel, ((red, green), blue)) in pixels.as_chunks::<3>().0.iter().zip(places) {
        [*red, *green, *blue] = *pixel;
    }
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;

    use super::*;
    use crate::floats::Floats;
    use crate::preprocess::{Filter, Resize};

    /// Oracle: the processor's table of values by level. In 16 bits a value of up to 4 is off by half a unit in
    /// its last place (0.001), and so are scale times level and offset.
    #[test]
    fn levels_become_the_pixel_values_of_the_table() {
        let preprocess = Preprocess::new(
            16,
            Resize::ShortestEdge,
            Filter::Bicubic,
            [0.481_454_66, 0.457_827_5, 0.408_210_73],
            [0.268_629_54, 0.261_302_58, 0.275_777_11],
        );
        let square = |k: usize| {
            RgbImage::from_fn(16, 16, |x, y| {
                image::Rgb(std::array::from_fn(|c| (x as usize * 16 + y as usize + 89 * (k + c)) as u8))
            })
        };
        let options = SessionOptions::new(slag_test_support::onnx_runtime());
        let memory = DeviceMemory::of_processor();
        for (is_f16, tolerance) in [(false, 1e-6), (true, 4e-3)] {
            let mut levels = Levels::open(3, &preprocess, is_f16, &memory, &options).expect("opens");
            // The second batch is not full, and must not mix with the first.
            for batch in [vec![0, 1, 2], vec![5, 6]] {
                let squares = batch.iter().map(|k| Cow::Owned(square(*k)));
                let (shape, found) =
                    Floats::of(levels.values(&memory, squares).expect("runs")).expect("readable");
                assert_eq!(shape, [3, 3, 16, 16]);
                let mut expected = Vec::new();
                batch.iter().for_each(|k| preprocess.append_pixel_values(&square(*k), &mut expected));
                let off = expected.iter().zip(&*found).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(off <= tolerance, "f16: {is_f16}, off by {off}");
            }
        }
    }
}
