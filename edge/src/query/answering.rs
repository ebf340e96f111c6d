//! From questions to their answers.

use std::collections::BTreeMap;
use std::sync::Arc;

use slag_service::params::RequestError;

use super::answer::{Answering, answer, cluster_answer, object_answer};
use super::ask::Ask;
use super::coverage::coverage;
use super::engine::{Engine, OnBoard, QueryError};
use super::rank::Ranked;
use super::reason;
use super::relations::{self, CandidateOf, Phrase, Things, Viewer};
use super::reply::{Outcome, RelatedAnswers, Reply};
use super::request::{AnswerKind, Asked, QueryRequest, unit_vector};
use super::scene::Scene;
use crate::score::{Budget, Question, Region, ScoreError, Scratch, score_objects};

/// Memory for the candidates of a thing: 256 of 1 kB.
const CANDIDATES_BYTES: usize = 256 << 10;

impl Engine {
    /// Answers questions from the loaded generation. Blocks for milliseconds of computing, within the budget's time.
    pub fn ask(&self, ask: Ask, budget: &Budget) -> Result<Reply, QueryError> {
        let on_board = self.on_board()?;
        on_board.check()?;
        let request = ask.understand(&on_board.snapshot)?;
        self.answer_on(&on_board, request, budget)
    }

    /// As [`Engine::ask`], from a generation that may already be replaced, and with the Gaussians of each answer.
    pub(crate) fn ask_for_members(
        &self,
        on_board: &OnBoard,
        ask: Ask,
        budget: &Budget,
    ) -> Result<Reply, QueryError> {
        on_board.check()?;
        let request = ask.understand(&on_board.snapshot)?;
        self.answer_on(on_board, QueryRequest { members: true, ..request }, budget)
    }

    /// As [`Engine::ask`], for a request already in the world frame.
    pub fn answer(&self, mut request: QueryRequest, budget: &Budget) -> Result<Reply, QueryError> {
        let on_board = self.on_board()?;
        on_board.check()?;
        request.understand(&on_board.snapshot)?;
        request.check()?;
        self.answer_on(&on_board, request, budget)
    }

    fn answer_on(
        &self,
        on_board: &OnBoard,
        request: QueryRequest,
        budget: &Budget,
    ) -> Result<Reply, QueryError> {
        let snapshot = &on_board.snapshot;
        let negatives = on_board.encode_negatives(&request)?;
        let question = |vector: Arc<[f32]>| Question { vector, negatives: negatives.clone() };
        let mut outcomes: Vec<Option<Outcome>> = request.asked.iter().map(|_| None).collect();
        let (mut places, mut labels, mut plain) = (Vec::new(), Vec::new(), Vec::new());
        for (at, asked) in request.asked.iter().enumerate() {
            let vector = match asked {
                Asked::Text(text) => on_board.encode(text)?,
                Asked::Vector { vector, .. } => vector_of(vector, snapshot.manifest.encoder.dim)?,
                Asked::Phrase { phrase, .. } => {
                    let things = phrase.things();
                    let questions = things.into_iter().map(|thing| Ok(question(on_board.encode(thing)?)));
                    let questions = questions.collect::<Result<Vec<_>, QueryError>>()?;
                    let outcome =
                        self.relate(on_board, asked.label(), phrase, &questions, &request, budget)?;
                    outcomes[at] = Some(outcome);
                    continue;
                }
            };
            places.push(at);
            labels.push(asked.label());
            plain.push(question(vector));
        }
        if !plain.is_empty() {
            let work = |scratch: &mut Scratch, scene: &Scene<'_>| {
                answer(scratch, scene, (labels.as_slice(), plain.as_slice()), &request)
            };
            for (at, answers) in places.into_iter().zip(self.on_scene(snapshot, budget, work)?) {
                outcomes[at] = Some(Outcome::Plain(answers));
            }
        }
        for (outcome, asked) in outcomes.iter_mut().flatten().zip(&request.asked) {
            outcome.set_asked_as(asked_as(on_board, asked, &request));
        }
        let outcomes = outcomes.into_iter().flatten().collect();
        Ok(Reply { request, outcomes, snapshot: Arc::clone(snapshot) })
    }

    /// Answers a phrase. `questions`: its things, in their order.
    fn relate(
        &self,
        on_board: &OnBoard,
        label: &str,
        phrase: &Phrase,
        questions: &[Question],
        request: &QueryRequest,
        budget: &Budget,
    ) -> Result<Outcome, QueryError> {
        let snapshot = &on_board.snapshot;
        budget.take(questions.len() * (snapshot.objects.len() * size_of::<f32>() + CANDIDATES_BYTES));
        budget.check().map_err(ScoreError::from)?;
        let outcome = self.on_scene(snapshot, budget, |scratch, scene| {
            let answering = Answering { scene, request, budget: budget.clone() };
            let related = related(scratch, &answering, phrase, questions)?;
            Ok::<_, QueryError>(match request.paged {
                true => Outcome::Related(related),
                false => Outcome::Plain(answering.of_related(label, related, &questions[0])),
            })
        })?;
        budget.check().map_err(ScoreError::from)?;
        Ok(outcome)
    }
}

