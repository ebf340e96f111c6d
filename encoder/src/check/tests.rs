//! Tests of similarities from camera centres, of nerfstudio's frames, and of what is suspected without a drawing.

use std::path::PathBuf;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use slag_common::{Similarity, View};

use super::mistake::AlignError;
use super::view::CheckView;
use super::{
    FrameCause, Mistake, Suspicion, ViewCheck, align, mark_far_below, means_of, nerfstudio_defaults,
    suspicions,
};
use crate::raster::{Drawing, RasterView, pinhole};

fn view(name: &str, world_from_camera: DAffine3) -> View {
    View {
        name: name.to_owned(),
        image_path: PathBuf::from(name),
        intrinsics: pinhole([64, 48], 50.0),
        camera_from_world: world_from_camera.inverse(),
    }
}

fn views(centres: &[[f64; 3]]) -> Vec<View> {
    let at = |(i, centre): (usize, &[f64; 3])| {
        let turn = DQuat::from_rotation_y(0.3 * i as f64);
        view(&format!("{i:03}.jpg"), DAffine3::from_rotation_translation(turn, DVec3::from_array(*centre)))
    };
    centres.iter().enumerate().map(at).collect()
}

const FROM: [[f64; 3]; 6] = [
    [0.3, -1.2, 2.5],
    [4.1, 0.7, -0.4],
    [-2.2, 3.3, 1.8],
    [1.9, -2.6, -3.1],
    [0.0, 1.5, 0.9],
    [-3.7, -0.8, -1.4],
];
const TO: [[f64; 3]; 6] = [
    [12.1, -3.4, 7.7],
    [9.0, 4.6, -1.2],
    [19.3, -2.9, 0.4],
    [2.2, 1.1, 12.5],
    [14.0, 0.2, 3.3],
    [8.8, -11.7, 8.1],
];

/// Oracle: Umeyama's method by singular values in NumPy, float64, recorded. Jacobi's rotations stop at off-diagonals
/// of 1e-9. The points of the second case are mirrored: the best orthogonal matrix of one is a reflection, never taken.
#[test]
fn similarities_are_umeyamas() {
    let recorded = [
        (
            1.0,
            1.967_024_567_261_443_5,
            [
                [-0.4098612285704881, 0.9080215372606628, 0.08666407090295482],
                [0.8549927540877511, 0.4155447412321632, -0.31033845796442494],
                [-0.317806802589455, -0.05309854899219634, -0.9466675130809076],
            ],
            [10.677308521847024, -2.220871955478967, 5.283781754538377],
            0.5405787789704621,
        ),
        (
            -1.0,
            2.137_209_527_207_881_3,
            [
                [-0.2876807422874066, 0.26232715172858256, 0.9210994821315098],
                [0.9465760167148813, -0.0684507009699394, 0.3151322676542548],
                [0.1457176554064601, 0.9625481634716743, -0.22862064189427675],
            ],
            [10.758462592256896, -2.1632665794428148, -5.43823983253438],
            0.40553110230539163,
        ),
    ];
    for (flip, scale, rows, translation, residual) in recorded {
        let to = TO.map(|[x, y, z]| [x, y, flip * z]);
        let found = align(&views(&FROM), &views(&to)).unwrap();
        let rotation = DMat3::from_quat(found.similarity.rotation);
        assert!((found.similarity.scale - scale).abs() < 1e-9, "{}", found.similarity.scale);
        for (i, row) in rows.iter().enumerate() {
            assert!((rotation.row(i) - DVec3::from_array(*row)).length() < 1e-9, "{rotation}");
        }
        let translation_error = found.similarity.translation - DVec3::from_array(translation);
        assert!(translation_error.length() < 1e-8, "{translation_error}");
        assert!((found.residual - residual).abs() < 1e-9, "{}", found.residual);
        assert_eq!(found.n_cameras, 6);
    }
}

