//! A page of answers: version 1's only reply type.

use std::collections::BTreeMap;

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;
use slag_api::coverage::Coverage;
use slag_api::{FRAME, UNITS};

use super::answers::{Answers, ClusterAnswer, Found, GaussianAnswer, Reply, Searched};
use super::reason::{Reason, ReasonKind};
use super::relations::{self, Phrase, Witness};
use super::request::{AnswerKind, Asked};
use super::scene::unit;

/// The reply of version 1, to one question or many.
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "Reply")]
pub struct Page<'a> {
    /// Name of the scene.
    scene: &'a str,
    /// Generation that answers.
    generation: u64,
    /// Frame of every position: the scene's world frame.
    #[schemars(extend("enum" = [FRAME]))]
    frame: &'static str,
    /// Unit of every position and length; world: the model is not metric.
    #[schemars(extend("enum" = UNITS))]
    unit: &'static str,
    /// One for each question: texts, then vectors, then phrases.
    results: Vec<Described<'a>>,
}

/// The answers to one question.
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "Result")]
struct Described<'a> {
    /// The question.
    question: AskedFor<'a>,
    /// The phrase that a text was understood as, if it names a relation.
    understood: Option<&'a Phrase>,
    /// What was asked in place of words that the model does not know.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    asked_as: &'a BTreeMap<String, String>,
    /// Kind of the answers.
    kind: AnswerKind,
    #[serde(flatten)]
    searched: Option<&'a Searched>,
    #[serde(flatten)]
    coverage: &'a Coverage,
    /// For phrases: the things that they name.
    #[serde(skip_serializing_if = "Option::is_none")]
    parts: Option<&'a [relations::Found]>,
    /// Why nothing was found; null if something was.
    none: Option<Nothing>,
    /// `offset` of the next page; null if there is none.
    next_offset: Option<usize>,
    /// The answers, best first.
    answers: Vec<Answer<'a>>,
}

/// A question as the client wrote it.
#[derive(Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(rename = "Question")]
enum AskedFor<'a> {
    /// A text.
    Text(&'a str),
    /// The index of a vector in the request.
    Vector(usize),
    /// A phrase.
    Phrase(&'a Phrase),
}

/// Why nothing was found.
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "None")]
struct Nothing {
    /// The reason.
    kind: ReasonKind,
    /// The same in words.
    detail: String,
    /// Share of the Gaussians on board in the region asked for that a used view saw; absent where there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    seen_share: Option<f64>,
    /// The part of a phrase that failed.
    thing: Option<Box<str>>,
    /// Best score found.
    best_score: Option<f32>,
    /// Greatest degree of the relation among all pairs; it holds from 0.5.
    #[serde(skip_serializing_if = "Option::is_none")]
    best_degree: Option<f64>,
    /// Where the best score is.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<[f64; 3]>")]
    best_position_in_world: Option<DVec3>,
}

/// An object, a cluster or a Gaussian.
#[derive(Serialize, JsonSchema)]
#[serde(untagged)]
enum Answer<'a> {
    Thing(InFrame<AnsweredThing<'a>>),
    Gaussian(InFrame<GaussianAnswer>),
}

/// An answer, with the frame and the generation of its positions.
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "{T}InFrame")]
struct InFrame<T> {
    /// Frame of every position: the scene's world frame.
    #[schemars(extend("enum" = [FRAME]))]
    frame: &'static str,
    /// Generation that every position belongs to.
    generation: u64,
    #[serde(flatten)]
    of: T,
}

/// An object or a cluster. For a phrase, relevance is the product of the confidences and degrees of all its parts.
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "Thing")]
struct AnsweredThing<'a> {
    #[serde(flatten)]
    cluster: &'a ClusterAnswer,
    /// For a phrase: degree of its relation, 0.5 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    degree: Option<f64>,
    /// For a phrase: what the answer is related to.
    #[serde(skip_serializing_if = "Option::is_none")]
    related_to: Option<&'a [Witness]>,
}

impl<'a> Page<'a> {
    /// Describes a reply with the answers of its page.
    pub fn of(reply: &'a Reply) -> Self {
        let manifest = reply.manifest();
        let results = reply.request.asked.iter().zip(&reply.answers);
        Self {
            scene: &manifest.scene,
            generation: manifest.generation,
            frame: FRAME,
            unit: unit(manifest),
            results: results.map(|(asked, found)| Described::new(reply, asked, found)).collect(),
        }
    }
}

impl<'a> Described<'a> {
    fn new(reply: &Reply, asked: &'a Asked, found: &'a Answers) -> Self {
        let (question, understood) = match asked {
            Asked::Text(text) => (AskedFor::Text(text), None),
            Asked::Vector { at, .. } => (AskedFor::Vector(*at), None),
            Asked::Phrase { text: Some(text), phrase } => (AskedFor::Text(text), Some(phrase)),
            Asked::Phrase { text: None, phrase } => (AskedFor::Phrase(phrase), Some(phrase)),
        };
        let (offset, limit) = (reply.request.offset, reply.request.page());
        let end = offset.saturating_add(limit);
        let generation = reply.manifest().generation;
        let n = found.answers.len();
        let beyond = || {
            let advice = "is beyond them: give a smaller one";
            Reason::new(ReasonKind::BeyondEnd, format!("{n} answers in all, offset {offset} {advice}"))
        };
        let none = found.reason.clone().or_else(|| (n > 0 && offset >= n).then(beyond));
        let related = found.related.as_ref();
        let thing = |(at, cluster): (usize, &'a ClusterAnswer)| {
            let to = related.map(|related| &related.to[at]);
            let (degree, related_to) = (to.map(|to| to.0), to.map(|to| &*to.1));
            let of = AnsweredThing { cluster, degree, related_to };
            Answer::Thing(InFrame { frame: FRAME, generation, of })
        };
        let gaussian = |of| Answer::Gaussian(InFrame { frame: FRAME, generation, of });
        let answers = match &found.answers {
            Found::Clusters(of) => of.iter().enumerate().skip(offset).take(limit).map(thing).collect(),
            Found::Gaussians(_) => {
                reply.gaussians(found).into_iter().skip(offset).take(limit).map(gaussian).collect()
            }
        };
        Self {
            question,
            understood,
            asked_as: &found.asked_as,
            kind: found.kind,
            searched: related.is_none().then_some(&found.searched),
            coverage: &found.coverage,
            parts: related.map(|related| &*related.parts),
            none: none.map(Nothing::from),
            next_offset: (n > end).then_some(end),
            answers,
        }
    }
}

impl From<Reason> for Nothing {
    fn from(reason: Reason) -> Self {
        let Reason { kind, detail, seen_share, best_score, best_position_in_world, thing, best_degree } =
            reason;
        Self { kind, detail, seen_share, thing, best_score, best_degree, best_position_in_world }
    }
}
