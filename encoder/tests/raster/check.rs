//! The scene check on real drone photos: a trained scene, its 18 photos and their COLMAP poses.

use super::*;
use std::sync::atomic::{AtomicUsize, Ordering};

use slag_common::photo::PhotoError;
use slag_encoder::check::{CheckError, check, suspicions};
use slag_encoder::ingest::IngestError;
use slag_encoder::progress::Silent;
use slag_encoder::raster::pinhole;
use slag_lab::generate::Scene;
use slag_lab::generate::grammar::SceneKind;

/// PSNR over all photos, as reported by the trainer (gsplat) at 1000 x 562.
const TRAINER_PSNR_DB: f64 = 25.02;

fn read_scene(root: &Path) -> Gaussians {
    let scene = read_splat(root);
    assert_eq!(scene.len(), 149_097);
    scene
}

/// Reads every `step`-th view of the model, by name.
fn read_views(root: &Path, step: usize) -> Vec<CheckView> {
    let views = poses::read(root, None).unwrap().views;
    assert_eq!(views.len(), 18);
    views.iter().step_by(step).map(photo).collect()
}

fn run(scene: &Gaussians, views: &[CheckView], options: &CheckOptions) -> CheckReport {
    let report = check(scene, views.iter().cloned().map(Ok), &CpuRasterizer, options).unwrap();
    println!("mean {:.2} dB, {:?}", report.mean_psnr_db, report.diagnosis.as_ref().map(|d| &d.advice));
    report
}

#[needs_shared]
fn a_scene_that_fits_its_photos_passes() {
    let root = shared("scenes/brighton");
    let scene = read_scene(&root);
    let pictures_dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("check");
    let options =
        CheckOptions { width_px: 1000, pictures_dir: Some(pictures_dir.clone()), ..CheckOptions::default() };
    let report = run(&scene, &read_views(&root, 5), &options);
    assert_eq!(report.diagnosis, None);
    assert_eq!((report.views.len(), report.unusable_gaussians), (4, 0));
    assert!((report.mean_psnr_db - TRAINER_PSNR_DB).abs() < 1.5, "{}", report.mean_psnr_db);
    assert!(report.mean_covered_share > 0.9);
    let picture = image::open(pictures_dir.join("0001_DJI_0023.jpg.png")).unwrap();
    assert_eq!((picture.width(), picture.height()), (2000, 562));
}

/// Trainers mask skies: where the splat shows nothing, nothing is compared with black.
#[test]
fn a_splat_without_a_sky_fits_its_photos() {
    let folder = tempfile::tempdir().unwrap();
    let mut yard = Scene::new(&[SceneKind::Yard], 111_004, 4);
    let files = yard.write(folder.path(), &Silent).unwrap();
    let views = poses::read(&files.views, None).unwrap().views;
    let mut views: Vec<CheckView> = views.iter().map(|view| shrunk(photo(view), 160)).collect();
    let report = run(&yard.gaussians, &views, &CheckOptions::default());
    assert!(report.diagnosis.is_none() && report.mean_covered_share < 0.9, "{}", report.mean_covered_share);
    for view in &mut views {
        view.view.camera_from_world *= DAffine3::from_rotation_z(1.0);
    }
    assert!(run(&yard.gaussians, &views, &CheckOptions::default()).diagnosis.is_some());
}

