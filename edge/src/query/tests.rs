use glam::DVec3;
use slag_api::objects::Alignment;
use slag_common::frames::{Aabb, GeoReference, Geographic};
use slag_common::manifest::{Calibration, Manifest};

use super::*;
use crate::score::{Ball, Budget, Precision, Question};
use crate::store::objects::ObjectIndex;
use crate::testing::{BuiltShard, Member, TestShard, manifest_of, normalised};

mod budget;
mod objects;

/// A cell with a single centroid of `n` Gaussians, 1 cm apart, at a given cosine to axis 0.
fn thing(cell_id: u32, at: DVec3, n: u16, cosine: f32) -> TestShard {
    let embedding = normalised(vec![cosine, (1.0 - cosine * cosine).sqrt()]);
    let members = (0..n).map(|i| Member { steps: [i, 0, 0], embedding: embedding.clone() }).collect();
    TestShard { cell_id, origin: at, ..TestShard::new(vec![members]) }
}

fn ask(built: &[BuiltShard], edit: impl FnOnce(&mut QueryRequest, &mut Manifest)) -> Answers {
    ask_about(built, &[Question::new([1.0, 0.0])], edit).remove(0)
}

fn ask_about(
    built: &[BuiltShard],
    questions: &[Question],
    edit: impl FnOnce(&mut QueryRequest, &mut Manifest),
) -> Vec<Answers> {
    let (mut request, mut manifest) = (QueryRequest::new("thing"), manifest_of(built, 7));
    edit(&mut request, &mut manifest);
    request.check().expect("a sound request");
    let labels: Vec<&str> = request.asked.iter().map(Asked::label).collect();
    on_scene_of(built, &manifest, |scene| {
        answer(scene, (&labels, questions), &request, &Budget::default()).expect("answers")
    })
}

