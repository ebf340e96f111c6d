//! From questions to ranked answers.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;

use super::answers::{Answers, ClusterAnswer, Clustering, Found, Relations, Reply, Searched, Whole};
use super::ask::Ask;
use super::cluster::{Cluster, Clusters, Grouping, cluster};
use super::engine::{Engine, OnBoard, QueryError};
use super::objects::{self, FoundObject, ScoredObjects};
use super::oriented::Extent;
use super::reason::{self, BestObject};
use super::relations::{self, CandidateOf, ClustersOfThing, Phrase, Things, Viewer};
use super::request::{AnswerKind, Asked, QueryRequest, RequestError, unit_vector};
use super::scale::{Scale, ScoreKind, ThresholdSource};
use super::scene::{Scene, alignment, default_voxel, unit};
use crate::score::{Budget, Hit, ObjectScores, Question, Region, Run, ScoreError, Search, score_objects};
use slag_common::manifest::{Calibration, Manifest};
use slag_models::question::asked_thing;

/// Memory for the candidates of a thing: 256 of 1 kB.
const CANDIDATES_BYTES: usize = 256 << 10;

impl Engine {
    /// Answers questions from the loaded generation. Blocks for milliseconds of computing, within the budget's time.
    pub fn ask(&self, ask: Ask, budget: &Budget) -> Result<Reply, QueryError> {
        let on_board = self.on_board()?;
        on_board.check()?;
        let request = ask.in_world(&on_board.snapshot.manifest)?;
        on_board.answer(request, budget)
    }
}

impl OnBoard {
    /// As [`Engine::ask`], for a request in the world frame.
    pub fn answer(&self, mut request: QueryRequest, budget: &Budget) -> Result<Reply, QueryError> {
        self.check()?;
        let snapshot = &self.snapshot;
        request.understand(snapshot)?;
        request.check()?;
        let negatives = self.encode_negatives(&request)?;
        let question =
            |vector: Arc<[f32]>| Question { negatives: negatives.clone(), ..Question::new(vector) };
        let scene = Scene::of(snapshot);
        let answering = Answering { scene: &scene, request: &request, budget };
        let mut all: Vec<Option<Answers>> = request.asked.iter().map(|_| None).collect();
        let (mut places, mut labels, mut plain) = (Vec::new(), Vec::new(), Vec::new());
        for (at, asked) in request.asked.iter().enumerate() {
            let vector = match asked {
                Asked::Text(text) => {
                    // As it is, where relations are not wanted.
                    if request.relations {
                        self.text.check_one(text)?;
                    }
                    self.encode(text)?
                }
                Asked::Vector { vector, .. } => vector_of(vector, snapshot.manifest.encoder.dim)?,
                Asked::Phrase { phrase, .. } => {
                    let things = phrase.things().into_iter();
                    // Every object is a thing, whatever its score.
                    let any: Arc<[f32]> =
                        (0..snapshot.manifest.encoder.dim).map(|at| f32::from(at == 0)).collect();
                    let questions = things.map(|thing| match relations::is_anything(thing) {
                        true => Ok(question(Arc::clone(&any))),
                        false => {
                            self.text.check_one(thing)?;
                            Ok(question(self.encode(thing)?))
                        }
                    });
                    let questions = questions.collect::<Result<Vec<_>, QueryError>>()?;
                    let of_thing = snapshot.objects.len() * size_of::<f32>() + CANDIDATES_BYTES;
                    budget.take(questions.len() * of_thing);
                    budget.check()?;
                    all[at] = Some(answering.related(asked.label(), phrase, &questions)?);
                    budget.check()?;
                    continue;
                }
            };
            places.push(at);
            labels.push(asked.label());
            plain.push(question(vector));
        }
        if !plain.is_empty() {
            let answers = answer(&scene, (labels.as_slice(), plain.as_slice()), &request, budget)?;
            places.into_iter().zip(answers).for_each(|(at, answers)| all[at] = Some(answers));
        }
        let mut answers: Vec<Answers> = all.into_iter().flatten().collect();
        for (answers, asked) in answers.iter_mut().zip(&request.asked) {
            answers.asked_as = self.asked_as(asked, &request);
        }
        Ok(Reply { request, answers, snapshot: Arc::clone(snapshot) })
    }