/// Focal lengths of another camera or size: drawings are still somewhat like their photos.
#[needs_shared]
fn focal_lengths_near_the_right_one_are_found() {
    let root = shared("scenes/house_a");
    let scene = read_splat(&root);
    let views = poses::read(&root.join("transforms.json"), None).unwrap().views;
    let views: Vec<CheckView> = views.iter().step_by(19).map(|view| shrunk(photo(view), 240)).collect();
    for factor in [0.9, 1.05, 1.1] {
        let mut planted = views.clone();
        for view in &mut planted {
            view.view.intrinsics.focal_x_px *= factor;
            view.view.intrinsics.focal_y_px *= factor;
        }
        let right_px = views[0].view.intrinsics.focal_x_px;
        let diagnosis = run(&scene, &planted, &CheckOptions::default()).diagnosis.expect("a diagnosis");
        let found = diagnosis.mistake;
        let is_it = matches!(found, Some(Mistake::FocalScale(f)) if (f * factor - 1.0).abs() < 0.015);
        assert!(is_it, "{factor}: {found:?}");
        let said = diagnosis.advice.join("\n");
        let words = if factor > 1.0 { "times too long" } else { "times too short" };
        assert!(
            said.contains(words) && said.contains(&format!("{:.1} px; expected about", right_px * factor)),
            "{said}"
        );
    }
}

/// Plants each mistake as the inverse of its correction, written independently.
#[needs_shared]
fn planted_mistakes_are_diagnosed() {
    let root = shared("scenes/brighton");
    let scene = read_scene(&root);
    let views: Vec<CheckView> = read_views(&root, 9).into_iter().map(|photo| shrunk(photo, 160)).collect();
    let options = CheckOptions::default();
    let diagnosed = |scene: &Gaussians, plant: &dyn Fn(&mut RasterView)| {
        let mut views = views.clone();
        views.iter_mut().for_each(|view| plant(&mut view.view));
        let diagnosis = run(scene, &views, &options).diagnosis.expect("a diagnosis");
        assert!(!diagnosis.advice.is_empty());
        diagnosis.mistake
    };

    let negate_yz = |view: &mut RasterView| {
        let pose = &mut view.camera_from_world;
        for axis in [&mut pose.matrix3.x_axis, &mut pose.matrix3.y_axis, &mut pose.matrix3.z_axis] {
            (axis.y, axis.z) = (-axis.y, -axis.z);
        }
        (pose.translation.y, pose.translation.z) = (-pose.translation.y, -pose.translation.z);
    };
    assert_eq!(diagnosed(&scene, &negate_yz), Some(Mistake::OpenGlAxes));

    let invert = |view: &mut RasterView| {
        let pose = &mut view.camera_from_world;
        pose.matrix3 = pose.matrix3.transpose();
        pose.translation = -(pose.matrix3 * pose.translation);
    };
    assert_eq!(diagnosed(&scene, &invert), Some(Mistake::WorldFromCamera));
    let nerf = |view: &mut RasterView| {
        negate_yz(view);
        invert(view);
    };
    assert_eq!(diagnosed(&scene, &nerf), Some(Mistake::WorldFromOpenGlCamera));

    let camera_from_world = |view: &mut RasterView| {
        invert(view);
        negate_yz(view);
    };
    assert_eq!(diagnosed(&scene, &camera_from_world), Some(Mistake::CameraFromWorld));
    let opengl = |view: &mut RasterView| {
        negate_yz(view);
        camera_from_world(view);
    };
    assert_eq!(diagnosed(&scene, &opengl), Some(Mistake::OpenGlCameraFromWorld));

    let mut large = scene.clone();
    large.means_in_world.iter_mut().for_each(|mean| *mean *= 10.0);
    large.scales.iter_mut().for_each(|scales| *scales = scales.map(|s| s * 10.0));
    // Refined by its drawings.
    let found = diagnosed(&large, &|_| {});
    let is_tenfold = |found| matches!(found, Some(Mistake::SceneScale(f)) if f64::abs(f - 10.0) < 0.05);
    assert!(is_tenfold(found), "{found:?}");
    // A black photo looks exactly like a drawing that sees nothing.
    let mut capped = [views.clone(), views[..1].to_vec()].concat();
    capped[2].image.fill(0);
    let found = run(&large, &capped, &options).diagnosis.and_then(|diagnosis| diagnosis.mistake);
    assert!(is_tenfold(found), "{found:?}");

    let double_focal = |view: &mut RasterView| {
        view.intrinsics.focal_x_px *= 2.0;
        view.intrinsics.focal_y_px *= 2.0;
    };
    assert_eq!(diagnosed(&scene, &double_focal), Some(Mistake::FocalScale(0.5)));

    // (x, y, z) of a z-up world is (x, z, -y) of a y-up one: turned by three quarters.
    let y_up = |view: &mut RasterView| {
        let m = &mut view.camera_from_world.matrix3;
        (m.y_axis, m.z_axis) = (m.z_axis, -m.y_axis);
    };
    assert_eq!(diagnosed(&scene, &y_up), Some(Mistake::WorldAxes([1, -3, 2])));

    let upside_down = |view: &mut RasterView| {
        view.camera_from_world = DAffine3::from_rotation_z(std::f64::consts::PI) * view.camera_from_world;
    };
    assert_eq!(diagnosed(&scene, &upside_down), Some(Mistake::UpsideDown));

    let mut mirrored = scene.clone();
    for (mean, rotation) in mirrored.means_in_world.iter_mut().zip(&mut mirrored.rotations_wxyz) {
        mean.x = -mean.x;
        let [w, x, y, z] = *rotation;
        *rotation = [w, x, -y, -z];
    }
    assert_eq!(diagnosed(&mirrored, &|_| {}), Some(Mistake::Mirrored(0)));

    // Both still look like their photos.
    let mut turned = scene.clone();
    turned.rotations_wxyz.iter_mut().for_each(|wxyz| *wxyz = [wxyz[1], wxyz[2], wxyz[3], wxyz[0]]);
    assert_eq!(diagnosed(&turned, &|_| {}), Some(Mistake::RotationsXyzw));
    turned.rotations_wxyz = scene.rotations_wxyz.iter().map(|[w, x, y, z]| [*w, -x, -y, -z]).collect();
    assert_eq!(diagnosed(&turned, &|_| {}), Some(Mistake::RotationsInverted));

    // Wrong harmonics are no turned Gaussians.
    let tinted = Gaussians { sh_degree: 1, sh_rest: vec![1.0; 9 * scene.len()], ..scene.clone() };
    assert_eq!(diagnosed(&tinted, &|_| {}), Some(Mistake::Harmonics));

    let other_way = |view: &mut RasterView| {
        let pose = &mut view.camera_from_world;
        pose.translation += DVec3::new(0.0, 0.0, -500.0);
    };
    assert_eq!(diagnosed(&scene, &other_way), None);
}