#[test]
fn cameras_are_paired_by_name_and_must_determine_a_rotation() {
    let stated = Similarity {
        scale: 0.2,
        rotation: DQuat::from_axis_angle(DVec3::new(1.0, -1.0, 0.5).normalize(), 2.9),
        translation: DVec3::new(7.0, 8.0, -9.0),
    };
    let from = views(&FROM);
    let mut to = views(&FROM.map(|p| stated.transform_point(DVec3::from_array(p)).to_array()));
    // Other folders, extensions, order, and a view that only one set has.
    to.iter_mut().for_each(|view| view.name = format!("left/{}", view.name.replace("jpg", "png")));
    to.reverse();
    to.push(view("left/extra.png", DAffine3::IDENTITY));
    let found = align(&from, &to).unwrap();
    assert_eq!(found.n_cameras, 6);
    assert!(found.residual < 1e-9, "{}", found.residual);
    assert!((found.similarity.scale - 0.2).abs() < 1e-9);
    assert!(found.similarity.rotation.angle_between(stated.rotation) < 1e-7);
    assert!((found.similarity.translation - stated.translation).length() < 1e-8);

    assert_eq!(align(&from[..2], &to), Err(AlignError::Few { n: 2 }));
    let line = [[0.0; 3], [1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [-3.0, -6.0, -9.0]];
    assert_eq!(align(&views(&line), &from), Err(AlignError::Line));
    assert_eq!(align(&from, &views(&[[1.0; 3]; 6])), Err(AlignError::Line));
    // Two views with one file name are ambiguous.
    let twice: Vec<View> =
        to.iter().flat_map(|v| [v.clone(), View { name: format!("b/{}", v.name), ..v.clone() }]).collect();
    assert_eq!(align(&from, &twice), Err(AlignError::Few { n: 0 }));
}

/// Restates `auto_orient_and_center_poses` (method `up`, centre `poses`) in matrices, with Rodrigues' formula, and
/// the scaling of nerfstudio's dataparser.
#[test]
fn nerfstudios_defaults_are_its_formulas() {
    let views = views(&FROM);
    let swap = DMat3::from_cols(DVec3::Y, DVec3::X, -DVec3::Z);
    let found = nerfstudio_defaults(&views);
    assert_eq!(found.len(), 4);
    for (candidate, (axes, orients)) in
        found.iter().zip([(DMat3::IDENTITY, true), (DMat3::IDENTITY, false), (swap, true), (swap, false)])
    {
        assert_eq!(candidate.cause, FrameCause::NerfstudioDefaults);
        // Camera to world with OpenGL axes.
        let poses: Vec<(DMat3, DVec3)> = views
            .iter()
            .map(|view| {
                let pose = view.camera_from_world.inverse();
                let opengl = pose.matrix3 * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
                (axes * opengl, axes * pose.translation)
            })
            .collect();
        let mean = poses.iter().map(|p| p.1).sum::<DVec3>() / poses.len() as f64;
        let up = poses.iter().map(|p| p.0.y_axis).sum::<DVec3>().normalize();
        let v = up.cross(DVec3::Z);
        let k = DMat3::from_cols_array(&[0.0, v.z, -v.y, -v.z, 0.0, v.x, v.y, -v.x, 0.0]);
        let rotation = match orients {
            true => DMat3::IDENTITY + k + k * k * ((1.0 - up.z) / v.length_squared()),
            false => DMat3::IDENTITY,
        };
        let centred: Vec<DVec3> = poses.iter().map(|p| rotation * (p.1 - mean)).collect();
        let scale = 1.0 / centred.iter().map(|c| c.abs().max_element()).fold(0.0, f64::max);
        for (centre, expected) in FROM.iter().zip(centred) {
            let image = candidate.splat_from_poses.transform_point(DVec3::from_array(*centre));
            assert!((image - expected * scale).length() < 1e-12, "{image}");
        }
    }
}

/// By hand: two of five photos that are drawn well raise the average above that of plain colours, and half of the
/// photos are no majority. A photo under a lens cap does not count.
#[test]
fn most_views_must_fit() {
    let checked = |psnr_db: f64, flat_psnr_db: f64| ViewCheck {
        name: String::new(),
        psnr_db,
        flat_psnr_db,
        covered_share: 1.0,
        visible_gaussians: 1,
        is_far_below: false,
    };
    let fit = |good: usize, bad: usize, capped: usize| {
        let of = |psnr_db, flat_psnr_db, n| vec![checked(psnr_db, flat_psnr_db); n];
        let means = means_of(&[of(45.0, 12.0, good), of(11.0, 12.0, bad), of(5.0, 99.0, capped)].concat());
        (means.average_fits(), means.fit())
    };
    assert_eq!(fit(2, 3, 0), (true, false));
    assert_eq!(fit(2, 2, 1), (true, false));
    assert_eq!(fit(3, 2, 3), (true, true));
    assert_eq!(fit(0, 5, 0), (false, false));
    // A bare wall drawn well, and a black photo, whose own colour is exact.
    assert!(checked(31.0, 40.0).fits() && !checked(5.0, f64::INFINITY).fits());
    // By hand: good and bad ones with nothing between; an even spread; a wall drawn well; a single outstanding view.
    let far_below = |views: &[(f64, f64)]| {
        let mut all: Vec<ViewCheck> = views.iter().map(|(db, flat_db)| checked(*db, *flat_db)).collect();
        mark_far_below(&mut all);
        all.iter().map(|check| !check.fits()).collect::<Vec<_>>()
    };
    assert_eq!(far_below(&[(31.0, 14.0), (15.9, 13.8), (33.0, 14.0)]), [false, true, false]);
    assert_eq!(far_below(&[(31.0, 14.0), (24.0, 14.0), (18.0, 14.0)]), [false; 3]);
    assert_eq!(far_below(&[(31.0, 14.0), (38.0, 36.0), (24.0, 22.0)]), [false; 3]);
    assert_eq!(far_below(&[36.0, 24.0, 23.0, 23.0, 24.0].map(|db| (db, 14.0))), [false; 5]);
}

/// Advice is that of what the drawings confirmed.
#[test]
fn what_drawings_do_not_confirm_is_no_advice() {
    let suspicion = |mistake| Suspicion { text: "the photos are cut; cut them".into(), mistake };
    let size = Mistake::IntrinsicsOfSize(2.0);
    assert_eq!(suspicion(None).after_drawing(Some(size)).as_deref(), Some("the photos are cut; cut them"));
    for found in [size, Mistake::CentreOfSize(2.0)] {
        assert_eq!(suspicion(Some(size)).after_drawing(Some(found)), None);
    }
    let left = suspicion(Some(size)).after_drawing(None);
    assert_eq!(left.as_deref(), Some("suspected, not confirmed by the drawings: the photos are cut"));
}

/// Ten Gaussians, where the cameras are.
/// Trainers of single things put them on white: so must drawings be, where a splat is translucent as where it is not.
#[test]
fn a_photo_on_white_is_like_its_drawing_on_black() {
    let coverage: Vec<f32> =
        (0..64).map(|pixel| [0.0, 0.0, 0.0, 0.0, 0.6, 0.7, 0.8, 1.0][pixel % 8]).collect();
    let rgb = coverage.iter().flat_map(|share| [0.8, 0.2, 0.1].map(|c| c * share)).collect();
    let on_white =
        |pixel: usize, c: f32| (255.0 * (c * coverage[pixel] + 1.0 - coverage[pixel])).round() as u8;
    let photo = (0..64).flat_map(|pixel| [0.8, 0.2, 0.1].map(|c| on_white(pixel, c))).collect();
    let image = image::RgbImage::from_raw(8, 8, photo).expect("8 x 8");
    let raster_view = RasterView { camera_from_world: DAffine3::IDENTITY, intrinsics: pinhole([8, 8], 8.0) };
    let view = CheckView { name: "a".to_owned(), image, valid: None, view: raster_view };
    let drawing = Drawing {
        width_px: 8,
        height_px: 8,
        rgb,
        depth: vec![1.0; 64],
        coverage,
        counters: Default::default(),
    };
    let db = view.likeness_db(&drawing);
    assert!(db > 45.0, "{db}");
}

fn scene_of(views: &[View]) -> slag_common::Gaussians {
    let scene = slag_common::Gaussians::balls(views.iter().map(View::position_in_world).collect(), 0.1);
    scene.select(&[0, 1, 2, 3, 4, 5, 0, 1, 2, 3])
}

/// Intrinsics of photos of 640 x 480 pixels as people have them wrong, and right.
#[test]
fn intrinsics_of_no_camera_are_suspected() {
    let said = |focal: [f64; 2], centre: [f64; 2]| -> Vec<Suspicion> {
        let intrinsics = slag_common::Intrinsics {
            focal_x_px: focal[0],
            focal_y_px: focal[1],
            centre_x_px: centre[0],
            centre_y_px: centre[1],
            ..pinhole([640, 480], 1.0)
        };
        let views: Vec<View> = views(&FROM).into_iter().map(|view| View { intrinsics, ..view }).collect();
        let scene = scene_of(&views);
        suspicions(&scene, &views)
    };
    let middle = [320.0, 240.0];
    for right in [[557.0; 2], [557.0, 600.0], [100.0; 2], [9000.0; 2]] {
        assert_eq!(said(right, middle), []);
    }
    assert_eq!(said([557.0; 2], [340.0, 225.0]), []);
    let mistake = |focal: [f64; 2], centre: [f64; 2]| {
        let found = said(focal, centre);
        assert_eq!(found.len(), 1, "{focal:?} {centre:?}: {found:?}");
        found[0].mistake
    };
    let shares = |focal_by| Some(Mistake::SharesOfImage { centre_by: [640.0, 480.0], focal_by });
    assert_eq!(mistake([0.87; 2], [0.5, 0.5]), shares([640.0; 2]));
    assert_eq!(mistake([0.87, 1.16], [0.5, 0.5]), shares([640.0, 480.0]));
    assert_eq!(mistake([557.0; 2], [0.5, 0.48]), shares([1.0; 2]));
    assert_eq!(mistake([557.0; 2], [240.0, 320.0]), Some(Mistake::CentreSwapped));
    assert_eq!(mistake([557.0; 2], [0.0, 0.0]), Some(Mistake::CentreAtZero));
    assert_eq!(mistake([557.0; 2], [640.0, 480.0]), Some(Mistake::IntrinsicsOfSize(2.0)));
    for (focal, centre, words) in [
        ([557.0; 2], [-320.0, -240.0], "far from the middle of photos of 640 x 480 px"),
        ([557.0; 2], [600.0, 240.0], "far from the middle"),
        ([557.0, 139.0], middle, "557.00 and 139.00 px, differ"),
        ([26.0; 2], middle, "neither millimetres nor shares"),
        ([20_000.0; 2], middle, "field of view of 1.8 degrees"),
    ] {
        let found = said(focal, centre);
        let [Suspicion { text, mistake: None }] = &found[..] else { panic!("{words}: {found:?}") };
        assert!(text.contains(words), "{text}");
    }
    let found = said([1.7; 2], [0.0; 2]);
    assert!(found.len() == 2 && found[1].text.contains("field of view of 179.4"), "{found:?}");
    // The corrections are those of cameras at any size.
    let camera = slag_common::Intrinsics { centre_x_px: 0.5, centre_y_px: 0.5, ..pinhole([640, 480], 0.87) };
    let small = RasterView { intrinsics: camera.scaled_to(320, 240), camera_from_world: DAffine3::IDENTITY };
    let corrected = shares([640.0; 2]).expect("a mistake").corrected(&small).intrinsics;
    let holds = (corrected.focal_y_px - 0.87 * 320.0).abs() < 1e-9 && corrected.centre_y_px == 120.0;
    assert!(holds, "{corrected:?}");
}

/// Photos whose poses were never found all have the same one; a tripod's pair does not count.
#[test]
fn poses_that_repeat_are_suspected() {
    let mut views = views(&FROM);
    let scene = scene_of(&views);
    views[1].camera_from_world = views[0].camera_from_world;
    assert_eq!(suspicions(&scene, &views), []);
    let n = views.len();
    views.iter_mut().for_each(|view| view.camera_from_world = DAffine3::IDENTITY);
    let (found, words) = (suspicions(&scene, &views), format!("{n} of {n} photos have exactly the pose"));
    assert!(found.iter().any(|suspicion| suspicion.text.contains(&words)), "{found:?}");
}

#[test]
fn a_splat_of_a_few_gaussians_is_suspected() {
    let said = |n: usize| {
        let means = (0..n).map(|i| DVec3::X * i as f64).collect();
        suspicions(&slag_common::Gaussians::balls(means, 0.1), &[])
    };
    assert!(said(1)[0].text.contains("only 1 Gaussians"));
    assert_eq!(said(10), []);
}
