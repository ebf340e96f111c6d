//! Several questions at once, of different sorts: texts, vectors, and phrases about relations.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::answer::{answer, object_answer};
use super::answers::{Answers, ClusterAnswer};
use super::area::Area;
use super::engine::{Engine, QueryError};
use super::point::Point;
use super::rank::Ranked;
use super::relations::{self, Found, Miss, Phrase, Scale, Things, Viewer, Witness};
use super::reply::Reply;
use super::request::{AnswerKind, DEFAULT_LIMIT, MAX_CLUSTERS, QueryRequest, RequestError};
use super::scene::Scene;
use crate::score::{Budget, Question, Region, Scratch, score_objects};
use std::sync::Arc;

/// Most answers in a page, over all questions.
pub const MAX_PAGE: usize = MAX_CLUSTERS;

/// Memory for the candidates of a thing: 256 of a kilobyte.
const CANDIDATES_BYTES: usize = 256 << 10;

/// What is looked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Asked {
    /// A text, for the text model.
    Text(String),
    /// A vector of the scene's embedding space; its length does not count.
    Vector(Vec<f32>),
    /// Things by their relations.
    Phrase(Phrase),
}

/// Several questions that share everything but what is looked for.
#[derive(Clone, Debug, PartialEq)]
pub struct Ask {
    /// What is looked for.
    pub asked: Vec<Asked>,
    /// Everything else; its texts and its area count for nothing. Its limit is that of a page.
    pub request: QueryRequest,
    pub area: Area,
    /// The asker's position; answers carry their distance from it, and nearer ones rank higher.
    pub near: Option<Point>,
    /// The asker's heading, from x towards y, radians.
    pub heading_rad: Option<f64>,
    /// Answers to each question that are left out, best first.
    pub offset: usize,
}

/// The answers to one question.
pub enum Outcome {
    /// To a text or a vector.
    Plain(Answers),
    Related(RelatedAnswers),
}

pub struct RelatedAnswers {
    /// What was found for each thing of the phrase.
    pub parts: Vec<Found>,
    /// The part that failed, if nothing was found.
    pub miss: Option<Miss>,
    /// The answers, best first, each with its degree and what it is related to.
    pub answers: Vec<(ClusterAnswer, f64, Vec<Witness>)>,
}

/// The answers to several questions.
pub struct AskReply {
    /// The generation that answers, with the asker's position.
    pub reply: Reply,
    /// One for each question, in their order. One more answer than a page has means that there are more.
    pub outcomes: Vec<Outcome>,
}

impl Ask {
    pub fn page(&self) -> usize {
        self.request.limit.unwrap_or(DEFAULT_LIMIT)
    }

    /// Checks every limit that does not depend on the scene.
    fn check(&self, dim: usize) -> Result<(), RequestError> {
        let refuse = |parameter: &str, found: String, expected: String| {
            Err(RequestError::new(parameter, &found, expected))
        };
        let most = MAX_PAGE / self.asked.len().max(1);
        if !(1..=most).contains(&self.page()) {
            return refuse(
                "limit",
                self.page().to_string(),
                format!("1 to {most} answers, as there are {} questions", self.asked.len()),
            );
        }
        if let Some(heading) = self.heading_rad.filter(|heading| !heading.is_finite()) {
            return refuse("heading_rad", heading.to_string(), "a number".into());
        }
        for asked in &self.asked {
            match asked {
                Asked::Text(_) => {}
                Asked::Vector(vector) => {
                    if vector.len() != dim {
                        let found = format!("{} components", vector.len());
                        return refuse("vectors", found, format!("{dim}, as the scene's embeddings have"));
                    }
                    if unit(vector).is_none() {
                        let expected = "finite numbers that are not all 0".into();
                        return refuse("vectors", "a vector without a direction".into(), expected);
                    }
                }
                Asked::Phrase(phrase) => {
                    phrase.check()?;
                    if !matches!(self.request.kind, None | Some(AnswerKind::Objects)) {
                        let found = self.request.kind.unwrap_or_default().to_string();
                        return refuse("kind", found, "objects, since relations are between objects".into());
                    }
                    let [needs_position, needs_heading] = phrase.needs();
                    if needs_position && self.near.is_none() {
                        let expected = "where the asker is, since the phrase depends on it".into();
                        return refuse("near", "nothing".into(), expected);
                    }
                    if needs_heading && self.heading_rad.is_none() {
                        let expected = "where the asker looks, since the phrase depends on it".into();
                        return refuse("heading_rad", "nothing".into(), expected);
                    }
                }
            }
        }
        Ok(())
    }
}

