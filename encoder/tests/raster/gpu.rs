//! GPU only: chunks and bands, views shared between devices, lost devices.

use super::*;
use slag_encoder::raster::devices::{DeviceChoice, DeviceError, Devices};

use super::backends::gpu_is_expected;

/// Opens the first adapter in its best precision.
fn open(options: GpuOptions) -> Option<GpuRasterizer> {
    let Some(adapter) = adapters().into_iter().next() else {
        assert!(!gpu_is_expected(), "no adapter: install mesa-vulkan-drivers");
        println!("skipped: no GPU");
        return None;
    };
    Some(GpuRasterizer::new(adapter.open(adapter.report.precision).unwrap(), options))
}

fn weights(scene: &dyn LoadedScene, view: &RasterView, regions: &RegionMap) -> ViewWeights {
    scene.weights(view, regions).unwrap()
}

/// The second view fits the buffers of the first exactly; later ones are larger.
const SIZES_PX: [(u32, u32); 4] = [(70, 90), (70, 90), (131, 40), (33, 200)];

#[test]
fn chunks_and_bands_change_no_bit() {
    let Some(whole) = open(GpuOptions::default()) else { return };
    let random = &mut Random::new(20);
    let view = random_view(random, 70, 90);
    let scene = random_scene(random, 3000, &view, 0);
    // 56 bytes per visible Gaussian, 64 per Gaussian, 16 per sum of a tile: 937 a chunk, 1,071 visible and 3,750
    // sums a band. In the second case part of the scene stays on the device, in the third nothing.
    let mut n_with_bands = 0;
    // The last begins with almost no capacity, which must grow to the whole image in one band.
    for (max_binding_bytes, max_resident_bytes, first_capacity) in [
        (60_000, u64::MAX, 1 << 19),
        (90_000, 100_000, 1 << 19),
        (60_000, 0, 1 << 19),
        (1 << 27, u64::MAX, 100),
    ] {
        let default = GpuOptions::default();
        let options = GpuOptions { max_binding_bytes, max_resident_bytes, first_capacity, ..default };
        let cut = open(options).unwrap();
        let (whole, cut) = (whole.load(&scene).unwrap(), cut.load(&scene).unwrap());
        for (width, height) in SIZES_PX {
            let mut view = view;
            (view.intrinsics.width_px, view.intrinsics.height_px) = (width, height);
            let regions = random_regions(random, &view, 40);
            let expected = weights(whole.as_ref(), &view, &regions);
            let has_bands = expected.counters.visible > 1071;
            println!("{max_binding_bytes} {width}x{height}: bands {has_bands}, {:?}", expected.counters);
            n_with_bands += usize::from(has_bands);
            let found = weights(cut.as_ref(), &view, &regions);
            assert_eq!(found.counters, expected.counters, "{max_binding_bytes}");
            assert!(found == expected, "{max_binding_bytes} {max_resident_bytes} {width}x{height}");
        }
        let drawn = |scene: &dyn LoadedScene| scene.draw(&view, [0.1, 0.2, 0.3]).unwrap();
        assert!(drawn(cut.as_ref()) == drawn(whole.as_ref()));
    }
    assert!(n_with_bands > 3);
}

/// A device must hold at least one row of tiles.
#[test]
fn too_much_for_a_device_is_an_error_and_falls_to_the_cpu() {
    let options = GpuOptions { max_binding_bytes: 2000, ..GpuOptions::default() };
    let Some(tiny) = open(options) else { return };
    let random = &mut Random::new(21);
    let view = random_view(random, 60, 16);
    let scene = random_scene(random, 2000, &view, 0);
    let regions = random_regions(random, &view, 3);
    let error = tiny.weights(&scene, &view, &regions).unwrap_err();
    assert!(matches!(error, RasterError::DeviceCapacity { .. }), "{error}");
    let devices = Devices::of(vec![tiny], 2);
    let found = devices.weights(&scene, &view, &regions).unwrap();
    assert_eq!(found, CpuRasterizer.weights(&scene, &view, &regions).unwrap());
}

#[test]
fn the_same_bits_each_time_from_every_thread() {
    let Some(gpu) = open(GpuOptions { views_in_flight: 2, ..GpuOptions::default() }) else { return };
    let random = &mut Random::new(22);
    let view = random_view(random, 90, 70);
    let scene = random_scene(random, 4000, &view, 0);
    let regions = random_regions(random, &view, 100);
    let loaded = gpu.load(&scene).unwrap();
    let expected = weights(loaded.as_ref(), &view, &regions);
    assert!(expected.entries.len() > 1000);
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                for _ in 0..3 {
                    assert!(weights(loaded.as_ref(), &view, &regions) == expected);
                }
            });
        }
    });
}