    /// Returns the texts that replace things and negatives with words unknown to the model.
    fn asked_as(&self, asked: &Asked, request: &QueryRequest) -> BTreeMap<String, String> {
        let things: Vec<String> = match asked {
            Asked::Text(text) => vec![asked_thing(text).unwrap_or_else(|| text.clone())],
            Asked::Phrase { phrase, .. } => phrase.things().into_iter().map(str::to_owned).collect(),
            Asked::Vector { .. } => Vec::new(),
        };
        let negatives = request.negatives.0.iter().cloned();
        let asked_as = |thing: String| self.text.asked_as(&thing).map(|asked| (thing, asked));
        things.into_iter().chain(negatives).filter_map(asked_as).collect()
    }
}

/// Returns the vector of a vector question, at unit length.
fn vector_of(vector: &[f32], dim: u32) -> Result<Arc<[f32]>, QueryError> {
    if vector.len() != dim as usize {
        let found = format!("{} components", vector.len());
        let expected = format!("{dim}, as the scene's embeddings have");
        return Err(RequestError::new("vectors", &found, expected).into());
    }
    Ok(unit_vector(vector).unwrap_or_default().into())
}

/// Names of the questions, and their vectors, each with its negatives.
type Questions<'a> = (&'a [&'a str], &'a [Question]);

/// Answers a checked request about a scene: one answer for each question, in their order. Without a kind, a question
/// that no object answers is answered by clusters.
///
/// The result depends neither on the number of threads nor on the other questions.
/// # Errors
/// [`ScoreError`]; one is a request that needs more than its budget.
pub fn answer(
    scene: &Scene<'_>,
    questions: Questions<'_>,
    request: &QueryRequest,
    budget: &Budget,
) -> Result<Vec<Answers>, ScoreError> {
    let mut answers = Answering { scene, request, budget }.found(questions)?;
    for Answers { reason, coverage, .. } in &mut answers {
        if let Some(reason) = reason {
            reason::complete(reason, &scene.shards, &request.region, coverage);
        }
    }
    Ok(answers)
}

/// A request, its scene and its budget.
struct Answering<'a> {
    scene: &'a Scene<'a>,
    request: &'a QueryRequest,
    budget: &'a Budget,
}

