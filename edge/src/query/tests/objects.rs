use slag_api::objects::Evidence;

use super::*;
use crate::testing::TestObject;

fn two_cells() -> [BuiltShard; 2] {
    [(3, 20.0, 100), (4, 22.0, 60)].map(|(id, x, n)| thing(id, DVec3::X * x, n, 0.9).build(false))
}

/// Cells 3 and 4 share object 21 (30 Gaussians and 12 of 50 in all); cell 4 has object 22 too.
fn scene_of_objects() -> Vec<BuiltShard> {
    let [a, b, c] = [[1.0f32, 0.0], [0.6, 0.8], [0.0, 1.0]];
    let object = |id: u64, vectors: [[f32; 2]; 3], runs: &[std::ops::Range<u32>], n_gaussians| TestObject {
        id,
        vectors: vectors.concat(),
        runs: runs.to_vec(),
        n_gaussians,
    };
    let shared = |runs: &[std::ops::Range<u32>]| object(21, [b, a, c], runs, 50);
    let calibration = Calibration { score_mean: 0.1, score_spread: 0.1 };
    let built = two_cells();
    vec![
        built[0].with_objects(&[shared(&[10..25, 25..40])], calibration),
        built[1].with_objects(
            &[shared(&[0..5, 10..17]), object(22, [c, c, c], &[20..30, 30..50], 30)],
            calibration,
        ),
    ]
}

/// Oracle: scores by hand. The mean's cosine is 0.6, the best side's 1.
#[test]
fn objects_answer_first_and_once() {
    let scene = scene_of_objects();
    let answers = ask(&scene, |request, manifest| {
        request.near = Some(DVec3::ZERO);
        manifest.encoder.calibration = Some(Calibration { score_mean: 0.5, score_spread: 0.2 });
    });
    assert_eq!(answers.kind, AnswerKind::Objects);
    assert_eq!(answers.searched.threshold_source, ThresholdSource::Scene);
    assert!((answers.searched.threshold - 0.4).abs() < 1e-6, "{}", answers.searched.threshold);
    let found = clusters(&answers);
    assert_eq!(found.len(), 1, "{found:?}");
    let object = &found[0];
    assert!(
        (object.score - 0.8).abs() <= answers.searched.score_error_bound
            && answers.searched.score_error_bound < 0.01
    );
    assert_eq!((object.id.as_str(), object.rank), ("o0000000000000015", 1));
    assert_eq!(object.n_gaussians, 42);
    assert_eq!(object.n_gaussians_in_scene, Some(50));
    assert_eq!(answers.searched.n_matching, 42);
    let evidence = Evidence { photo: "21.jpg".into(), box_px: [1, 2, 30, 40], has_thumbnail: true };
    assert_eq!(object.evidence.as_ref(), Some(&evidence));
    assert_eq!((object.position_in_world, object.distance), (DVec3::new(21.0, 0.0, 0.0), Some(21.0)));
    assert_eq!(object.size, DVec3::splat(2.0));
    // From 20.10 to 22.16, without 2 % at either end.
    assert!((object.oriented_box.size.x - 2.06).abs() < 0.05, "{:?}", object.oriented_box);
    assert!(!answers.searched.is_exact && answers.searched.clustering.is_none() && answers.reason.is_none());

    // Without a calibrated scene the encoder's own threshold applies; other kinds are unaffected.
    let answers = ask(&scene, |request, _| request.kind = Some(AnswerKind::Objects));
    assert_eq!(answers.searched.threshold_source, ThresholdSource::Encoder);
    let clusters_of = |built: &[BuiltShard]| {
        ask(built, |request, _| (request.kind, request.threshold) = (Some(AnswerKind::Clusters), Some(0.5)))
            .answers
    };
    assert_eq!(clusters_of(&scene), clusters_of(&two_cells()));
}

/// By hand: the best object has 0.8, the best Gaussians 0.9.
#[test]
fn what_no_object_answers_clusters_do() {
    let scene = scene_of_objects();
    let ask_above = |threshold, kind| {
        ask(&scene, |request, _| (request.threshold, request.kind) = (Some(threshold), kind))
    };
    assert_eq!(ask_above(0.7, None).kind, AnswerKind::Objects);
    let found = ask_above(0.89, None);
    assert!(!found.answers.is_empty());
    assert_eq!(found, ask_above(0.89, Some(AnswerKind::Clusters)));
    let reason = ask_above(0.95, None).reason.expect("no answer").detail;
    assert!(reason.contains("no object reaches 0.95") && reason.contains("no Gaussian of the"), "{reason}");
}

