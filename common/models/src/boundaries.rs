//! The embedded segmentation model: predicts boundaries between objects in a photo and its depths, by which the graph
//! segmenter joins pixels. A small U-Net (Ronneberger et al. 2015), trained on repainted generated photos
//! (`embedded/train_segmenter.py`).

use std::path::Path;

use ::image::RgbImage;
use ort::value::TensorElementType;
use sha2::{Digest, Sha256};

use crate::{
    ModelError, ModelFile,
    session::{Model, SessionOptions},
};

const SEGMENT: &[u8] = include_bytes!("../embedded/segment.onnx");
const INPUT: &str = "pixel_values";
const OUTPUT: &str = "boundaries";
/// Width and height must be multiples of this: the model halves them five times.
const MULTIPLE: u32 = 32;
/// Red, green, blue and [`depth_channels`].
const N_CHANNELS: usize = 7;
/// Slopes of the logarithm of depth span this many pixels on both sides.
const SLOPE_REACH_PX: usize = 2;
/// Factor of a slope (over twice [`SLOPE_REACH_PX`]) before tanh.
const SLOPE_SCALE: f32 = 20.0;
/// Neighbours of a pixel with a predicted boundary: right, below left, below, below right.
pub const N_NEIGHBOURS: usize = 4;

#[derive(Debug)]
pub struct Boundaries(Model);

impl Boundaries {
    pub fn open(options: &SessionOptions) -> Result<Self, ModelError> {
        let model = Model::open(&ModelFile::embedded(Path::new("segment.onnx"), SEGMENT), options)?;
        model.expect_input(INPUT, TensorElementType::Float32, &[1, N_CHANNELS as i64, -1, -1])?;
        Ok(Self(model))
    }

    pub fn sha256() -> String {
        hex::encode(Sha256::digest(SEGMENT))
    }

    /// Returns the probability that each pixel and its neighbour show different objects, `[4][height][width]`:
    /// right, below left, below, below right.
    ///
    /// `depth_m`: `[height][width]`, along the camera's axis; at most 0, or NaN, where it is unknown.
    pub fn of(&mut self, image: &RgbImage, depth_m: Option<&[f32]>) -> Result<Vec<f32>, ModelError> {
        let (width, height) = image.dimensions();
        let [wide, high] = [width, height].map(|side| side.next_multiple_of(MULTIPLE));
        let of_depth = depth_m.map(|depth_m| depth_channels(depth_m, width as usize));
        let (colours, _) = image.as_raw().as_chunks::<3>();
        let mut pixels = Vec::with_capacity(N_CHANNELS * wide as usize * high as usize);
        for channel in 0..N_CHANNELS {
            for y in 0..high {
                let start = pixels.len();
                let row = (y.min(height - 1) * width) as usize..;
                match (channel.checked_sub(3), &of_depth) {
                    (None, _) => {
                        let row = colours[row].iter().take(width as usize);
                        pixels.extend(row.map(|colour| f32::from(colour[channel]) / 127.5 - 1.0));
                    }
                    (Some(channel), Some(of)) => {
                        pixels.extend(of[row].iter().take(width as usize).map(|of| of[channel]));
                    }
                    (Some(_), None) => pixels.resize(start + width as usize, 0.0),
                }
                // Repeats the last row and column beyond the border.
                let last = pixels.last().copied().unwrap_or_default();
                pixels.resize(start + wide as usize, last);
            }
        }
        let shape = [i64::from(high), i64::from(wide)];
        let input = self.0.tensor(vec![1, N_CHANNELS as i64, shape[0], shape[1]], &pixels)?;
        let padded =
            self.0.run(vec![(INPUT, input)], OUTPUT, &[1, N_NEIGHBOURS as i64, shape[0], shape[1]])?;
        let rows = padded.chunks_exact(wide as usize);
        let inside = rows.enumerate().filter(|(row, _)| *row as u32 % high < height);
        Ok(inside.flat_map(|(_, row)| row[..width as usize].iter().copied()).collect())
    }
}