#[test]
fn contradictions_are_errors() {
    let error = |views: &[CheckView]| {
        let views = views.iter().cloned().map(Ok);
        check(&Gaussians::default(), views, &CpuRasterizer, &CheckOptions::default()).unwrap_err()
    };
    assert!(matches!(error(&[]), CheckError::NoViews));
    let mut view = tiny_view();
    view.image = image::RgbImage::new(4, 3);
    assert!(matches!(error(&[view]), CheckError::ImageSize { image_px: [4, 3], camera_px: [4, 4], .. }));
}

fn tiny_view() -> CheckView {
    CheckView {
        name: "a".to_owned(),
        image: image::RgbImage::new(4, 4),
        valid: None,
        view: RasterView { camera_from_world: DAffine3::IDENTITY, intrinsics: pinhole([4, 4], 4.0) },
    }
}

/// Faults visible in the data alone: each planted by hand, with the correction that the drawings confirm.
#[needs_shared]
fn faults_of_the_data_are_suspected_and_confirmed() {
    let root = shared("scenes/brighton");
    let scene = read_scene(&root);
    let photos: Vec<CheckView> = read_views(&root, 9).into_iter().map(|photo| shrunk(photo, 160)).collect();
    let views = |photos: &[CheckView]| -> Vec<View> {
        let view = |photo: &CheckView| View {
            name: photo.name.clone(),
            image_path: photo.name.clone().into(),
            intrinsics: photo.view.intrinsics,
            camera_from_world: photo.view.camera_from_world,
        };
        photos.iter().map(view).collect()
    };
    assert_eq!(suspicions(&scene, &views(&photos)), []);
    let said = |opacity: f32, n: usize| -> String {
        let mut damaged = scene.clone();
        damaged.opacities[..n].fill(opacity);
        suspicions(&damaged, &views(&photos)).into_iter().map(|s| s.text).collect()
    };
    assert!(said(1e-3, scene.len()).contains("all Gaussians are transparent"));
    assert!(said(f32::NAN, scene.len() / 2 + 1).contains("cannot be drawn; export the splat again"));
    assert_eq!(said(f32::NAN, 3), format!("3 of {} Gaussians cannot be drawn and are left out", scene.len()));
    assert!(said(1.0, scene.len()).contains("percents or bytes"));
    assert_eq!(said(0.99, scene.len()), "");
    let mut pale = scene.clone();
    pale.sh_dc.iter_mut().flatten().for_each(|c| *c = (0.5 + 0.282_094_8 * *c).clamp(0.0, 1.0));
    assert!(suspicions(&pale, &views(&photos))[0].text.contains("colours of 0 to 1"));
    let all: Vec<u32> = (0..scene.len() as u32).collect();
    let twice = suspicions(&scene.select(&[all.clone(), all].concat()), &views(&photos));
    assert!(twice.len() == 1 && twice[0].text.contains("stand where another one alike stands"), "{twice:?}");
    // Tiny Gaussians do not mean large coordinates.
    let mut tiny = scene.clone();
    tiny.scales.iter_mut().flatten().for_each(|s| *s = 1e-9);
    assert_eq!(suspicions(&tiny, &views(&photos)), []);
    // Two photos under each other's poses: the others fit.
    let mut swapped = photos.clone();
    (swapped[0].view, swapped[1].view) = (photos[1].view, photos[0].view);
    let others: Vec<CheckView> = photos.iter().cycle().take(30).cloned().collect();
    let report = run(&scene, &[swapped[..2].to_vec(), others.clone()].concat(), &CheckOptions::default());
    assert!(report.diagnosis.is_none() && report.suspicions.len() == 1, "{report}");
    assert!(report.suspicions[0].starts_with("2 of 32 views look less like"), "{report}");
    // A photo under a lens cap is no evidence against them.
    let mut capped = others;
    capped[0].image.fill(0);
    let report = run(&scene, &capped, &CheckOptions::default());
    let holds = report.diagnosis.is_none() && report.suspicions[0].starts_with("1 of 30 views look less");
    assert!(holds, "{report}");
    let diagnosed = |scene: &Gaussians, photos: &[CheckView]| {
        let suspicions = suspicions(scene, &views(photos));
        let n_mistakes = suspicions.iter().filter(|suspicion| suspicion.mistake.is_some()).count();
        assert_eq!(n_mistakes, 1, "{suspicions:?}");
        let options = CheckOptions { suspicions, ..CheckOptions::default() };
        run(scene, photos, &options).diagnosis.and_then(|diagnosis| diagnosis.mistake)
    };
    for (scales, opacities) in [(true, false), (false, true), (true, true)] {
        let mut activated = scene.clone();
        if scales {
            activated.scales.iter_mut().flatten().for_each(|s| *s = s.exp());
        }
        if opacities {
            activated.opacities.iter_mut().for_each(|o| *o = 1.0 / (1.0 + (-*o).exp()));
        }
        assert_eq!(diagnosed(&activated, &photos), Some(Mistake::Activated { scales, opacities }));
    }
    // The flat Gaussians of 2DGS have no third scale.
    let mut flat = scene.clone();
    flat.scales.iter_mut().for_each(|s| *s = [s[0].exp(), s[1].exp(), 0.0]);
    let suspected = Mistake::Activated { scales: true, opacities: false };
    assert!(suspicions(&flat, &views(&photos)).iter().any(|found| found.mistake == Some(suspected)));
    // Logarithms read as scales are negative.
    let mut points = scene.clone();
    points.deactivate(true, false);
    assert!(suspicions(&points, &views(&photos))[0].text.ends_with("leave out --activated if it is given"));
    // Constants, such as logarithms and logits of 0, leave nothing once undone.
    let mut constant = scene.clone();
    constant.scales.fill([1.0; 3]);
    constant.opacities.fill(0.5);
    let found = suspicions(&constant, &views(&photos));
    assert!(found.iter().all(|found| found.mistake.is_none()), "{found:?}");
    let with_camera = |edit: &dyn Fn(&mut Intrinsics)| {
        let mut photos = photos.clone();
        photos.iter_mut().for_each(|photo| edit(&mut photo.view.intrinsics));
        diagnosed(&scene, &photos)
    };
    let larger = with_camera(&|camera| {
        camera.focal_x_px *= 1.5;
        camera.focal_y_px *= 1.5;
        camera.centre_x_px *= 1.5;
        camera.centre_y_px *= 1.5;
    });
    assert!(matches!(larger, Some(Mistake::IntrinsicsOfSize(f)) if (f - 1.5).abs() < 0.02), "{larger:?}");
    let centre = with_camera(&|camera| {
        camera.centre_x_px *= 2.0;
        camera.centre_y_px *= 2.0;
    });
    assert!(matches!(centre, Some(Mistake::CentreOfSize(f)) if (f - 2.0).abs() < 0.02), "{centre:?}");
    let at_zero = with_camera(&|camera| (camera.centre_x_px, camera.centre_y_px) = (0.0, 0.0));
    assert_eq!(at_zero, Some(Mistake::CentreAtZero));
    assert_eq!(with_camera(&|camera| camera.centre_x_px = 0.0), Some(Mistake::CentreAtZero));
    // An offset of UTM's size in f64 is exact once subtracted.
    let mut shifted = scene.clone();
    shifted.means_in_world.iter_mut().for_each(|mean| *mean += DVec3::new(500_000.0, 5_400_000.0, 0.0));
    let found = diagnosed(&shifted, &photos);
    assert!(matches!(found, Some(Mistake::Frame(f)) if f.cause == FrameCause::Shifted), "{found:?}");
    // In f32 it destroys the scene, which only the data show.
    shifted.means_in_world.iter_mut().for_each(|mean| *mean = mean.as_vec3().as_dvec3());
    let texts: Vec<String> = suspicions(&shifted, &views(&photos)).into_iter().map(|s| s.text).collect();
    assert!(texts.len() == 2 && texts[0].contains("UTM"), "{texts:?}");
}

