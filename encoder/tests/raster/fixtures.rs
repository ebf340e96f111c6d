//! Reads the shared test data.

use super::*;
use std::path::PathBuf;

use npyz::Deserialize;
use slag_encoder::ingest::load_image;
use slag_test_support::npz_array;
pub use slag_test_support::{needs_shared, shared};

pub fn read_splat(root: &Path) -> Gaussians {
    splat::read(&root.join("point_cloud.ply"), &splat::ReadOptions { with_sh_rest: false }).unwrap()
}

pub fn photo(view: &View) -> CheckView {
    let loaded = load_image(view).unwrap();
    let view = RasterView::of(&loaded.view);
    CheckView { name: loaded.view.name, image: loaded.image, valid: None, view }
}

/// Averages pixels, so that repeated checks are faster.
pub fn shrunk(photo: CheckView, width_px: u32) -> CheckView {
    let intrinsics = photo.view.intrinsics.scaled_to_width(width_px);
    let image = image::imageops::thumbnail(&photo.image, intrinsics.width_px, intrinsics.height_px);
    CheckView { image, view: RasterView { intrinsics, ..photo.view }, ..photo }
}

pub struct Npz(PathBuf);

impl Npz {
    pub fn open(path: &str) -> Self {
        Self(shared(path))
    }

    pub fn array<T: Deserialize>(&self, name: &str) -> Vec<T> {
        npz_array(&self.0, name).1
    }

    pub fn scene(&self, means_in_world: Vec<DVec3>) -> Gaussians {
        let n = means_in_world.len();
        Gaussians {
            means_in_world,
            rotations_wxyz: rows::<4, f32>(&self.array("quats")).map(normalized).collect(),
            scales: rows(&self.array("scales")).collect(),
            opacities: self.array("opacities"),
            sh_dc: vec![[0.0; 3]; n],
            sh_rest: Vec::new(),
            sh_degree: 0,
        }
    }

    /// A camera with the archive's image size.
    pub fn intrinsics(&self, matrix: &[f32]) -> Intrinsics {
        Intrinsics {
            width_px: self.array::<i64>("width")[0] as u32,
            height_px: self.array::<i64>("height")[0] as u32,
            focal_x_px: matrix[0].into(),
            focal_y_px: matrix[4].into(),
            centre_x_px: matrix[2].into(),
            centre_y_px: matrix[5].into(),
            distortion: Distortion::None,
        }
    }

    pub fn regions(&self, camera: &Intrinsics) -> RegionMap {
        let region_of_pixel: Vec<u32> = self.array::<u8>("labels").into_iter().map(u32::from).collect();
        RegionMap {
            width_px: camera.width_px,
            height_px: camera.height_px,
            n_regions: region_of_pixel.iter().max().unwrap() + 1,
            region_of_pixel,
        }
    }
}

fn normalized(q: [f32; 4]) -> [f32; 4] {
    let norm = q.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt();
    q.map(|c| (f64::from(c) / norm) as f32)
}

pub fn rows<const N: usize, T: Copy>(values: &[T]) -> impl Iterator<Item = [T; N]> + '_ {
    values.chunks_exact(N).map(|row| row.try_into().unwrap())
}

pub fn points(values: &[f32]) -> Vec<DVec3> {
    rows::<3, f32>(values).map(|p| DVec3::from_array(p.map(f64::from))).collect()
}

/// From a row-major 4x4 matrix.
pub fn view(matrix: &[f64], intrinsics: Intrinsics) -> RasterView {
    let m = |r: usize, c: usize| matrix[r * 4 + c];
    let column = |c: usize| DVec3::new(m(0, c), m(1, c), m(2, c));
    RasterView {
        camera_from_world: DAffine3 {
            matrix3: DMat3::from_cols(column(0), column(1), column(2)),
            translation: column(3),
        },
        intrinsics,
    }
}

pub fn widened(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| v.into()).collect()
}
