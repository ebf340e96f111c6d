//! From a checked request to ranked answers.

use std::collections::BTreeMap;

use glam::DVec3;
use rayon::prelude::*;
use slag_api::objects::Evidence;

use super::answers::{Answers, BadCellAnswer, ClusterAnswer, Clustering, Found, Reason, Searched, Whole};
use super::cluster::{Cluster, Grouping, cluster};
use super::extent::Extent;
use super::objects::{self, FoundObject};
use super::outcome::RelatedAnswers;
use super::rank::{Order, Ranked};
use super::reason;
use super::request::{AnswerKind, QueryRequest};
use super::scale::Scale;
use super::scene::{Scene, alignment, default_voxel, unit};
use super::threshold::ThresholdSource;
use crate::score::{
    Budget, Hit, ObjectScores, Question, Region, Run, ScoreError, Scratch, Search, score_objects,
};
use crate::store::{BadCell, cell_of};
use slag_common::manifest::Manifest;

/// Answers a checked request about a scene: one answer for each question, in their order. `questions`: their
/// names, and their vectors, each with those of its negatives.
///
/// Without a kind, a question that no object answers is answered by clusters.
///
/// The same scene, vectors and request give the same answers for any number of threads, asked alone or
/// together. `scratch`: buffers of earlier answers, or new ones, and what the request may use.
/// # Errors
/// [`ScoreError`]; one is a request that needs more than its budget.
pub fn answer(
    scratch: &mut Scratch,
    scene: &Scene<'_>,
    (labels, questions): (&[&str], &[Question]),
    request: &QueryRequest,
) -> Result<Vec<Answers>, ScoreError> {
    match request.kind {
        Some(AnswerKind::Objects) => by_objects(scratch, scene, (labels, questions), request),
        Some(kind) => by_gaussians(scratch, scene, (labels, questions), kind, request),
        None if scene.index.is_empty() => {
            by_gaussians(scratch, scene, (labels, questions), AnswerKind::Clusters, request)
        }
        None => {
            let mut answers = by_objects(scratch, scene, (labels, questions), request)?;
            let is_open = |at: &usize| answers[*at].answers.is_empty();
            let open: Vec<usize> = (0..answers.len()).filter(is_open).collect();
            if open.is_empty() {
                return Ok(answers);
            }
            // Ground is no object, and neither is what few photos outline.
            let of_open: (Vec<&str>, Vec<Question>) =
                open.iter().map(|at| (labels[*at], questions[*at].clone())).unzip();
            let of_open = (of_open.0.as_slice(), of_open.1.as_slice());
            let clusters = by_gaussians(scratch, scene, of_open, AnswerKind::Clusters, request)?;
            for (at, clusters) in open.into_iter().zip(clusters) {
                match (&mut answers[at].reason, &clusters.reason) {
                    // Neither answers: both say why.
                    (Some(of_objects), Some(of_clusters)) => {
                        of_objects.detail = format!("{}; {}", of_objects.detail, of_clusters.detail);
                    }
                    _ => answers[at] = clusters,
                }
            }
            Ok(answers)
        }
    }
}

/// Answers questions with objects.
fn by_objects(
    scratch: &mut Scratch,
    scene: &Scene<'_>,
    (labels, questions): (&[&str], &[Question]),
    request: &QueryRequest,
) -> Result<Vec<Answers>, ScoreError> {
    let scored = score_objects(scene.shards, scene.objects, scene.index, questions)?;
    each(scratch.budget(), (labels, questions), &scored, |text, question, scored, budget| {
        answer_objects(scene, text, question, scored, budget, request)
    })
}

/// Answers questions with Gaussians, or with clusters of them.
fn by_gaussians(
    scratch: &mut Scratch,
    scene: &Scene<'_>,
    (labels, questions): (&[&str], &[Question]),
    kind: AnswerKind,
    request: &QueryRequest,
) -> Result<Vec<Answers>, ScoreError> {
    let searches =
        Search::batch(scratch, scene.shards, questions, request.region.clone(), request.precision)?;
    each(scratch.budget(), (labels, questions), &searches, |text, question, search, budget| {
        answer_gaussians(scene, (text, kind), question, search, budget, request)
    })
}