impl Answering<'_> {
    fn found(&self, asked: Questions<'_>) -> Result<Vec<Answers>, ScoreError> {
        match self.request.kind {
            Some(AnswerKind::Objects) => return self.by_objects(asked),
            Some(kind) => return self.by_gaussians(asked, kind),
            None if self.scene.index.is_empty() => return self.by_gaussians(asked, AnswerKind::Clusters),
            None => {}
        }
        let mut answers = self.by_objects(asked)?;
        let is_open = |at: &usize| answers[*at].answers.is_empty();
        let open: Vec<usize> = (0..answers.len()).filter(is_open).collect();
        if open.is_empty() {
            return Ok(answers);
        }
        // Ground is no object; nor is a thing that few photos outline.
        let (labels, questions): (Vec<&str>, Vec<Question>) =
            open.iter().map(|at| (asked.0[*at], asked.1[*at].clone())).unzip();
        let clusters = self.by_gaussians((&labels, &questions), AnswerKind::Clusters)?;
        for (at, clusters) in open.into_iter().zip(clusters) {
            match (&mut answers[at].reason, &clusters.reason) {
                // Neither answers: report both reasons.
                (Some(of_objects), Some(of_clusters)) => {
                    let detail = format!("{}; {}", of_objects.detail, of_clusters.detail);
                    // Where there is no object, Gaussians have the nearest miss.
                    if of_objects.best_score.is_none() {
                        of_objects.clone_from(of_clusters);
                    }
                    of_objects.detail = detail;
                }
                _ => answers[at] = clusters,
            }
        }
        Ok(answers)
    }

    fn by_objects(&self, asked: Questions<'_>) -> Result<Vec<Answers>, ScoreError> {
        let Scene { shards, objects, index, .. } = self.scene;
        let questions = self.bounded(asked.1, objects::calibration(objects));
        let asked = (asked.0, &*questions);
        let scored = score_objects(shards, objects, index, asked.1)?;
        self.each(asked, &scored, |text, question, scored| self.objects(text, question, scored))
    }

    fn by_gaussians(&self, asked: Questions<'_>, kind: AnswerKind) -> Result<Vec<Answers>, ScoreError> {
        let (region, precision) = (&self.request.region, self.request.precision);
        let questions = self.bounded(asked.1, self.scene.manifest.encoder.calibration);
        let asked = (asked.0, &*questions);
        let searches = Search::batch(&self.scene.shards, asked.1, region, precision, self.budget)?;
        self.each(asked, &searches, |text, question, search| self.gaussians((text, kind), question, search))
    }

    /// Sets the least score of negatives to the threshold without them, unless the request has a threshold of its own.
    fn bounded(&self, questions: &[Question], calibration: Option<Calibration>) -> Vec<Question> {
        let (request, manifest) = (self.request, self.scene.manifest);
        let plain = Scale(ScoreKind::Cosine).threshold(request, manifest, calibration).0;
        let least = if request.threshold.is_some() { f32::NEG_INFINITY } else { plain };
        questions.iter().map(|question| Question { least, ..question.clone() }).collect()
    }

    /// Answers each question from its scores; only the bytes of its answers stay charged.
    fn each<S>(
        &self,
        (labels, questions): Questions<'_>,
        scored: &[S],
        answer: impl Fn(&str, &Question, &S) -> Answers,
    ) -> Result<Vec<Answers>, ScoreError> {
        let charged = |((text, question), scored)| {
            let used_bytes = self.budget.used_bytes();
            let answers = answer(text, question, scored);
            self.budget.check()?;
            self.budget.give_back_to(used_bytes, answers.answers.len_bytes());
            Ok(answers)
        };
        labels.iter().copied().zip(questions).zip(scored).map(charged).collect()
    }

    /// Answers a question with the objects that match; no centroid is scored.
    fn objects(&self, text: &str, question: &Question, scored: &ObjectScores) -> Answers {
        let Self { scene, request, budget } = self;
        let (manifest, scale, region) = (scene.manifest, Scale::of(question), &request.region);
        let calibration = objects::calibration(&scene.objects);
        let threshold = scale.threshold(request, manifest, calibration);
        let of_score = scale.to_score(threshold.0);
        let objects = ScoredObjects { scene, scores: &scored.scores, region, min_count: request.min_count };
        let found = objects.reaching(of_score);
        let n_matching = found.iter().map(|object| object.n_gaussians).sum();
        let key = |object: &FoundObject<'_>| (scale.shown(object.score), object.extent().position_in_world);
        let order = Order::new(scale.base(calibration), manifest, request);
        let ranked = order.rank(found, key);
        // Members: at most one run per Gaussian; the box needs their positions.
        let of_gaussian = size_of::<DVec3>() + if request.members { size_of::<Run>() } else { 0 };
        let described = ranked.into_par_iter().filter_map(|ranked| {
            let bytes = ranked.found.n_gaussians as usize * of_gaussian + size_of::<ClusterAnswer>();
            let score = scale.shown(ranked.found.score);
            budget.take(bytes).then(|| object_answer(scene, ranked, score, region, request.members))
        });
        let found = Found::Clusters(described.collect());
        let empty = self.empty((text, AnswerKind::Objects), scale, threshold);
        let reason = || {
            let best = ScoredObjects { min_count: 1, ..objects }.best().map(|best| BestObject {
                score: scale.shown(best.score),
                reaches: best.score >= of_score,
                position_in_world: best.extent().position_in_world,
            });
            reason::of_objects(scene, request, threshold.0, best)
        };
        Answers {
            searched: Searched {
                n_searched: n_with_evidence(scene, region),
                n_matching,
                score_error_bound: scale.error_bound(scored.error_bound),
                ..empty.searched
            },
            reason: found.is_empty().then(reason),
            answers: found,
            ..empty
        }
    }

    fn gaussians(&self, asked: (&str, AnswerKind), question: &Question, search: &Search<'_>) -> Answers {
        let (manifest, scale) = (self.scene.manifest, Scale::of(question));
        let (threshold, source) = scale.threshold(self.request, manifest, manifest.encoder.calibration);
        let (found, n_matching, clustering) = match asked.1 {
            AnswerKind::Gaussians => {
                let (hits, n_matching) = self.hits(search, scale, scale.to_score(threshold));
                (Found::Gaussians(hits), n_matching, None)
            }
            _ => self.clusters(search, scale, threshold),
        };
        // Exact shards: Gaussians are listed with their own scores, clusters with their centroids'.
        let score_error_bound = scale.error_bound(match (search.is_exact(), asked.1) {
            (true, AnswerKind::Gaussians) => question.rounding_bound(),
            _ => search.score_error_bound(),
        });
        // With negatives a score is the difference of two products.
        let n_products = if question.negatives.is_empty() { 1.0 } else { 2.0 };
        let likely = search.likely_error();
        let empty = self.empty(asked, scale, (threshold, source));
        let reason = || reason::of_gaussians(search, scale, self.request, threshold, n_matching);
        Answers {
            searched: Searched {
                n_searched: search.searched().map(|shard| shard.n_with_evidence() as u64).sum(),
                n_matching,
                is_exact: search.is_exact(),
                score_error_bound,
                score_error_likely: likely.map(|likely| scale.error_bound(n_products * likely)),
                clustering,
                ..empty.searched
            },
            reason: found.is_empty().then(reason),
            answers: found,
            ..empty
        }
    }

    /// Returns the Gaussians that match best, and how many match.
    fn hits(&self, search: &Search<'_>, scale: Scale, score_threshold: f32) -> (Vec<Hit>, u64) {
        let limit = self.request.n_ranked();
        let n_searched: usize = search.searched().map(|shard| shard.n_with_evidence()).sum();
        self.budget.take(limit.min(n_searched) * size_of::<Hit>());
        let mut hits = search.best(limit, score_threshold, self.request.near);
        let is_whole = hits.len() < limit;
        let n_matching =
            if is_whole { hits.len() as u64 } else { search.matching(score_threshold).n_gaussians };
        hits.iter_mut().for_each(|hit| hit.score = scale.shown(hit.score));
        (hits, n_matching)
    }

    /// Returns the best clusters of the Gaussians that match, how many match, and how they were clustered.
    fn clusters(
        &self,
        search: &Search<'_>,
        scale: Scale,
        threshold: f32,
    ) -> (Found, u64, Option<Clustering>) {
        let (request, manifest) = (self.request, self.scene.manifest);
        let (grouped, n_matching) = self.grouped(search, scale, threshold);
        let clustering = Clustering {
            voxel: grouped.voxel,
            min_count: request.min_count,
            n_clusters: grouped.clusters.len() as u64,
            n_small_clusters: grouped.n_small,
            n_gaussians_in_small_clusters: grouped.n_gaussians_in_small,
        };
        let key = |of: &Cluster| (of.score, of.extent.position_in_world);
        let order = Order::new(scale.base(manifest.encoder.calibration), manifest, request);
        let ranked = order.rank(grouped.clusters, key);
        let answers = ranked.into_iter().map(|ranked| cluster_answer(ranked, manifest)).collect();
        (Found::Clusters(answers), n_matching, Some(clustering))
    }

    /// Returns the clusters of the Gaussians that match, and how many match.
    fn grouped(&self, search: &Search<'_>, scale: Scale, threshold: f32) -> (Clusters, u64) {
        let (scene, request, manifest) = (self.scene, self.request, self.scene.manifest);
        let mut matches = search.matching(scale.to_score(threshold));
        matches.runs.iter_mut().for_each(|run| run.score = scale.shown(run.score));
        let voxel = request.voxel.unwrap_or_else(|| default_voxel(manifest));
        let (min_count, alignment, with_members) = (request.min_count, alignment(manifest), request.members);
        let grouping = Grouping { voxel, min_count, threshold, alignment, with_members };
        (cluster(&scene.shards, &matches.runs, &grouping, self.budget), matches.n_gaussians)
    }

    /// Returns the clusters of things anywhere on board, for the parts of a phrase that no object answers.
    fn clusters_of_things(&self, questions: &[Question]) -> Result<Vec<ClustersOfThing>, ScoreError> {
        let Scene { manifest, shards, .. } = self.scene;
        let (everywhere, precision) = (Region::default(), self.request.precision);
        let questions = &*self.bounded(questions, manifest.encoder.calibration);
        let searches = Search::batch(shards, questions, &everywhere, precision, self.budget)?;
        let of_thing = |(question, search): (&Question, &Search<'_>)| {
            let (scale, calibration) = (Scale::of(question), manifest.encoder.calibration);
            let (threshold, _) = scale.threshold(self.request, manifest, calibration);
            let (grouped, _) = self.grouped(search, scale, threshold);
            self.budget.check()?;
            Ok(ClustersOfThing { clusters: grouped.clusters, threshold, base: scale.base(calibration) })
        };
        questions.iter().zip(&searches).map(of_thing).collect()
    }

    /// Answers a phrase. `questions`: its things, in their order.
    fn related(&self, label: &str, phrase: &Phrase, questions: &[Question]) -> Result<Answers, QueryError> {
        let Self { scene, request, .. } = *self;
        let has_up = scene.manifest.metric || scene.manifest.geo_reference.is_some();
        if !has_up && needs_up(phrase) {
            let expected = "near, in or between, as this scene's up is not known; where its world has z up and \
                            metres, encode it with --metric";
            return Err(RequestError::new("phrases", &phrase.thing, expected).into());
        }
        let bounded = self.bounded(questions, objects::calibration(&scene.objects));
        let scored = score_objects(&scene.shards, &scene.objects, scene.index, &bounded)?;
        let mut things = Things::find(scene, &phrase.things(), questions, &scored, request);
        let open = if request.kind == Some(AnswerKind::Objects) { Vec::new() } else { things.open() };
        if !open.is_empty() {
            let of_open: Vec<Question> = open.iter().map(|at| questions[*at].clone()).collect();
            for (at, found) in open.into_iter().zip(self.clusters_of_things(&of_open)?) {
                things.set_clusters(at, found, scene, &request.region);
            }
        }
        let parts = things.found();
        let viewer = request
            .near
            .map(|position_in_world| Viewer { position_in_world, heading_rad: request.heading_rad });
        let related = relations::relate(&things, phrase, viewer.as_ref(), relations::metre(scene.manifest));
        let scale = Scale::of(&questions[0]);
        let threshold = scale.threshold(request, scene.manifest, objects::calibration(&scene.objects));
        let mut answers = self.empty((label, AnswerKind::Objects), scale, threshold);
        let mut to = Vec::new();
        match related {
            Ok(found) => {
                let of = things.of(&phrase.thing);
                let described = found.into_iter().take(request.n_ranked()).zip(1..).map(|(related, rank)| {
                    let candidate = &of[related.candidate];
                    let relevance = related.score as f32;
                    let distance = request.near.map(|near| near.distance(candidate.position_in_world()));
                    to.push((related.degree, related.to));
                    match candidate.of.clone() {
                        CandidateOf::Object(found) => {
                            let ranked = Ranked { found, rank, relevance, distance };
                            object_answer(scene, ranked, candidate.score, &Region::default(), request.members)
                        }
                        CandidateOf::Cluster(found) => {
                            cluster_answer(Ranked { found, rank, relevance, distance }, scene.manifest)
                        }
                    }
                });
                let described: Vec<ClusterAnswer> = described.collect();
                answers.searched.n_matching = described.iter().map(|answer| answer.n_gaussians).sum();
                answers.answers = Found::Clusters(described);
            }
            Err(mut miss) => {
                let part = parts.iter().find(|part| Some(&*part.thing) == miss.thing.as_deref());
                miss.best_score = part.and_then(|part| part.best_score);
                reason::complete(&mut miss, &scene.shards, &request.region, &answers.coverage);
                answers.reason = Some(miss);
            }
        }
        answers.searched.n_searched = n_with_evidence(scene, &request.region);
        answers.related = Some(Relations { parts, to });
        Ok(answers)
    }

    fn empty(&self, asked: (&str, AnswerKind), scale: Scale, threshold: (f32, ThresholdSource)) -> Answers {
        let (manifest, request) = (self.scene.manifest, self.request);
        let searched = Searched {
            negatives: request.negatives.0.clone(),
            score_kind: scale.0,
            threshold: threshold.0,
            threshold_source: threshold.1,
            n_searched: 0,
            n_matching: 0,
            is_exact: false,
            score_error_bound: 0.0,
            score_error_likely: None,
            clustering: None,
        };
        Answers {
            text: asked.0.to_owned(),
            kind: asked.1,
            scene: manifest.scene.clone(),
            generation: manifest.generation,
            unit: unit(manifest),
            searched,
            coverage: self.scene.coverage(&request.region),
            asked_as: BTreeMap::new(),
            reason: None,
            answers: Found::Clusters(Vec::new()),
            related: None,
        }
    }
}