/// Returns the texts that replace things and negatives with words unknown to the model.
fn asked_as(on_board: &OnBoard, asked: &Asked, request: &QueryRequest) -> BTreeMap<String, String> {
    let things: Vec<String> = match asked {
        Asked::Text(text) => vec![relations::asked_thing(text).unwrap_or_else(|| text.clone())],
        Asked::Phrase { phrase, .. } => phrase.things().into_iter().map(str::to_owned).collect(),
        Asked::Vector { .. } => Vec::new(),
    };
    let negatives = request.negatives.0.iter().cloned();
    let asked_as = |thing: String| on_board.text.asked_as(&thing).map(|asked| (thing, asked));
    things.into_iter().chain(negatives).filter_map(asked_as).collect()
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

fn related(
    scratch: &mut Scratch,
    answering: &Answering<'_>,
    phrase: &Phrase,
    questions: &[Question],
) -> Result<RelatedAnswers, QueryError> {
    let Answering { scene, request, .. } = *answering;
    let has_up = scene.manifest.metric || scene.manifest.geo_reference.is_some();
    if !has_up && needs_up(phrase) {
        let expected = "near, in or between, as this scene's up is not known; where its world has z up and metres, \
                        encode it with --metric";
        return Err(RequestError::new("phrases", &phrase.thing, expected).into());
    }
    let scored = score_objects(scene.shards, scene.objects, scene.index, questions)?;
    let mut things = Things::find(scene, &phrase.things(), questions, &scored, request);
    let open = if request.kind == Some(AnswerKind::Objects) { Vec::new() } else { things.open() };
    if !open.is_empty() {
        let of_open: Vec<Question> = open.iter().map(|at| questions[*at].clone()).collect();
        for (at, found) in open.into_iter().zip(answering.clusters_of_things(scratch, &of_open)?) {
            things.set_clusters(at, found, scene, &request.region);
        }
    }
    let metre = relations::metre(scene.manifest);
    let parts = things.found();
    let coverage = coverage(scene.manifest, scene.bad_cells, scene.fetched, &request.region);
    let viewer =
        request.near.map(|position_in_world| Viewer { position_in_world, heading_rad: request.heading_rad });
    let found = match relations::relate(&things, phrase, viewer.as_ref(), metre) {
        Ok(found) => found,
        Err(mut miss) => {
            let part = parts.iter().find(|part| Some(&*part.thing) == miss.thing.as_deref());
            miss.best_score = part.and_then(|part| part.best_score);
            reason::complete(&mut miss, scene.shards, &request.region, &coverage);
            let (asked_as, answers) = Default::default();
            return Ok(RelatedAnswers { asked_as, parts, coverage, miss: Some(miss), answers });
        }
    };
    let of = things.of(&phrase.thing);
    let described = found.into_iter().take(request.n_ranked()).enumerate().map(|(at, related)| {
        let candidate = &of[related.candidate];
        let (rank, relevance) = (at + 1, related.score as f32);
        let distance = request.near.map(|near| near.distance(candidate.position_in_world()));
        let answer = match candidate.of.clone() {
            CandidateOf::Object(found) => {
                let ranked = Ranked { found, rank, relevance, distance };
                object_answer(scene, ranked, candidate.score, &Region::default(), request.members)
            }
            CandidateOf::Cluster(found) => {
                cluster_answer(Ranked { found, rank, relevance, distance }, scene.manifest)
            }
        };
        (answer, related.degree, related.to)
    });
    let (asked_as, miss, answers) = (BTreeMap::new(), None, described.collect());
    Ok(RelatedAnswers { asked_as, parts, coverage, miss, answers })
}

fn needs_up(phrase: &Phrase) -> bool {
    phrase.relation.as_ref().is_some_and(|place| place.is.needs_up()) || phrase.inner().any(needs_up)
}