fn on_scene<T>(built: &[BuiltShard], work: impl FnOnce(&Scene<'_>) -> T) -> T {
    on_scene_of(built, &manifest_of(built, 7), work)
}

fn on_scene_of<T>(built: &[BuiltShard], manifest: &Manifest, work: impl FnOnce(&Scene<'_>) -> T) -> T {
    let shards: Vec<_> = built.iter().map(BuiltShard::view).collect();
    let objects: Vec<_> = built.iter().map(|shard| shard.layout.additions(&shard.bytes).objects).collect();
    let index = ObjectIndex::new(&objects);
    let not_fetched = manifest.cells.iter().skip(built.len()).collect();
    work(&Scene { shards, objects, index: &index, manifest, not_fetched, bad_cells: &[] })
}

fn described(built: &[BuiltShard], answers: &Answers, near: Option<DVec3>) -> Vec<GaussianAnswer> {
    let Found::Gaussians(hits) = &answers.answers else { panic!("gaussians") };
    let describe = |(at, hit): (usize, &crate::score::Hit)| {
        GaussianAnswer::new(at, hit, &built[hit.shard as usize].view(), near)
    };
    hits.iter().enumerate().map(describe).collect()
}

fn clusters(answers: &Answers) -> &[ClusterAnswer] {
    let Found::Clusters(clusters) = &answers.answers else { panic!("clusters") };
    clusters
}

fn yard() -> Vec<BuiltShard> {
    let things = [
        thing(3, DVec3::new(20.0, 0.0, 0.0), 100, 0.9),
        thing(4, DVec3::new(-5.0, 0.0, 0.0), 100, 0.9),
        thing(5, DVec3::new(0.0, 30.0, 0.0), 20, 0.7),
        thing(6, DVec3::new(0.0, 0.0, 9.0), 4, 0.95),
        thing(7, DVec3::new(0.0, -20.0, 0.0), 500, 0.3),
    ];
    things.iter().map(|thing| thing.build(false)).collect()
}

/// Oracle: the places, counts and cosines that the yard was made from, and the documented formula.
#[test]
fn clusters_are_ranked_nearest_best() {
    let yard = yard();
    let answers = ask(&yard, |_, _| ());
    assert_eq!((answers.searched.n_searched, answers.searched.n_matching, answers.unit), (724, 224, "m"));
    assert_eq!(answers.reason.as_ref(), None);
    assert_eq!(answers.coverage.area_fetched, Some(true));
    assert!(!answers.searched.is_exact);
    let found = clusters(&answers);
    // Equal things without an asker: ordered by first Gaussian. Four Gaussians are too few.
    assert_eq!(found.iter().map(|c| c.id.as_str()).collect::<Vec<_>>(), ["3-0", "4-0", "5-0"]);
    let clustering = answers.searched.clustering.as_ref().expect("clusters");
    assert_eq!((clustering.n_small_clusters, clustering.n_gaussians_in_small_clusters), (1, 4));
    let first = &found[0];
    assert_eq!((first.rank, first.n_gaussians, first.distance), (1, 100, None));
    assert!((first.score - 0.9).abs() < 1e-3 && first.best_score >= first.score);
    // 100 in a line, 1 cm apart: 2 % off either end is one Gaussian each.
    assert!((first.position_in_world - DVec3::new(20.495, 0.0, 0.0)).length() < 1e-9);
    assert!((first.size - DVec3::new(0.97, 0.0, 0.0)).length() < 1e-9);

    let near = DVec3::new(-4.505, 0.0, 0.0);
    let answers = ask(&yard, |request, _| request.near = Some(near));
    let found = clusters(&answers);
    assert_eq!(found.iter().map(|c| c.id.as_str()).collect::<Vec<_>>(), ["4-0", "3-0", "5-0"]);
    assert!(
        found[0].distance.is_some_and(|d| d < 1e-9)
            && found[1].distance.is_some_and(|d| (d - 25.0).abs() < 1e-9)
    );
    for cluster in found {
        let distance = cluster.position_in_world.distance(near);
        let expected = f64::from(cluster.score) / (1.0 + distance / 10.0);
        assert!((f64::from(cluster.relevance) - expected).abs() < 1e-6);
    }
}

/// A worse thing beats a better one far away if it is near enough.
#[test]
fn distance_and_score_are_weighed() {
    let yard = yard();
    let first_from =
        |near: DVec3| clusters(&ask(&yard, |request, _| request.near = Some(near)))[0].id.clone();
    assert_eq!(first_from(DVec3::new(0.0, 30.0, 0.0)), "5-0");
    assert_eq!(first_from(DVec3::new(0.0, 10.0, 0.0)), "4-0");
    // With no score above the base, score and distance are left.
    for (x, first) in [(30.0, "3-0"), (-30.0, "4-0")] {
        let answers = ask(&yard, |request, manifest| {
            (request.threshold, request.near) = (Some(0.5), Some(DVec3::new(x, 0.0, 0.0)));
            manifest.encoder.calibration = Some(Calibration { score_mean: 0.91, score_spread: 0.01 });
        });
        assert_eq!((clusters(&answers)[0].id.as_str(), clusters(&answers)[0].relevance), (first, 0.0));
    }
}

/// A threshold filters and a voxel groups; neither reorders the rest.
#[test]
fn neither_threshold_nor_voxel_changes_the_order() {
    let yard = yard();
    let near = DVec3::new(0.0, 14.0, 0.0);
    let asked = |threshold: f32, voxel: f64, min_count: u64| {
        let answers = ask(&yard, |request, _| {
            (request.threshold, request.near) = (Some(threshold), Some(near));
            (request.voxel, request.min_count) = (Some(voxel), min_count);
        });
        let key = |cluster: &ClusterAnswer| (cluster.id.clone(), cluster.relevance);
        clusters(&answers).iter().map(key).collect::<Vec<_>>()
    };
    let all = asked(0.2, 0.25, 1);
    assert_eq!(all.iter().map(|(id, _)| &**id).collect::<Vec<_>>(), ["4-0", "6-0", "5-0", "3-0", "7-0"]);
    for (threshold, n_left) in [(0.5, 4), (0.69, 4), (0.85, 3), (0.94, 1)] {
        for voxel in [0.05, 0.25, 1.0] {
            let left = asked(threshold, voxel, 1);
            let expected: Vec<_> =
                all.iter().filter(|other| left.iter().any(|(id, _)| *id == other.0)).cloned().collect();
            assert_eq!((left.len(), &left), (n_left, &expected), "threshold {threshold}, voxel {voxel}");
        }
    }
    assert_eq!(asked(0.5, 0.25, 10).len(), 3, "the four Gaussians are too few");
}

#[test]
fn empty_answers_say_why() {
    let yard = yard();
    let high = ask(&yard, |request, _| request.threshold = Some(0.99)).reason.expect("nothing found");
    assert_eq!(high.kind, ReasonKind::BelowThreshold);
    assert!(
        high.detail.contains("724") && high.detail.contains("0.99") && high.detail.contains("0.950"),
        "{}",
        high.detail
    );
    assert_eq!(high.best_position_in_world, Some(DVec3::new(0.0, 0.0, 9.0)));

    let ball = |at: DVec3, radius: f64| {
        move |request: &mut QueryRequest, _: &mut Manifest| {
            (request.near, request.region.ball) = (Some(at), Some(Ball { centre_in_world: at, radius }));
        }
    };
    let small = ask(&yard, ball(DVec3::new(0.0, 0.0, 9.0), 2.0));
    assert_eq!(small.reason.as_ref().expect("too small").kind, ReasonKind::ClustersTooSmall);
    assert_eq!((small.searched.n_matching, small.coverage.area_fetched), (4, Some(true)));
    let nothing = ask(&yard, ball(DVec3::new(49.0, 49.0, 0.0), 2.0));
    let reason = nothing.reason.expect("nothing there");
    assert_eq!((reason.kind, reason.best_score), (ReasonKind::NothingThere, None));
    assert_eq!(nothing.coverage.area_fetched, Some(true));
    // Of two more cells at 48 and 60 m nothing was fetched.
    for (radius, expected) in [(Some(1.5), 0), (Some(3.0), 1), (Some(30.0), 2), (None, 2)] {
        let answers = ask(&yard, |request, manifest| {
            for at in [48.0, 60.0] {
                let bounds = Aabb { min: DVec3::splat(at), max: DVec3::splat(at + 1.0) };
                manifest.cells.push(slag_common::manifest::CellRecord {
                    cell_id: 70 + at as u32,
                    bounds,
                    ..manifest.cells[0].clone()
                });
            }
            let ball = |radius| Ball { centre_in_world: DVec3::new(46.0, 48.0, 48.0), radius };
            (request.threshold, request.region.ball) = (Some(1.0), radius.map(ball));
        });
        let found = answers.coverage;
        assert_eq!(
            (found.area_fetched, found.n_cells_not_fetched),
            (Some(expected == 0), expected),
            "{radius:?}"
        );
        let detail = answers.reason.expect("nothing").detail;
        assert_eq!(detail.contains("not fetched"), expected > 0, "{detail}");
    }
    let gaussians =
        ask(&yard, |request, _| (request.kind, request.threshold) = (Some(AnswerKind::Gaussians), Some(1.0)));
    assert_eq!(gaussians.reason.expect("nothing found").kind, ReasonKind::BelowThreshold);
}

/// Ten Gaussians seen by views, and six unseen, five metres away: counted by hand.
#[test]
fn no_is_said_only_where_views_looked() {
    let unseen = (0..6).map(|i| [500 + i, 0, 0]).collect();
    let shard = TestShard { without_evidence: unseen, ..thing(3, DVec3::ZERO, 10, 0.3) };
    let scene = [shard.build(false)];
    let around = |x: f64, radius: f64| {
        let centre_in_world = DVec3::new(x, 0.0, 0.0);
        let answers = ask(&scene, |request, _| {
            request.threshold = Some(0.9);
            (request.near, request.region.ball) =
                (Some(centre_in_world), Some(Ball { centre_in_world, radius }));
        });
        answers.reason.expect("nothing found")
    };
    let cases = [
        (around(0.0, 60.0), ReasonKind::BelowThreshold, Some(10.0 / 16.0)),
        (around(0.0, 1.0), ReasonKind::BelowThreshold, Some(1.0)),
        (around(5.0, 1.0), ReasonKind::NotLookedThere, Some(0.0)),
        // Two of the seen and all unseen ones.
        (around(5.0, 4.925), ReasonKind::NotLookedThere, Some(2.0 / 8.0)),
        (around(30.0, 1.0), ReasonKind::NothingThere, None),
    ];
    for (reason, kind, seen_share) in cases {
        assert_eq!((reason.kind, reason.seen_share), (kind, seen_share), "{}", reason.detail);
        let is_told = reason.detail.starts_with("not looked there: photos saw ");
        assert_eq!(is_told, kind == ReasonKind::NotLookedThere, "{}", reason.detail);
    }
    assert!(around(5.0, 4.925).detail.contains("saw 25 % of what is on board within 4.925 of"));
}

#[test]
fn gaussians_come_best_then_nearest_first() {
    let near = DVec3::new(20.355, 0.0, 0.0);
    let yard = yard();
    let answers = ask(&yard, |request, _| {
        (request.kind, request.limit, request.near) = (Some(AnswerKind::Gaussians), Some(7), Some(near));
    });
    let found = described(&yard, &answers, Some(near));
    let names: Vec<(u32, u32)> = found.iter().map(|g| (g.cell_id, g.index)).collect();
    // Cell 6 has the best scores, its Gaussians in order of x; then the two things tie, the nearer one first.
    assert_eq!(names, [(6, 3), (6, 2), (6, 1), (6, 0), (3, 35), (3, 36), (3, 34)]);
    assert_eq!(answers.searched.n_matching, 224);
    assert_eq!(found[0].input_index, None);
    assert!(answers.searched.clustering.is_none());
}

#[test]
fn exact_shards_answer_exactly() {
    let exact = [thing(1, DVec3::ZERO, 30, 0.7).build(true)];
    let clusters_of = ask(&exact, |_, _| ());
    let gaussians = ask(&exact, |request, _| request.kind = Some(AnswerKind::Gaussians));
    assert!(
        clusters_of.searched.is_exact
            && gaussians.searched.is_exact
            && gaussians.searched.score_error_bound < 1e-5
    );
    let found = described(&exact, &gaussians, None);
    assert_eq!((found.len(), found[2].input_index), (DEFAULT_LIMIT, Some(7)));
}

/// With centroids only, exact shards answer as compact ones do, and say so.
#[test]
fn exactness_is_a_choice() {
    let exact = [thing(1, DVec3::ZERO, 30, 0.7).build(true)];
    let by_centroids = ask(&exact, |request, _| {
        (request.kind, request.precision) = (Some(AnswerKind::Gaussians), Precision::Centroids)
    });
    let compact = [thing(1, DVec3::ZERO, 30, 0.7).build(false)];
    assert_eq!(by_centroids, ask(&compact, |request, _| request.kind = Some(AnswerKind::Gaussians)));
    assert!(
        !by_centroids.searched.is_exact && by_centroids.searched.score_error_bound > 1e-5,
        "{}",
        by_centroids.searched.score_error_bound
    );
}

/// Oracle: cosines to both axes, and LERF's formula.
#[test]
fn negatives_make_relevancies() {
    let yard = yard();
    let question = Question { negatives: vec![[0.0, 1.0].into()], ..Question::new([1.0, 0.0]) };
    let ask = |edit: fn(&mut QueryRequest)| {
        let mut answers = ask_about(&yard, std::slice::from_ref(&question), |request, _| {
            request.negatives = Negatives(vec!["other".into()]);
            edit(request);
        });
        answers.remove(0)
    };
    let expected = |cosine: f64| {
        let other = (1.0 - cosine * cosine).sqrt();
        1.0 / (1.0 + (-10.0 * (cosine - other)).exp())
    };
    let answers = ask(|_| ());
    assert_eq!((answers.searched.score_kind, answers.searched.threshold), (ScoreKind::Relevancy, 0.5));
    assert_eq!(answers.searched.threshold_source, ThresholdSource::Relevancy);
    assert_eq!(&answers.searched.negatives[0][..], "other");
    // 0.7 is nearer to the other axis.
    assert_eq!(answers.searched.n_matching, 204);
    let found = clusters(&answers);
    assert_eq!(found.iter().map(|c| c.id.as_str()).collect::<Vec<_>>(), ["3-0", "4-0"]);
    let bound = f64::from(answers.searched.score_error_bound);
    assert!((f64::from(found[0].score) - expected(0.9)).abs() <= bound && bound < 0.02, "{bound}");
    let answers = ask(|request| request.threshold = Some(0.4));
    assert_eq!(answers.searched.n_matching, 224);
    assert_eq!(answers.searched.threshold_source, ThresholdSource::Request);
    let all = ask(|request| (request.threshold, request.kind) = (Some(0.0), Some(AnswerKind::Gaussians)));
    assert_eq!(all.searched.n_matching, 724);
    let best = &described(&yard, &all, None)[0];
    assert!((f64::from(best.score) - expected(0.95)).abs() <= bound, "{best:?}");
    let none = ask(|request| request.threshold = Some(1.0)).reason.expect("nothing is certain");
    assert!((f64::from(none.best_score.expect("the best")) - expected(0.95)).abs() <= bound);
}

/// Relevancies are steepest half way between question and negative: there errors nearly reach the bound.
#[test]
fn relevancies_keep_within_their_bound_and_use_it() {
    let angles = |turn: f64| [-turn, turn].map(|turn| turn + std::f64::consts::FRAC_PI_4);
    let member = |angle: &f64| Member {
        steps: [0; 3],
        embedding: [angle.cos(), angle.sin()].map(|v| v as f32).to_vec(),
    };
    let built = |turn| [TestShard::new(vec![angles(turn).iter().map(member).collect()]).build(false)];
    let question = Question { negatives: vec![[0.0, 1.0].into()], ..Question::new([1.0, 0.0]) };
    let ask = |built: &[BuiltShard]| {
        let mut answers = ask_about(built, std::slice::from_ref(&question), |request, _| {
            request.negatives = Negatives(vec!["other".into()]);
            (request.kind, request.threshold) = (Some(AnswerKind::Gaussians), Some(0.0));
        });
        answers.remove(0)
    };
    // No relevancy is off by more than the whole scale.
    assert_eq!(ask(&built(0.7)).searched.score_error_bound, 1.0);
    let built = built(0.02);
    let answers = ask(&built);
    for (angle, found) in angles(0.02).iter().zip(described(&built, &answers, None)) {
        let truth = 1.0 / (1.0 + (-10.0 * (angle.cos() - angle.sin())).exp());
        let share = (f64::from(found.score) - truth).abs() / f64::from(answers.searched.score_error_bound);
        assert!((0.9..=1.0).contains(&share), "{share} of {}", answers.searched.score_error_bound);
    }
}

#[test]
fn boxes_bound_what_is_searched() {
    let yard = yard();
    let bounds = |min: [f64; 3], max: [f64; 3]| Some(Aabb { min: min.into(), max: max.into() });
    let answers =
        ask(&yard, |request, _| request.region.bounds = bounds([-6.0, -1.0, -1.0], [-4.501, 1.0, 1.0]));
    // Points at -5, -4.99, ..: 50 of them lie below -4.501.
    assert_eq!((answers.searched.n_matching, answers.coverage.area_fetched), (50, Some(true)));
    let far = ask(&yard, |request, _| request.region.bounds = bounds([0.0; 3], [40.0, 40.0, 1.0]));
    assert_eq!(far.coverage.area_fetched, Some(true));
    let both = ask(&yard, |request, _| {
        request.region.bounds = bounds([0.0; 3], [40.0, 40.0, 1.0]);
        request.region.ball = Some(Ball { centre_in_world: DVec3::new(20.0, 0.0, 0.0), radius: 0.105 });
    });
    assert_eq!((both.coverage.area_fetched, both.searched.n_matching), (Some(true), 11));
    let nothing = ask(&yard, |request, _| request.region.bounds = bounds([60.0; 3], [61.0; 3])).reason;
    assert!(nothing.expect("nothing there").detail.contains("in the box [60, 60, 60] to [61, 61, 61]"));
}

/// A metric world has a known up; otherwise only the principal axes are known.
#[test]
fn boxes_are_upright_where_up_is_known() {
    // A ramp of 100 Gaussians, 1 cm apart along x and rising half as fast.
    let embedding = vec![1.0, 0.0];
    let members = (0..100).map(|i| Member { steps: [i * 2, 0, i], embedding: embedding.clone() }).collect();
    let ramp = [TestShard { step: DVec3::splat(0.005), ..TestShard::new(vec![members]) }.build(false)];
    let oriented = |metric: bool| {
        clusters(&ask(&ramp, |request, manifest| (manifest.metric, request.voxel) = (metric, Some(0.25))))[0]
            .oriented_box
    };
    let (upright, free) = (oriented(true), oriented(false));
    assert_eq!((upright.alignment, free.alignment), (Alignment::Gravity, Alignment::Principal));
    assert!((upright.size - DVec3::new(0.97, 0.0, 0.485)).length() < 1e-9, "{upright:?}");
    assert!((free.size - DVec3::new(0.97 * 1.25f64.sqrt(), 0.0, 0.0)).length() < 1e-9, "{free:?}");
    assert!((free.rotation_world_from_box * DVec3::X).dot(DVec3::new(2.0, 0.0, 1.0).normalize()) > 0.999_999);
}

#[test]
fn thresholds_say_where_they_come_from() {
    let answers = ask(&yard(), |request, _| request.threshold = Some(0.2));
    assert_eq!(answers.searched.threshold, 0.2);
    assert_eq!(answers.searched.threshold_source, ThresholdSource::Request);
    let answers = ask(&yard(), |_, manifest| manifest.encoder.default_threshold = 0.8);
    assert_eq!(answers.searched.threshold, 0.8);
    assert_eq!(answers.searched.threshold_source, ThresholdSource::Encoder);
    assert_eq!((answers.searched.n_matching, answers.searched.score_kind), (204, ScoreKind::Cosine));
}

#[test]
fn answers_carry_the_place_on_earth() {
    let origin = Geographic { latitude_deg: 46.8, longitude_deg: -92.0, height_m: 180.0 };
    let answers = ask(&yard(), |_, manifest| manifest.geo_reference = Some(GeoReference { origin }));
    let north = clusters(&answers)[2].geographic.expect("geo-referenced");
    // 30 m north, at 111.2 km per degree of latitude.
    assert!((north.latitude_deg - 46.8 - 30.0 / 111_200.0).abs() < 1e-6, "{north:?}");
}

#[test]
fn voxels_of_a_scene_without_metres_follow_its_cells() {
    let yard = yard();
    let mut manifest = manifest_of(&yard, 1);
    assert_eq!(default_voxel(&manifest), 0.25);
    manifest.metric = false;
    for (at, cell) in manifest.cells.iter_mut().enumerate() {
        cell.bounds.max = cell.bounds.min + DVec3::new(1e3, 64.0 * (at as f64 + 1.0), 0.1);
    }
    assert_eq!(default_voxel(&manifest), 3.0);
    manifest.cells.clear();
    assert_eq!(default_voxel(&manifest), 1.0);
}
