//! The rasterisers under test.

use super::*;
use std::sync::OnceLock;

use slag_encoder::raster::gpu::Precision;

/// A rasteriser and the tolerances of its arithmetic.
pub struct Backend {
    pub name: &'static str,
    pub rasterizer: Box<dyn Rasterizer>,
    /// Factor on the errors that the rows claim.
    pub bound_factor: f64,
    /// Relative error of alpha within which either side of a cut is accepted.
    pub cut_tolerance: f64,
    /// Whether depth order and sides of cuts equal the oracle's unless rounding decides. An f32 projection swaps
    /// neighbours in depth, which changes single weights but hardly their sum.
    pub keeps_order: bool,
    /// Whether the processor imitates it: a hundred times slower than a GPU.
    pub is_software_gpu: bool,
}

/// From this many cases on, a software GPU runs one in `SOFTWARE_GPU_STEP`.
const MANY_CASES: usize = 40;
const SOFTWARE_GPU_STEP: usize = 4;

impl Backend {
    /// Step through `n` cases.
    pub fn case_step(&self, n: usize) -> usize {
        if self.is_software_gpu && n >= MANY_CASES { SOFTWARE_GPU_STEP } else { 1 }
    }
}

pub fn backends() -> &'static [Backend] {
    static BACKENDS: OnceLock<Vec<Backend>> = OnceLock::new();
    BACKENDS.get_or_init(|| {
        let mut backends = vec![
            // Where they matter, `u` and `v` are below 32 at the start of a tile, so off by at most 6e-6 after
            // three roundings of f32, and alpha by 3.4 times that.
            Backend {
                name: "cpu",
                rasterizer: Box::new(CpuRasterizer),
                bound_factor: 1.0,
                cut_tolerance: 2e-5,
                keeps_order: true,
                is_software_gpu: false,
            },
        ];
        let adapter = adapters().into_iter().next();
        assert!(adapter.is_some() || !gpu_is_expected(), "no adapter: install mesa-vulkan-drivers");
        match adapter {
            None => println!("skipped on the GPU: there is none"),
            Some(adapter) => {
                for (name, precision, bound_factor, cut_tolerance) in
                    [("gpu", Precision::F64, 1.0, 2e-5), ("gpu f32", Precision::F32, 100.0, 2e-3)]
                {
                    if precision == Precision::F64 && adapter.report.precision == Precision::F32 {
                        println!("skipped on the GPU in f64: {} has none", adapter.report.name);
                        continue;
                    }
                    let device = adapter.open(precision).expect("the adapter opens");
                    let rasterizer = Box::new(GpuRasterizer::new(device, GpuOptions::default()));
                    let keeps_order = precision == Precision::F64;
                    let is_software_gpu = adapter.report.kind == "software";
                    backends.push(Backend {
                        name,
                        rasterizer,
                        bound_factor,
                        cut_tolerance,
                        keeps_order,
                        is_software_gpu,
                    });
                }
            }
        }
        backends
    })
}

/// CI installs an adapter.
pub fn gpu_is_expected() -> bool {
    std::env::var("CI").as_deref() == Ok("true")
}