/// Unreadable photos are omitted and named; transparent parts do not count.
#[test]
fn unreadable_photos_are_left_out_and_hidden_pixels_do_not_count() {
    let unreadable = || Err(IngestError::Photo { path: "b.jpg".into(), fault: PhotoError::Cut });
    let views = [Ok(tiny_view()), unreadable(), Ok(tiny_view())];
    let report = check(&Gaussians::default(), views, &CpuRasterizer, &CheckOptions::default()).unwrap();
    assert_eq!((report.views.len(), report.unreadable.len()), (2, 1));
    assert!(report.to_string().contains("b.jpg"));
    let none = check(&Gaussians::default(), [unreadable()], &CpuRasterizer, &CheckOptions::default());
    assert!(matches!(none, Err(CheckError::NoPhotos { n_views: 1, .. })));

    // All black, except for one white pixel, hidden or not.
    let mut view = tiny_view();
    view.image.put_pixel(1, 2, image::Rgb([255; 3]));
    let psnr_db = |view: CheckView| {
        check(&Gaussians::default(), [Ok(view)], &CpuRasterizer, &CheckOptions::default())
            .unwrap()
            .mean_psnr_db
    };
    assert!((psnr_db(view.clone()) - 10.0 * 16.0_f64.log10()).abs() < 1e-9);
    let hidden = |x, y| image::Luma([if (x, y) == (1, 2) { 0 } else { 255 }]);
    view.valid = Some(image::GrayImage::from_fn(4, 4, hidden));
    assert!(psnr_db(view) > 99.0);
}