/// Buffers left by earlier views, with fewer or more regions, do not change a bit.
#[test]
fn earlier_views_change_no_bit() {
    let Some(gpu) = open(GpuOptions { views_in_flight: 1, ..GpuOptions::default() }) else { return };
    let random = &mut Random::new(24);
    let view = random_view(random, 61, 53);
    let scene = random_scene(random, 3000, &view, 0);
    let loaded = gpu.load(&scene).unwrap();
    for n_regions in [3, 1, 600, 40] {
        let regions = random_regions(random, &view, n_regions);
        let expected = gpu.weights(&scene, &view, &regions).unwrap();
        assert!(weights(loaded.as_ref(), &view, &regions) == expected, "{n_regions} regions");
    }
    // More regions than a device numbers.
    let mut many = random_regions(random, &view, 3);
    many.n_regions = 1 << 16;
    let error = gpu.weights(&scene, &view, &many).unwrap_err();
    assert!(matches!(error, RasterError::DeviceCapacity { .. }), "{error}");
}

/// Four threads request views from two devices; one device is lost, then the other.
#[test]
fn a_lost_device_loses_no_view() {
    let (Some(a), Some(b)) = (open(GpuOptions::default()), open(GpuOptions::default())) else { return };
    let random = &mut Random::new(23);
    let views: Vec<RasterView> = (0..6).map(|_| random_view(random, 50, 40)).collect();
    let scene = random_scene(random, 1500, &views[0], 0);
    let regions = random_regions(random, &views[0], 12);
    let expected: Vec<ViewWeights> =
        views.iter().map(|view| CpuRasterizer.weights(&scene, view, &regions).unwrap()).collect();
    let devices = Devices::of(vec![a, b], 1);
    let loaded = devices.load(&scene).unwrap();
    let all = || {
        std::thread::scope(|scope| {
            let threads: Vec<_> = (0..4)
                .map(|_| {
                    scope.spawn(|| {
                        views.iter().map(|view| weights(loaded.as_ref(), view, &regions)).collect::<Vec<_>>()
                    })
                })
                .collect();
            threads.into_iter().flat_map(|thread| thread.join().unwrap()).collect::<Vec<_>>()
        })
    };
    let near = |found: &[ViewWeights]| {
        for (found, expected) in found.iter().zip(expected.iter().cycle()) {
            assert_eq!(found.counters, expected.counters);
            for (a, b) in found.entries.iter().zip(&expected.entries) {
                assert_eq!((a.gaussian, a.region), (b.gaussian, b.region));
                assert!((a.weight - b.weight).abs() < 1e-4 * b.weight.max(1.0), "{a:?} {b:?}");
            }
        }
    };
    let found = all();
    assert_eq!(found.len(), 24);
    near(&found);
    devices.gpus[0].lose();
    near(&all());
    devices.gpus[1].lose();
    let found = all();
    assert!(found.chunks(views.len()).all(|views| views == expected), "the CPU's own bits");
    // A scene loaded after the loss also goes to the CPU.
    assert!(matches!(devices.gpus[0].load(&scene), Err(RasterError::Device { .. })));
    assert_eq!(weights(devices.load(&scene).unwrap().as_ref(), &views[0], &regions), expected[0]);
}

#[test]
fn choices() {
    for (text, choice) in [
        ("auto", DeviceChoice::Auto),
        ("gpu", DeviceChoice::Gpu),
        ("cpu", DeviceChoice::Cpu),
        ("3", DeviceChoice::Adapters(vec![3])),
        ("1,0", DeviceChoice::Adapters(vec![1, 0])),
    ] {
        assert_eq!(choice.to_string(), text);
        assert_eq!(text.parse(), Ok(choice));
    }
    for wrong in ["fast", "", "0,,1", "1,1", "-1"] {
        assert!(wrong.parse::<DeviceChoice>().unwrap_err().contains(&format!("{wrong:?}")));
    }
    let open = |choice| Devices::open(&choice, GpuOptions::default());
    assert!(open(DeviceChoice::Cpu).unwrap().gpus.is_empty());
    let error = open(DeviceChoice::Adapters(vec![999, 0])).err().unwrap();
    assert!(matches!(error, DeviceError::NoSuchAdapter { number: 999, .. }), "{error}");
    // Software GPUs are slower than the CPU itself.
    let auto = open(DeviceChoice::Auto).unwrap();
    assert!(auto.gpus.iter().all(|gpu| !gpu.report().is_software()));
    match open(DeviceChoice::Gpu) {
        Ok(devices) => {
            assert!(!devices.gpus.is_empty());
            assert_eq!(open(DeviceChoice::Adapters(vec![0])).unwrap().gpus.len(), 1);
        }
        Err(error) => assert!(matches!(error, DeviceError::NoAdapter) && !gpu_is_expected(), "{error}"),
    }
}
