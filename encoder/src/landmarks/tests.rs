use glam::DVec3;
use slag_common::pinhole;
use slag_test_support::{CountingAllocator, memory_of};

use super::*;

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Cameras in a row see all points of a wall: the lists take no more than is reserved.
#[test]
fn lists_of_landmarks_are_reserved() {
    let (n_views, n_gaussians) = (30, 100_000);
    let intrinsics = pinhole([1000, 800], 500.0);
    let view = |view: u16| {
        let camera_from_world = DAffine3::from_translation(DVec3::new(f64::from(view) * -0.02, 0.0, 0.0));
        let observation = |at: u32| {
            let (x, y) = (f64::from(at % 40) * 0.04 - 0.8, f64::from(at / 40) * 0.04 - 0.6);
            let point_in_world = DVec3::new(x, y, 1.0);
            let seen = camera_from_world.transform_point3(point_in_world);
            let at_px = 500.0 * seen.truncate() + DVec2::new(500.0, 400.0);
            Observation { at: at_px, point_in_world, code: u128::from(at) << 7 }
        };
        let observations = (0..MAX_FEATURES as u32).map(observation).collect();
        MappingView { view, intrinsics, camera_from_world, observations }
    };
    let make = || {
        let views: Vec<MappingView> = (0..n_views).map(view).collect();
        landmarks(&views, n_gaussians).len()
    };
    let (n, taken) = memory_of(make);
    assert!(n >= MAX_FEATURES, "{n}");
    let mut memory = MemoryPlan::new(0);
    reserve(&mut memory, usize::from(n_views), &[], n_gaussians);
    let reserved = memory.rest(0).expect_err("nothing fits").needed_bytes;
    let holds = taken.peak_bytes as u64 <= reserved && reserved < 3 * taken.peak_bytes as u64;
    assert!(holds, "{taken:?} {reserved}");
}
