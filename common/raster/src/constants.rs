//! Constants of the rasteriser, equal to those of gsplat 1.5.3; all backends take them from here.

pub const TILE_SIZE_PX: usize = 16;
/// Camera z below which a Gaussian is not drawn, world units.
pub const NEAR_Z: f64 = 0.01;
/// Camera z above which a Gaussian is not drawn, world units.
pub const FAR_Z: f64 = 1e10;
/// Added to the diagonal of a projected covariance, px^2: the reconstruction filter of the pixel grid.
pub const COVARIANCE_BLUR_PX2: f64 = 0.3;
/// Largest alpha of a Gaussian at a pixel, so that the transmittance never reaches 0.
pub const MAX_ALPHA: f32 = 0.999;
/// Smallest alpha that counts: the footprint of a Gaussian ends where its alpha falls below.
pub const MIN_ALPHA: f32 = 1.0 / 255.0;
/// Transmittance of an opaque pixel. The first Gaussian that would reach it is not blended and ends the pixel.
pub const MIN_TRANSMITTANCE: f32 = 1e-4;
/// Margin around the image within which the Jacobian is exact, as a share of the tangent of half the field of view;
/// beyond it, the Jacobian is evaluated at the limit.
pub const FOV_MARGIN: f64 = 0.3;
/// Added to the squared Mahalanobis reach of a footprint before culling. The rounding error of `f32` is below
/// 5e-5, so no pixel with sufficient alpha is culled.
pub const REACH2_MARGIN: f64 = 2e-4;
/// Largest projected variance, px^2; beyond it, the `f32` arithmetic of the pixels is meaningless.
pub const MAX_VARIANCE_PX2: f64 = 1e24;
/// Most pixels of one view (16k x 16k).
pub const MAX_IMAGE_PX: u64 = 1 << 28;
/// Longest side of a view, pixels. With longer ones the errors of a GPU without doubles exceed 1e-3.
pub const MAX_SIDE_PX: u32 = 32_768;
/// Fraction bits of the fixed-point weights that are summed over tiles.
pub const SUM_FRACTION_BITS: i32 = 32;