/// Answers each question from what was scored for it; of the bytes of each only those of its answers stay charged.
fn each<S>(
    budget: &Budget,
    (labels, questions): (&[&str], &[Question]),
    scored: &[S],
    answer: impl Fn(&str, &Question, &S, &Budget) -> Answers,
) -> Result<Vec<Answers>, ScoreError> {
    let charged = |((text, question), scored)| {
        let used_bytes = budget.used_bytes();
        let answers = answer(text, question, scored, budget);
        budget.check()?;
        budget.give_back_to(used_bytes, answers.answers.len_bytes());
        Ok(answers)
    };
    labels.iter().copied().zip(questions).zip(scored).map(charged).collect()
}

/// Answers a question with the objects that match; no centroid is scored.
fn answer_objects(
    scene: &Scene<'_>,
    text: &str,
    question: &Question,
    scored: &ObjectScores,
    budget: &Budget,
    request: &QueryRequest,
) -> Answers {
    let (manifest, scale, region) = (scene.manifest, Scale::of(question), &request.region);
    let calibration = objects::calibration(scene.objects);
    let threshold = scale.threshold(request, manifest, calibration);
    let of_score = scale.to_score(threshold.0);
    let found = objects::matching(scene, &scored.scores, of_score, region, request.min_count);
    let n_matching = found.iter().map(|object| object.n_gaussians).sum();
    let key = |object: &FoundObject<'_>| (scale.shown(object.score), object.extent().position_in_world);
    let order = Order::new(scale.base(calibration), manifest, request);
    let ranked = order.rank(found, key);
    // Members are runs, at most one for each Gaussian; their positions are needed for the box.
    let of_gaussian = size_of::<DVec3>() + if request.members { size_of::<Run>() } else { 0 };
    // Describes only the objects that are returned.
    let described = ranked.into_par_iter().filter_map(|ranked| {
        let bytes = ranked.found.n_gaussians as usize * of_gaussian + size_of::<ClusterAnswer>();
        let score = scale.shown(ranked.found.score);
        budget.take(bytes).then(|| object_answer(scene, ranked, score, region, request.members))
    });
    let found = Found::Clusters(described.collect());
    let best = objects::best(&scored.scores);
    let best = best.map(|best| (scale.shown(scored.scores[best]), objects::record(scene, best).position()));
    let empty = empty(scene, (text, AnswerKind::Objects), scale, threshold, request);
    Answers {
        searched: Searched {
            n_searched: n_with_evidence(scene, region),
            n_matching,
            score_error_bound: scale.error_bound(scored.error_bound),
            ..empty.searched
        },
        reason: found.is_empty().then(|| reason::of_objects(scene.shards, request, threshold.0, best)),
        answers: found,
        ..empty
    }
}

/// Answers a question by the Gaussians that match, or by clusters of them.
fn answer_gaussians(
    scene: &Scene<'_>,
    (text, kind): (&str, AnswerKind),
    question: &Question,
    search: &Search<'_>,
    budget: &Budget,
    request: &QueryRequest,
) -> Answers {
    let manifest = scene.manifest;
    let scale = Scale::of(question);
    let (threshold, threshold_source) = scale.threshold(request, manifest, manifest.encoder.calibration);
    let score_threshold = scale.to_score(threshold);
    let (found, n_matching, clustering) = match kind {
        AnswerKind::Gaussians => {
            let (hits, n_matching) = hits(search, scale, score_threshold, budget, request);
            (Found::Gaussians(hits), n_matching, None)
        }
        _ => clusters(scene, search, scale, threshold, budget, request),
    };
    // Gaussians of exact shards are listed with their own scores, clusters with their centroids'.
    let score_error_bound = scale.error_bound(match (search.is_exact(), kind) {
        (true, AnswerKind::Gaussians) => question.rounding_bound(),
        _ => search.score_error_bound(),
    });
    // With negatives a score is the difference of two products.
    let n_products = if question.negatives.is_empty() { 1.0 } else { 2.0 };
    let measured = search.measured_errors();
    let empty = empty(scene, (text, kind), scale, (threshold, threshold_source), request);
    Answers {
        searched: Searched {
            n_searched: search.searched().map(|shard| shard.n_with_evidence() as u64).sum(),
            n_matching,
            is_exact: search.is_exact(),
            score_error_bound,
            score_error_likely: measured.map(|errors| scale.error_bound(n_products * errors.likely)),
            clustering,
            ..empty.searched
        },
        reason: found.is_empty().then(|| reason::of_gaussians(search, scale, request, threshold, n_matching)),
        answers: found,
        ..empty
    }
}

