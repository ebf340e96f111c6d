//! The GPU against the CPU.

use std::collections::BTreeMap;

use slag_encoder::raster::gpu::{GpuOptions, GpuRasterizer, Precision, adapters};
use slag_encoder::raster::{CpuRasterizer, Rasterizer, WeightKind};

use crate::fixtures::{Npz, points, view, widened};

#[test]
fn garden() {
    let Some(mut npz) = Npz::open("fixtures/gsplat_garden.npz") else { return };
    let means = points(&npz.array("means"));
    let scene = npz.scene(means);
    let (poses, matrices) = (npz.array::<f32>("viewmats"), npz.array::<f32>("Ks"));
    let adapters = adapters();
    for a in &adapters {
        println!("{:?}", a.report);
    }
    for precision in [Precision::F64, Precision::F32] {
        let gpu = GpuRasterizer::new(adapters[0].open(precision).unwrap(), GpuOptions::default());
        let loaded = gpu.load(&scene).unwrap();
        for v in 0..3 {
            let camera = npz.intrinsics(&matrices[v * 9..]);
            let regions = npz.regions(&camera);
            let view = view(&widened(&poses[v * 16..][..16]), camera);
            let start = std::time::Instant::now();
            let found = loaded.weights(&view, &regions, WeightKind::Blend).unwrap();
            println!("{precision:?} {:?} {:?}", start.elapsed(), found.counters);
            let expected = CpuRasterizer.weights(&scene, &view, &regions, WeightKind::Blend).unwrap();
            println!("cpu {:?} {} {}", expected.counters, found.entries.len(), expected.entries.len());
            let mut d = BTreeMap::<(u32, u32), f64>::new();
            for e in &found.entries {
                *d.entry((e.gaussian, e.region)).or_default() += f64::from(e.weight);
            }
            for e in &expected.entries {
                *d.entry((e.gaussian, e.region)).or_default() -= f64::from(e.weight);
            }
            let total: f64 = expected.entries.iter().map(|e| f64::from(e.weight)).sum();
            let l1: f64 = d.values().map(|v| v.abs()).sum();
            let max = d.values().fold(0.0_f64, |m, v| m.max(v.abs()));
            println!("L1 {:e} max {max:e}", l1 / total);
        }
    }
}