#[test]
fn objects_abstain_and_keep_to_the_region() {
    let scene = scene_of_objects();
    let ask_objects = |edit: &dyn Fn(&mut QueryRequest)| {
        ask(&scene, |request, _| {
            request.kind = Some(AnswerKind::Objects);
            edit(request);
        })
    };
    // Below the threshold: the reason names the best object and its position.
    let answers = ask_objects(&|request| request.threshold = Some(0.9));
    let reason = answers.reason.as_ref().expect("no answer");
    assert_eq!(answers.kind, AnswerKind::Objects);
    assert_eq!(reason.kind, ReasonKind::BelowThreshold);
    assert_eq!(answers.answers.len(), 0);
    assert!(
        reason.best_score.is_some_and(|s| (s - 0.8).abs() < 0.01) && reason.detail.contains("reaches 0.9"),
        "{reason:?}"
    );
    assert_eq!(reason.best_position_in_world, Some(DVec3::new(21.0, 0.0, 0.0)));
    // Only Gaussians in the region count: 20 of cell 3, from 20.20 to 20.39.
    let within =
        |min: f64, max: f64| Aabb { min: DVec3::new(min, -1.0, -1.0), max: DVec3::new(max, 1.0, 1.0) };
    let answers = ask_objects(&|request| {
        (request.threshold, request.region.bounds) = (Some(0.5), Some(within(20.195, 20.9)));
    });
    let cut = &clusters(&answers)[0];
    assert_eq!(cut.n_gaussians, 20);
    // Position and box of the part inside; the whole object's have names of their own.
    assert!((cut.position_in_world - DVec3::new(20.295, 0.0, 0.0)).length() < 1e-6, "{cut:?}");
    assert!(cut.box_min_in_world.x >= 20.195 && cut.box_max_in_world.x <= 20.9, "{cut:?}");
    let whole = cut.whole.expect("the box cuts the object");
    assert_eq!(whole.position_in_world, DVec3::new(21.0, 0.0, 0.0));
    assert_eq!(whole.box_max_in_world - whole.box_min_in_world, DVec3::splat(2.0));
    // No answers beyond the radius.
    let near = DVec3::new(20.0, 0.0, 0.0);
    for radius in [0.15, 0.3, 1.0, 2.05, 30.0] {
        let answers = ask_objects(&|request| {
            (request.threshold, request.near) = (Some(0.5), Some(near));
            request.region.ball = Some(Ball { centre_in_world: near, radius });
            request.min_count = 1;
        });
        let object = &clusters(&answers)[0];
        assert!(object.distance.is_some_and(|distance| distance <= radius), "{radius}: {object:?}");
        assert_eq!(object.whole.is_none(), radius == 30.0);
    }
    // The box holds all of cell 4 and none of the object's Gaussians in cell 3, though its border crosses that cell.
    let answers = ask_objects(&|request| {
        let bounds = Aabb { min: DVec3::new(21.9, -1.0, -1.0), max: DVec3::splat(1e3) };
        (request.threshold, request.region.bounds) = (Some(0.5), Some(bounds));
    });
    assert_eq!((clusters(&answers)[0].n_gaussians, answers.searched.n_searched), (12, 160));
    // From 22.00 to 22.16: those of cell 3 are outside the box, too.
    assert!((clusters(&answers)[0].oriented_box.size.x - 0.16).abs() < 0.011);
    // All matches are counted, however few are returned.
    let answers = ask_about(&scene, &[Question::new([0.6, 0.8])], |request, _| request.limit = Some(1));
    let found = clusters(&answers[0]);
    assert_eq!((found.len(), found[0].rank, found[0].n_gaussians), (1, 1, 42));
    assert_eq!((answers[0].searched.n_matching, found[0].id.as_str()), (72, "o0000000000000015"));
    let answers = ask_objects(&|request| {
        (request.threshold, request.region.bounds) = (Some(0.5), Some(within(50.0, 60.0)));
    });
    let nothing = answers.reason.expect("no answer");
    assert_eq!((nothing.kind, answers.coverage.area_fetched), (ReasonKind::NothingThere, Some(true)));
    // With a negative the score is the difference of the object's scores: 0.8 - 0.9 for 21, 0 - 1 for 22.
    let question =
        Question { negatives: vec![std::sync::Arc::from([0.0f32, 1.0])], ..Question::new([1.0, 0.0]) };
    let answers = ask_about(&scene, &[question], |request, _| {
        (request.negatives, request.threshold) = (Negatives(vec!["other".into()]), Some(0.2));
    });
    let found = clusters(&answers[0]);
    let expected = crate::score::relevancy(0.8 - 0.9);
    assert!(found.len() == 1 && (found[0].score - expected).abs() < 0.01, "{found:?}");
    // Negatives add no answer, however far from them a thing is: 21 has 0.8, 22 has 0.
    for (threshold, expected) in [(None, 1), (Some(0.4), 2)] {
        let question = Question { negatives: vec![[0.0f32, -1.0].into()], ..Question::new([1.0, 0.0]) };
        let answers = ask_about(&scene, &[question], |request, _| {
            (request.negatives, request.threshold) = (Negatives(vec!["other".into()]), threshold);
        });
        assert_eq!(clusters(&answers[0]).len(), expected, "{threshold:?}");
    }
    // A scene without objects reports that.
    let answers = ask(&yard(), |request, _| request.kind = Some(AnswerKind::Objects));
    assert!(answers.reason.is_some_and(|r| r.detail.contains("kind=clusters")));
    assert_eq!(ask(&yard(), |_, _| ()).kind, AnswerKind::Clusters);
}