/// Returns the Gaussians that match best, and how many match.
fn hits(
    search: &Search<'_>,
    scale: Scale,
    score_threshold: f32,
    budget: &Budget,
    request: &QueryRequest,
) -> (Vec<Hit>, u64) {
    let limit = request.n_ranked();
    let n_searched: usize = search.searched().map(|shard| shard.n_with_evidence()).sum();
    budget.take(limit.min(n_searched) * size_of::<Hit>());
    let mut hits = search.best(limit, score_threshold, request.near);
    // If all are listed, their number is known.
    let is_whole = hits.len() < limit;
    let n_matching = if is_whole { hits.len() as u64 } else { search.matching(score_threshold).n_gaussians };
    hits.iter_mut().for_each(|hit| hit.score = scale.shown(hit.score));
    (hits, n_matching)
}

/// Returns the best clusters of the Gaussians that match, how many match, and how they were clustered.
fn clusters(
    scene: &Scene<'_>,
    search: &Search<'_>,
    scale: Scale,
    threshold: f32,
    budget: &Budget,
    request: &QueryRequest,
) -> (Found, u64, Option<Clustering>) {
    let manifest = scene.manifest;
    let mut matches = search.matching(scale.to_score(threshold));
    matches.runs.iter_mut().for_each(|run| run.score = scale.shown(run.score));
    let voxel = request.voxel.unwrap_or_else(|| default_voxel(manifest));
    let (min_count, alignment, with_members) = (request.min_count, alignment(manifest), request.members);
    let grouping = Grouping { voxel, min_count, threshold, alignment, with_members };
    let grouped = cluster(scene.shards, &matches.runs, &grouping, budget);
    let clustering = Clustering {
        voxel: grouped.voxel,
        min_count,
        n_clusters: grouped.clusters.len() as u64,
        n_small_clusters: grouped.n_small,
        n_gaussians_in_small_clusters: grouped.n_gaussians_in_small,
    };
    let key = |of: &Cluster| (of.score, of.extent.position_in_world);
    let order = Order::new(scale.base(manifest.encoder.calibration), manifest, request);
    let ranked = order.rank(grouped.clusters, key);
    let answers = ranked.into_iter().map(|ranked| cluster_answer(ranked, manifest)).collect();
    (Found::Clusters(answers), matches.n_gaussians, Some(clustering))
}

/// Returns the answers to a phrase as answers to a text: without degrees, and without what they are related to.
pub(super) fn of_related(
    scene: &Scene<'_>,
    text: &str,
    related: RelatedAnswers,
    question: &Question,
    request: &QueryRequest,
) -> Answers {
    let scale = Scale::of(question);
    let threshold = scale.threshold(request, scene.manifest, objects::calibration(scene.objects));
    let answers: Vec<ClusterAnswer> = related.answers.into_iter().map(|(answer, ..)| answer).collect();
    let best_score = |thing: &str| related.parts.iter().find(|part| part.thing == thing)?.best_score;
    let reason = related.miss.map(|miss| Reason {
        kind: miss.kind,
        seen_share: miss.seen_share,
        best_score: best_score(&miss.thing),
        best_position_in_world: None,
        detail: miss.detail,
    });
    let empty = empty(scene, (text, AnswerKind::Objects), scale, threshold, request);
    let n_matching = answers.iter().map(|answer| answer.n_gaussians).sum();
    Answers {
        searched: Searched {
            n_searched: n_with_evidence(scene, &request.region),
            n_matching,
            ..empty.searched
        },
        reason,
        answers: Found::Clusters(answers),
        ..empty
    }
}

/// Returns the number of Gaussians with evidence in the shards that a region touches.
fn n_with_evidence(scene: &Scene<'_>, region: &Region) -> u64 {
    let shards = scene.shards.iter().filter(|shard| region.touches(&shard.position_box()));
    shards.map(|shard| shard.n_with_evidence() as u64).sum()
}