/// Counts how often a scene is loaded and drawn.
#[derive(Default)]
struct Counting {
    loads: AtomicUsize,
    draws: AtomicUsize,
    /// Pairs counted by each drawing after the first two.
    pairs_of_trials: usize,
}

struct CountingScene<'s>(Box<dyn LoadedScene + 's>, &'s Counting);

impl LoadedScene for CountingScene<'_> {
    fn weights(&self, view: &RasterView, regions: &RegionMap) -> Result<ViewWeights, RasterError> {
        self.0.weights(view, regions)
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        let n_drawn = self.1.draws.fetch_add(1, Ordering::Relaxed);
        let mut drawing = self.0.draw(view, background)?;
        drawing.counters.pairs = if n_drawn < 2 { 0 } else { self.1.pairs_of_trials };
        Ok(drawing)
    }
}

struct Counted(&'static Counting);

impl Rasterizer for Counted {
    fn identity(&self) -> String {
        CpuRasterizer.identity()
    }

    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        self.0.loads.fetch_add(1, Ordering::Relaxed);
        Ok(Box::new(CountingScene(CpuRasterizer.load(scene)?, self.0)))
    }
}

/// Each photo is loaded after the previous view was drawn, so one is in memory at a time. The scene is loaded
/// once, and once more per correction of the splat itself.
#[test]
fn photos_are_loaded_one_at_a_time_and_the_scene_once() {
    let counting: &'static Counting = Box::leak(Box::default());
    let views = (0..9).map(|n_drawn| {
        assert_eq!(counting.draws.load(Ordering::Relaxed), n_drawn, "drawings before photo {n_drawn}");
        Ok(tiny_view())
    });
    let report = check(&Gaussians::default(), views, &Counted(counting), &CheckOptions::default()).unwrap();
    assert_eq!(report.views.len(), 9);
    // Two views per correction, of 190, since neither looks like its photo.
    let n_draws = counting.draws.load(Ordering::Relaxed);
    assert!(report.diagnosis.is_some() && (300..450).contains(&n_draws), "{n_draws}");
    assert_eq!(counting.loads.load(Ordering::Relaxed), 1 + 5, "mirrored along three axes, rotations turned");
}

