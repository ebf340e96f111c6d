//! The rasterisers under test.

use std::sync::OnceLock;

use slag_encoder::raster::{CpuRasterizer, Rasterizer};

/// A rasteriser with what its arithmetic allows.
pub struct Backend {
    /// Its name in the table.
    pub name: &'static str,
    /// The rasteriser.
    pub rasterizer: Box<dyn Rasterizer>,
    /// Factor on the bounds that the rows claim.
    pub bound_factor: f64,
    /// Relative error of alpha within which a pixel may fall on either side of a cut.
    pub cut_tolerance: f64,
}

/// Returns the rasterisers that every test of this binary runs on.
pub fn backends() -> &'static [Backend] {
    static BACKENDS: OnceLock<Vec<Backend>> = OnceLock::new();
    BACKENDS.get_or_init(|| {
        vec![
            // `u` and `v` are below 32 at the start of a tile where they matter, so off by 6e-6 at most
            // after three roundings of f32, and alpha by 3.4 times that.
            Backend {
                name: "cpu",
                rasterizer: Box::new(CpuRasterizer),
                bound_factor: 1.0,
                cut_tolerance: 2e-5,
            },
        ]
    })
}
