//! Photos with the thing at each pixel: training data of the segmenter.

use std::path::Path;

use anyhow::Result;
use rayon::prelude::*;
use slag_common::npy;

use super::compose::{FIELD_OF_VIEW_RAD, Layout, PHOTO_PX, pinhole};
use super::grammar::SceneKind;
use super::render::{NOTHING, Photo};
use slag_encoder::progress::Progress;
use slag_math::random::Xorshift;

const N_PHOTOS: u32 = 4;

/// Writes photos of the scenes of some seeds: `photos.npy` (u8 `[n][height][width][3]`), `things.npy` (u16
/// `[n][height][width]`: the thing's number, 65535 for the sky) and `depths.npy` (f32 `[n][height][width]`: metres
/// along the camera's axis, infinite for the sky). Returns the number of photos.
///
/// From the ground, or from drones 8 to 40 m up.
pub fn write(
    folder: &Path,
    seeds: std::ops::Range<u64>,
    are_aerial: bool,
    progress: &dyn Progress,
) -> Result<usize> {
    fs_err::create_dir_all(folder)?;
    progress.begin("scenes", "scene", seeds.end - seeds.start, 0);
    let of_seed = |seed: u64| {
        let layout = match are_aerial {
            true => Layout::new(&[SceneKind::Yard, SceneKind::Street], seed, &|_, _| true),
            false => Layout::of_any_kind(seed, &|_, _| true),
        };
        let solids = layout.solids();
        let start = Xorshift::new(seed ^ 0xf070).between(0.0, 1.0);
        let intrinsics = pinhole(PHOTO_PX, FIELD_OF_VIEW_RAD);
        let views = match are_aerial {
            true => layout.fly(N_PHOTOS, (start * 1e6) as u32, 8.0..40.0, intrinsics),
            false => layout.walk(N_PHOTOS, start, intrinsics),
        };
        let photos: Vec<Photo> = views.iter().map(|view| solids.photo(view)).collect();
        progress.advance(1);
        photos
    };
    let photos: Vec<Photo> = seeds.into_par_iter().flat_map_iter(of_seed).collect();
    progress.end();
    let shape = [photos.len(), PHOTO_PX[1] as usize, PHOTO_PX[0] as usize];
    let pixels: Vec<u8> = photos.iter().flat_map(|photo| photo.image.as_raw().iter().copied()).collect();
    npy::write_file(&folder.join("photos.npy"), &[&shape[..], &[3]].concat(), &pixels)?;
    let things: Vec<u16> = photos.iter().flat_map(|photo| photo.thing_of_pixel.iter().copied()).collect();
    debug_assert_eq!(NOTHING, u16::MAX);
    npy::write_file(&folder.join("things.npy"), &shape, &things)?;
    let depths_m: Vec<f32> = photos.iter().flat_map(|photo| photo.depth_m.iter().copied()).collect();
    npy::write_file(&folder.join("depths.npy"), &shape, &depths_m)?;
    Ok(photos.len())
}

#[cfg(test)]
mod tests {
    use slag_common::npy;

    /// Oracle: another program's reader of the format.
    #[test]
    fn arrays_are_read_by_another_reader() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("array.npy");
        let values: Vec<u16> = (0..30).map(|i| i * 2003).collect();
        npy::write_file(&path, &[5, 2, 3], &values).expect("writes");
        let bytes = fs_err::read(&path).expect("reads");
        let array = npyz::NpyFile::new(&bytes[..]).expect("an array");
        assert_eq!(array.shape(), [5, 2, 3]);
        assert_eq!(array.into_vec::<u16>().expect("u16"), values);
        for n in [0usize, 1, 70, 1000] {
            let values: Vec<f32> = (0..n).map(|i| i as f32 * 0.5).collect();
            let mut bytes = Vec::new();
            npy::write(&mut bytes, &[n], &values).expect("writes to memory");
            let array = npyz::NpyFile::new(&bytes[..]).expect("an array");
            assert_eq!(array.shape(), [n as u64]);
            assert_eq!(array.into_vec::<f32>().expect("f32"), values);
        }
    }
}