/// Returns an empty answer that describes its question and its scene.
fn empty(
    scene: &Scene<'_>,
    (text, kind): (&str, AnswerKind),
    scale: Scale,
    (threshold, threshold_source): (f32, ThresholdSource),
    request: &QueryRequest,
) -> Answers {
    let manifest = scene.manifest;
    let bad_cells = bad_cells(scene, &request.region);
    let searched = Searched {
        negatives: request.negatives.phrases().into_iter().map(str::to_owned).collect(),
        score_kind: scale.0,
        threshold,
        threshold_source,
        n_searched: 0,
        n_matching: 0,
        is_exact: false,
        score_error_bound: 0.0,
        score_error_likely: None,
        area_fetched: area_fetched(scene.fetched, request)
            .map(|is_fetched| is_fetched && bad_cells.iter().all(|bad| bad.generation.is_some())),
        bad_cells,
        clustering: None,
    };
    Answers {
        text: text.to_owned(),
        kind,
        scene: manifest.scene.clone(),
        generation: manifest.generation,
        unit: unit(manifest),
        searched,
        asked_as: BTreeMap::new(),
        reason: None,
        answers: Found::Clusters(Vec::new()),
    }
}

/// Returns the cells of a region whose shards could not be fetched.
fn bad_cells(scene: &Scene<'_>, region: &Region) -> Vec<BadCellAnswer> {
    let touches =
        |bad: &&BadCell| cell_of(scene.manifest, bad.cell_id).is_none_or(|cell| region.touches(&cell.bounds));
    let generation = |bad: &BadCell| bad.old.map(|old| old.generation);
    let described = |bad: &BadCell| BadCellAnswer { cell_id: bad.cell_id, generation: generation(bad) };
    scene.bad_cells.iter().filter(touches).map(described).collect()
}

/// Returns whether the whole region asked for was fetched: certainly if all of the ball or all of the box
/// was, since only their intersection is asked for.
fn area_fetched((centre, radius): (DVec3, f64), request: &QueryRequest) -> Option<bool> {
    let region = &request.region;
    let ball = region.ball.map(|ball| ball.centre_in_world.distance(centre) + ball.radius <= radius);
    let bounds = region.bounds.map(|b| (b.min - centre).abs().max((b.max - centre).abs()).length() <= radius);
    ball.into_iter().chain(bounds).reduce(|a, b| a || b)
}

fn cluster_answer(ranked: Ranked<Cluster>, manifest: &Manifest) -> ClusterAnswer {
    let Ranked { found: cluster, rank, relevance, distance } = ranked;
    let Extent { position_in_world, box_in_world } = cluster.extent;
    ClusterAnswer {
        rank,
        id: format!("{}-{}", cluster.first.0, cluster.first.1),
        position_in_world,
        geographic: manifest.geo_reference.map(|geo| geo.geographic_from_world(position_in_world)),
        box_min_in_world: box_in_world.min,
        box_max_in_world: box_in_world.max,
        size: box_in_world.size(),
        oriented_box: cluster.oriented_box,
        score: cluster.score,
        best_score: cluster.best_score,
        n_gaussians: cluster.n_gaussians,
        n_gaussians_in_scene: None,
        whole: None,
        evidence: None,
        relevance,
        distance,
        members: cluster.members,
    }
}

/// Describes an object. `score`: as reported.
pub(super) fn object_answer(
    scene: &Scene<'_>,
    ranked: Ranked<FoundObject<'_>>,
    score: f32,
    region: &Region,
    with_members: bool,
) -> ClusterAnswer {
    let Ranked { found, rank, relevance, distance } = ranked;
    let FoundObject { object, record, n_gaussians, cut, .. } = found;
    let manifest = scene.manifest;
    let Extent { position_in_world, box_in_world } = found.extent();
    let whole = cut.map(|_| {
        let (position_in_world, bounds) = (record.position(), record.bounds());
        Whole { position_in_world, box_min_in_world: bounds.min, box_max_in_world: bounds.max }
    });
    ClusterAnswer {
        rank,
        id: found.public_id(),
        position_in_world,
        geographic: manifest.geo_reference.map(|geo| geo.geographic_from_world(position_in_world)),
        box_min_in_world: box_in_world.min,
        box_max_in_world: box_in_world.max,
        size: box_in_world.size(),
        oriented_box: objects::oriented_box(scene, &found, region, alignment(manifest)),
        score,
        best_score: score,
        n_gaussians,
        n_gaussians_in_scene: Some(u64::from(record.n_gaussians)),
        whole,
        evidence: Some(Evidence {
            photo: objects::photo(scene, object).to_owned(),
            box_px: record.photo_box_px,
        }),
        relevance,
        distance,
        members: if with_members { objects::members(scene, object, region, score) } else { Vec::new() },
    }
}
