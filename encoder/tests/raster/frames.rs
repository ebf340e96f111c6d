//! Splats in another frame than their poses: the labelled house, moved.

use super::*;
use slag_common::Similarity;
use slag_encoder::check::{FrameCandidate, align, check, nerfstudio_defaults};

use slag_test_support::nightly;

struct House {
    splat: Gaussians,
    views: Vec<View>,
    photos: Vec<CheckView>,
}

impl House {
    fn read() -> Self {
        let root = shared("scenes/house_a");
        let views = poses::read(&root, None).unwrap().views;
        let photos = views.iter().step_by(views.len() / 3).map(|view| shrunk(photo(view), 160)).collect();
        Self { splat: read_splat(&root), views, photos }
    }

    fn check(&self, moved: &Similarity, frames: Vec<FrameCandidate>) -> CheckReport {
        let mut splat = self.splat.clone();
        moved.transform_gaussians(&mut splat);
        let photos: Vec<_> = self.photos.iter().cloned().map(Ok).collect();
        let options = CheckOptions { width_px: 160, diagnosis_views: 3, frames, ..CheckOptions::default() };
        let report = check(&splat, photos, &CpuRasterizer, &options).unwrap();
        println!("{report}");
        report
    }

    /// Largest distance between camera positions under two similarities, in units of the first.
    fn off(&self, a: &Similarity, b: &Similarity) -> f64 {
        let off = |view: &View| {
            let centre = view.position_in_world();
            (a.transform_point(centre) - b.transform_point(centre)).length()
        };
        self.views.iter().map(off).fold(0.0, f64::max) / a.scale
    }
}

#[nightly("checks the house eight times")]
#[needs_shared]
fn moved_splats_are_brought_back() {
    let house = House::read();
    assert_eq!(house.check(&Similarity::IDENTITY, Vec::new()).diagnosis, None);

    // nerfstudio's training frame, by its formulas from all poses.
    let defaults = nerfstudio_defaults(&house.views);
    let trained = defaults[0].splat_from_poses;
    let found = house.check(&trained, defaults.clone()).diagnosis.expect("a diagnosis");
    assert!(matches!(found.mistake, Some(Mistake::Frame(f)) if f.cause == FrameCause::NerfstudioDefaults));
    let off = house.off(&found.splat_from_poses.expect("a similarity"), &trained);
    assert!(off < 1e-3, "{off} world units");
    // Trained on some photos only: the frame is slightly off, and the drawings correct it.
    let some: Vec<View> = house.views.iter().step_by(3).cloned().collect();
    let trained = nerfstudio_defaults(&some)[0].splat_from_poses;
    let before = house.off(&defaults[0].splat_from_poses, &trained);
    let found = house.check(&trained, defaults).diagnosis.expect("a diagnosis");
    let off = house.off(&found.splat_from_poses.expect("a similarity"), &trained);
    println!("{before} -> {off} world units");
    assert!(off < 0.7 * before, "{before} -> {off} world units");

    // Any similarity, where other poses are in the splat's frame.
    let stated = Similarity {
        scale: 0.31,
        rotation: DQuat::from_axis_angle(DVec3::new(0.2, 1.0, -0.7).normalize(), 1.9),
        translation: DVec3::new(40.0, -7.0, 3.0),
    };
    let other: Vec<View> = (house.views.iter())
        .map(|view| View {
            camera_from_world: stated.camera_from_target(view.camera_from_world),
            ..view.clone()
        })
        .collect();
    let splat_from_poses = align(&house.views, &other).unwrap().similarity;
    let candidate = FrameCandidate { cause: FrameCause::OtherPoses, splat_from_poses };
    let found = house.check(&stated, vec![candidate]).diagnosis.expect("a diagnosis");
    assert_eq!(found.mistake, Some(Mistake::Frame(candidate)));
    assert!(house.off(&stated, &splat_from_poses) < 1e-9);
    assert_eq!(house.check(&stated, Vec::new()).diagnosis.expect("a diagnosis").splat_from_poses, None);
}

#[nightly("checks a scene many times")]
#[needs_shared]
fn other_axes_and_scales_are_named() {
    let house = House::read();
    // COLMAP's world against nerfstudio's.
    let swap = DMat3::from_cols(DVec3::Y, DVec3::X, -DVec3::Z);
    let swap = Similarity { rotation: DQuat::from_mat3(&swap), ..Similarity::IDENTITY };
    let report = house.check(&swap, Vec::new());
    assert!(report.to_string().contains("nerfstudio's world against COLMAP's"));
    let found = report.diagnosis.expect("a diagnosis");
    assert_eq!(found.mistake, Some(Mistake::WorldAxes([2, 1, -3])));
    assert!(house.off(&found.splat_from_poses.expect("a similarity"), &swap) < 1e-9);
    // A scale that is not a power of ten.
    let scaled = Similarity { scale: 3.7, ..Similarity::IDENTITY };
    let found = house.check(&scaled, Vec::new()).diagnosis.expect("a diagnosis");
    let off = house.off(&found.splat_from_poses.expect("a similarity"), &scaled);
    assert!(matches!(found.mistake, Some(Mistake::SceneScale(_))) && off < 0.02, "{off} world units");
}