/// Reasons are of the region, and suggest no fetch of an area on board. By hand: object 22 alone lies beyond x =
/// 22.195, with a score of 0; from 20.5 to 20.9 lie Gaussians of no object, from 20.195 to 20.9 20 of object 21.
#[test]
fn reasons_are_of_the_region() {
    let scene = scene_of_objects();
    let reason = |from: f64, to: f64, min_count: u64, kind: Option<AnswerKind>| {
        let answers = ask(&scene, |request, _| {
            let bounds = Aabb { min: DVec3::new(from, -1.0, -1.0), max: DVec3::new(to, 1.0, 1.0) };
            (request.kind, request.threshold, request.min_count) = (kind, Some(0.95), min_count);
            request.region.bounds = Some(bounds);
            if min_count == 30 {
                request.threshold = Some(0.5);
            }
        });
        let (is_on_board, reason) = (answers.coverage.area_fetched, answers.reason.expect("no answer"));
        assert_eq!(is_on_board, Some(true));
        assert!(!reason.detail.contains("fetch"), "{}", reason.detail);
        let is_inside = |at: DVec3| (from..=to).contains(&at.x);
        assert!(reason.best_position_in_world.is_none_or(is_inside), "{reason:?}");
        reason
    };
    let objects = Some(AnswerKind::Objects);
    for kind in [objects, None] {
        let low = reason(22.195, 22.6, 1, kind);
        assert_eq!(low.kind, ReasonKind::BelowThreshold, "{}", low.detail);
        let holds = low.best_score.is_some_and(|score| score < 0.1) && low.detail.contains("in the box");
        assert!(holds, "{low:?}");
        let of_none = reason(20.5, 20.9, 1, kind);
        assert_eq!(of_none.kind, ReasonKind::BelowThreshold, "{}", of_none.detail);
        // Without objects the nearest miss is among the Gaussians.
        assert_eq!(of_none.best_score.is_some(), kind.is_none(), "{of_none:?}");
    }
    let small = reason(20.195, 20.9, 30, objects);
    assert_eq!(small.kind, ReasonKind::ClustersTooSmall, "{}", small.detail);
    assert!(small.detail.contains("lower min_count"), "{}", small.detail);
}

/// By hand: of object 21's Gaussians 30 lie from 20.10 to 20.39, and 12 strays 1.6 m away.
#[test]
fn points_of_an_object_are_those_of_its_largest_cluster() {
    let built = scene_of_objects();
    let points = on_scene(&built, |scene| inventory::largest_cluster(scene, 0));
    let inside = |point: &DVec3| point.x > 20.095 && point.x < 20.395;
    assert!((28..=30).contains(&points.len()) && points.iter().all(inside), "{points:?}");
}