/// Returns the depth channels of each pixel: half the logarithm of depth over the median depth, its slopes to the
/// right and down, and 1. The first and last are 0 where depth is unknown, a slope where it is unknown at either
/// end. None changes with the scene's scale. `depth_m`: `[height][width_px]`.
fn depth_channels(depth_m: &[f32], width_px: usize) -> Vec<[f32; 4]> {
    let logs: Vec<f32> =
        depth_m.iter().map(|depth_m| if *depth_m > 0.0 { depth_m.ln() } else { f32::NAN }).collect();
    let mut known: Vec<f32> = logs.iter().copied().filter(|log| log.is_finite()).collect();
    let middle = known.len().saturating_sub(1) / 2;
    let median = match known.is_empty() {
        true => 0.0,
        false => *known.select_nth_unstable_by(middle, f32::total_cmp).1,
    };
    let height_px = depth_m.len() / width_px.max(1);
    let slope = |from: usize, to: usize| match (SLOPE_SCALE * (logs[to] - logs[from])).tanh() {
        slope if slope.is_finite() => slope,
        _ => 0.0,
    };
    let of = |pixel: usize| {
        let (x, y) = (pixel % width_px, pixel / width_px);
        let around =
            |at: usize, len: usize| (at.saturating_sub(SLOPE_REACH_PX), (at + SLOPE_REACH_PX).min(len - 1));
        let ((left, right), (up, down)) = (around(x, width_px), around(y, height_px));
        let right = slope(y * width_px + left, y * width_px + right);
        let down = slope(up * width_px + x, down * width_px + x);
        match logs[pixel].is_finite() {
            true => [((logs[pixel] - median) / 2.0).clamp(-2.0, 2.0), right, down, 1.0],
            false => [0.0, right, down, 0.0],
        }
    };
    (0..height_px * width_px).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: depth grows by a hundredth per column, so the slope of the logarithm over four columns is 0.04.
    #[test]
    fn depth_is_seen_as_slopes_whatever_its_scale() {
        for scale in [1.0, 300.0] {
            let depth_m: Vec<f32> = (0..9 * 5).map(|i| scale * (0.01 * (i % 9) as f32).exp()).collect();
            let channels = depth_channels(&depth_m, 9);
            let [relative, right, down, known] = channels[2 * 9 + 6];
            assert!((relative - 0.01).abs() < 1e-6, "two columns beyond the median: {relative}");
            assert!((right - 0.8_f32.tanh()).abs() < 1e-5, "{right}");
            assert_eq!((down, known), (0.0, 1.0));
            assert!(
                (channels[0][1] - 0.4_f32.tanh()).abs() < 1e-5,
                "at the border half as far: {:?}",
                channels[0]
            );
        }
    }

    /// A depth map and the channels that the training script computes from it.
    #[derive(serde::Deserialize)]
    struct Recorded {
        width_px: usize,
        depth_m: Vec<Option<f32>>,
        channels: Vec<[f32; 4]>,
    }

    /// Recorded from the training's own function (`tests/models/depth_channels/export.py`).
    #[test]
    fn depth_is_seen_as_in_training() {
        let golden = include_str!("../../../tests/models/depth_channels/golden.json");
        let maps: Vec<Recorded> = serde_json::from_str(golden).expect("it is JSON");
        assert_eq!(maps.len(), 4);
        for Recorded { width_px, depth_m, channels } in maps {
            let depth_m: Vec<f32> = depth_m.into_iter().map(|depth_m| depth_m.unwrap_or(f32::NAN)).collect();
            let found = depth_channels(&depth_m, width_px);
            assert_eq!(found.len(), channels.len());
            for (pixel, (found, expected)) in found.iter().zip(&channels).enumerate() {
                let is_near = found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 2e-5);
                assert!(is_near, "width {width_px}, pixel {pixel}: {found:?}, in training {expected:?}");
            }
        }
    }

    #[test]
    fn unknown_depth_is_zero() {
        let mut depth_m = vec![2.0; 6 * 6];
        (depth_m[14], depth_m[15]) = (0.0, f32::NAN);
        let channels = depth_channels(&depth_m, 6);
        assert_eq!(channels[14], [0.0; 4]);
        assert_eq!(channels[15], [0.0; 4]);
        assert_eq!(channels[12], [0.0, 0.0, 0.0, 1.0], "the slope ends at an unknown depth");
        assert_eq!(depth_channels(&[0.0; 12], 4), [[0.0; 4]; 12]);
    }
}