impl Engine {
    /// Answers several questions from the loaded generation. Blocks for milliseconds of computing, at most as long
    /// as the budget says.
    pub fn ask(&self, ask: &Ask, budget: &Budget) -> Result<AskReply, QueryError> {
        let on_board = self.on_board()?;
        on_board.check()?;
        let snapshot = &on_board.snapshot;
        let manifest = &snapshot.manifest;
        let mut request = QueryRequest { near: None, bounds: None, ..ask.request.clone() };
        request.texts = ask.asked.iter().map(label).collect();
        ask.area.restrict(&mut request, manifest)?;
        request.near = ask.near.map(|near| near.in_world("near", manifest)).transpose()?;
        ask.check(manifest.encoder.dim as usize)?;
        request.limit = Some(ask.offset.saturating_add(ask.page()));
        request.check()?;
        // One more than the page, so that the reply can say whether there are others.
        request.limit = request.limit.map(|limit| limit + 1);
        let negatives = on_board.encode_negatives(&request)?;
        let question = |vector: Arc<[f32]>| Question { vector, negatives: negatives.clone() };
        let viewer =
            request.near.map(|position_in_world| Viewer { position_in_world, heading_rad: ask.heading_rad });
        let mut outcomes: Vec<Option<Outcome>> = ask.asked.iter().map(|_| None).collect();
        let (mut plain, mut places) = (Vec::new(), Vec::new());
        for (at, asked) in ask.asked.iter().enumerate() {
            let vector = match asked {
                Asked::Text(text) => on_board.encode(text)?,
                Asked::Vector(vector) => unit(vector).unwrap_or_default().into(),
                Asked::Phrase(phrase) => {
                    let things = phrase.things();
                    let questions = things.iter().map(|thing| Ok(question(on_board.encode(thing)?)));
                    let questions = questions.collect::<Result<Vec<_>, QueryError>>()?;
                    let scores = snapshot.objects.len() * size_of::<f32>();
                    budget.take(things.len() * (scores + CANDIDATES_BYTES));
                    budget.check().map_err(crate::score::ScoreError::from)?;
                    let related = self.on_scene(snapshot, budget, |_, scene| {
                        related(scene, phrase, &questions, viewer.as_ref(), &request)
                    })?;
                    budget.check().map_err(crate::score::ScoreError::from)?;
                    outcomes[at] = Some(Outcome::Related(related));
                    continue;
                }
            };
            plain.push(question(vector));
            places.push(at);
        }
        if !plain.is_empty() {
            let texts = places.iter().map(|at| request.texts[*at].clone()).collect();
            let request = QueryRequest { texts, ..request.clone() };
            let work = |scratch: &mut Scratch, scene: &Scene<'_>| answer(scratch, scene, &plain, &request);
            let answers = self.on_scene(snapshot, budget, work)?;
            for (at, answers) in places.into_iter().zip(answers) {
                outcomes[at] = Some(Outcome::Plain(answers));
            }
        }
        let reply = Reply { near: request.near, answers: Vec::new(), snapshot: on_board.snapshot };
        Ok(AskReply { reply, outcomes: outcomes.into_iter().flatten().collect() })
    }
}

impl Outcome {
    /// Returns the number of answers.
    pub fn len(&self) -> usize {
        match self {
            Self::Plain(answers) => answers.answers.len(),
            Self::Related(related) => related.answers.len(),
        }
    }

    /// Returns whether there is no answer.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

fn related(
    scene: &Scene<'_>,
    phrase: &Phrase,
    questions: &[Question],
    viewer: Option<&Viewer>,
    request: &QueryRequest,
) -> Result<RelatedAnswers, QueryError> {
    let has_up = scene.manifest.metric || scene.manifest.geo_reference.is_some();
    if !has_up && needs_up(phrase) {
        let expected =
            "a relation that does not depend on up (near, in, between): this scene's up is not known";
        return Err(RequestError::new("phrases", &phrase.thing, expected).into());
    }
    let scored = score_objects(scene.shards, scene.objects, scene.index, questions)?;
    let things = Things::find(scene, &phrase.things(), questions, &scored, request);
    let metre = relations::metre(scene.manifest);
    let parts = things.found();
    let found = match relations::relate(&things, phrase, viewer, Scale { metre }) {
        Ok(found) => found,
        Err(miss) => return Ok(RelatedAnswers { parts, miss: Some(miss), answers: Vec::new() }),
    };
    let limit = request.limit.unwrap_or(DEFAULT_LIMIT);
    let of = things.of(&phrase.thing);
    let described = found.into_iter().take(limit).enumerate().map(|(at, related)| {
        let candidate = &of[related.candidate];
        let place = candidate.found.record.position();
        let ranked = Ranked {
            found: candidate.found,
            rank: at + 1,
            relevance: related.score as f32,
            distance: request.near.map(|near: DVec3| near.distance(place)),
        };
        let answer = object_answer(scene, ranked, candidate.score, &Region::default(), false);
        (answer, related.degree, related.to)
    });
    Ok(RelatedAnswers { parts, miss: None, answers: described.collect() })
}

fn needs_up(phrase: &Phrase) -> bool {
    phrase.relation.as_ref().is_some_and(|place| place.is.needs_up()) || phrase.inner().any(needs_up)
}

/// Returns what stands for a question where a text is expected.
fn label(asked: &Asked) -> String {
    match asked {
        Asked::Text(text) => text.clone(),
        Asked::Vector(_) => "vector".into(),
        Asked::Phrase(phrase) => phrase.thing.clone(),
    }
}

/// Returns a vector at unit length; `None` if it has no direction.
fn unit(vector: &[f32]) -> Option<Vec<f32>> {
    let length = vector.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    (length > 0.0 && length.is_finite())
        .then(|| vector.iter().map(|v| (f64::from(*v) / length) as f32).collect())
}