/// A correction that only moves Gaussians out of sight gains much, but is not accepted.
#[test]
fn black_is_no_explanation() {
    let mut view = tiny_view();
    view.image.put_pixel(1, 2, image::Rgb([255; 3]));
    let before_the_camera = Gaussians {
        opacities: vec![0.99],
        sh_dc: vec![[1.77; 3]],
        ..Gaussians::balls(vec![DVec3::new(0.0, 0.0, 2.0)], 5.0)
    };
    let report = check(&before_the_camera, [Ok(view)], &CpuRasterizer, &CheckOptions::default()).unwrap();
    let diagnosis = report.diagnosis.expect("white is not black");
    assert!(diagnosis.tried[0].psnr_db > diagnosis.given_psnr_db + 6.0, "{diagnosis:?}");
    assert_eq!(diagnosis.mistake, None);
}

/// Corrections that draw a heap of Gaussians everywhere are tried up to 200 million pairs.
#[test]
fn a_heap_of_gaussians_ends_the_search() {
    let counting = Counting { pairs_of_trials: 50_000_000, ..Counting::default() };
    let counting: &'static Counting = Box::leak(Box::new(counting));
    let options = CheckOptions::default();
    let report = check(&Gaussians::default(), [Ok(tiny_view())], &Counted(counting), &options).unwrap();
    assert_eq!(counting.draws.load(Ordering::Relaxed), 1 + 1 + 4);
    assert!(report.to_string().contains("the search ended early"), "{report}");
}