fn needs_up(phrase: &Phrase) -> bool {
    phrase.relation.as_ref().is_some_and(|place| place.is.needs_up()) || phrase.inner().any(needs_up)
}

/// Returns the number of Gaussians with evidence in the shards that a region touches.
fn n_with_evidence(scene: &Scene<'_>, region: &Region) -> u64 {
    let shards = scene.shards.iter().filter(|shard| region.touches(&shard.position_box()));
    shards.map(|shard| shard.n_with_evidence() as u64).sum()
}

fn cluster_answer(ranked: Ranked<Cluster>, manifest: &Manifest) -> ClusterAnswer {
    let Ranked { found: cluster, rank, relevance, distance } = ranked;
    let Extent { position_in_world, box_in_world } = cluster.extent;
    ClusterAnswer {
        rank,
        id: cluster.public_id(),
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

/// Describes an object as the cluster of its Gaussians in a region.
fn object_answer(
    scene: &Scene<'_>,
    ranked: Ranked<FoundObject<'_>>,
    score: f32,
    region: &Region,
    with_members: bool,
) -> ClusterAnswer {
    let Ranked { found, rank, relevance, distance } = ranked;
    let FoundObject { object, record, n_gaussians, cut, .. } = found;
    let cluster = Cluster {
        first: (0, 0),
        n_gaussians,
        score,
        best_score: score,
        extent: found.extent(),
        oriented_box: objects::oriented_box(scene, &found, region, alignment(scene.manifest)),
        members: if with_members { objects::members(scene, object, region, score) } else { Vec::new() },
    };
    let whole = cut.map(|_| {
        let (position_in_world, bounds) = (record.position(), record.bounds());
        Whole { position_in_world, box_min_in_world: bounds.min, box_max_in_world: bounds.max }
    });
    ClusterAnswer {
        id: found.public_id(),
        n_gaussians_in_scene: Some(u64::from(record.n_gaussians)),
        whole,
        evidence: Some(objects::evidence(scene, object)),
        ..cluster_answer(Ranked { found: cluster, rank, relevance, distance }, scene.manifest)
    }
}

/// Distance, in default voxels, at which an answer's relevance is halved (10 m in a metric scene).
const VOXELS_TO_HALF_RELEVANCE: f64 = 40.0;

struct Order {
    /// The score of an unrelated thing.
    base: f32,
    half: f64,
    near: Option<DVec3>,
    limit: usize,
}

struct Ranked<T> {
    found: T,
    rank: usize,
    relevance: f32,
    distance: Option<f64>,
}

impl Order {
    fn new(base: f32, manifest: &Manifest, request: &QueryRequest) -> Self {
        let half = VOXELS_TO_HALF_RELEVANCE * default_voxel(manifest);
        Self { base, half, near: request.near, limit: request.n_ranked() }
    }

    /// Ranks answers, ties in their given order, and keeps as many as asked for. `key`: reported score and position.
    ///
    /// The ranking key, `(score - base) / (1 + distance / half)`, and 0 below `base`, depends neither on the threshold,
    /// which only filters, nor on another parameter. It is rounded to f32 to hide the last bits of a machine's division.
    fn rank<T>(&self, found: Vec<T>, key: impl Fn(&T) -> (f32, DVec3)) -> Vec<Ranked<T>> {
        let weighed = found.into_iter().map(|found| {
            let (score, position_in_world) = key(&found);
            let distance = self.near.map(|near| near.distance(position_in_world));
            let margin = (f64::from(score) - f64::from(self.base)).max(0.0);
            let relevance = (margin / (1.0 + distance.unwrap_or(0.0) / self.half)) as f32;
            (score, Ranked { found, rank: 0, relevance, distance })
        });
        let mut ranked: Vec<(f32, Ranked<T>)> = weighed.collect();
        ranked.sort_by(|(score, ranked), (other_score, other)| {
            let nearer = || ranked.distance.unwrap_or(0.0).total_cmp(&other.distance.unwrap_or(0.0));
            let by_relevance = other.relevance.total_cmp(&ranked.relevance);
            by_relevance.then(other_score.total_cmp(score)).then_with(nearer)
        });
        ranked.truncate(self.limit);
        ranked.into_iter().zip(1..).map(|((_, ranked), rank)| Ranked { rank, ..ranked }).collect()
    }
}
