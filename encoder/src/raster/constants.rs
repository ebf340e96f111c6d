//! Constants of the rasteriser, as gsplat 1.5.3 has them; every backend takes them from here.

/// Edge of a screen tile, pixels.
pub const TILE_SIZE_PX: usize = 16;
/// Camera z below which a Gaussian is not drawn, world units.
pub const NEAR_Z: f64 = 0.01;
/// Camera z above which a Gaussian is not drawn, world units.
pub const FAR_Z: f64 = 1e10;
/// Added to the diagonal of a projected covariance, px^2: the reconstruction filter of a pixel.
pub const COVARIANCE_BLUR_PX2: f64 = 0.3;
/// Largest alpha of one Gaussian at a pixel, so that the transmittance never becomes 0.
pub const MAX_ALPHA: f32 = 0.999;
/// Smallest alpha that counts: the footprint of a Gaussian ends where it falls below.
pub const MIN_ALPHA: f32 = 1.0 / 255.0;
/// A pixel is finished by the first Gaussian that would bring its transmittance to this or below;
/// that Gaussian no longer counts.
pub const MIN_TRANSMITTANCE: f32 = 1e-4;
/// How far beyond the image the projection's Jacobian is still taken exactly, as a share of half
/// the field of view's tangent; further out it is taken at that limit.
pub const FOV_MARGIN: f64 = 0.3;
/// Added to the squared Mahalanobis reach of a footprint before culling, so that `f32` rounding
/// (below 5e-5 there) never culls a pixel whose alpha would count.
pub const REACH2_MARGIN: f64 = 2e-4;
/// Largest projected variance, px^2: above it the `f32` arithmetic of the pixels has no meaning.
pub const MAX_VARIANCE_PX2: f64 = 1e24;
/// Most pixels of one view (16k x 16k).
pub const MAX_IMAGE_PX: u64 = 1 << 28;
/// Fraction bits of the fixed-point sums over tiles.
pub const SUM_FRACTION_BITS: i32 = 32;
