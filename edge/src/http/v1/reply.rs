//! The one shape of reply to `/v1/query`.

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;

use crate::query::relations::{self, MissKind, Phrase, Witness};
use crate::query::{
    AnswerKind, Answers, BadCellAnswer, ClusterAnswer, Clustering, FRAME, Found, GaussianAnswer, Outcome,
    ReasonKind, RelatedAnswers, Reply, ScoreKind, ThresholdSource, UNITS, unit,
};

/// The reply of version 1, to one question or many.
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "Reply")]
pub struct Replied<'a> {
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
pub struct Described<'a> {
    /// The question.
    question: AskedFor,
    /// The phrase that a text was understood as, if it names a relation.
    understood: Option<&'a Phrase>,
    /// Kind of the answers.
    kind: AnswerKind,
    #[serde(flatten)]
    searched: Option<Searched<'a>>,
    /// For phrases: the things that they name.
    #[serde(skip_serializing_if = "Option::is_none")]
    parts: Option<&'a [relations::Found]>,
    /// Why nothing was found; null if something was.
    none: Option<Nothing<'a>>,
    /// `offset` of the next page; null if there is none.
    next_offset: Option<usize>,
    /// The answers, best first.
    answers: Vec<Answer<'a>>,
}

/// A question as the client wrote it: one of the members.
#[derive(Default, Serialize, JsonSchema)]
#[schemars(rename = "Question")]
pub struct AskedFor {
    /// A text.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// The index of a vector in the request.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vector: Option<usize>,
    /// A phrase.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub phrase: Option<Phrase>,
}

/// How a text or vector was searched for.
#[derive(Serialize, JsonSchema)]
struct Searched<'a> {
    /// Negative prompts.
    #[serde(skip_serializing_if = "is_empty")]
    negatives: &'a [String],
    /// Meaning of scores.
    score_kind: ScoreKind,
    /// Score at or above which a Gaussian matches.
    threshold: f32,
    /// Source of the threshold.
    threshold_source: ThresholdSource,
    /// Gaussians with an embedding in the shards searched.
    n_searched: u64,
    /// Gaussians that match.
    n_matching: u64,
    /// Whether the matches are exactly the Gaussians that reach the threshold.
    is_exact: bool,
    /// Bound of the error of every score.
    score_error_bound: f32,
    /// For 95 of 100 questions (90 with negatives), 99 of 100 scores of each shard err by no more, measured over
    /// texts that the codebook was not made for; absent where answers are exact or it was not measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    score_error_likely: Option<f32>,
    /// Whether all of the requested region is on board.
    #[serde(skip_serializing_if = "Option::is_none")]
    area_fetched: Option<bool>,
    /// Cells in the requested region whose shards could not be fetched; absent if there are none.
    #[serde(skip_serializing_if = "is_empty")]
    bad_cells: &'a [BadCellAnswer],
    /// How matches were grouped.
    #[serde(skip_serializing_if = "Option::is_none")]
    clustering: Option<&'a Clustering>,
}

fn is_empty<T>(list: &&[T]) -> bool {
    list.is_empty()
}

/// Why nothing was found.
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "None")]
struct Nothing<'a> {
    /// The reason.
    kind: NothingKind,
    /// The same in words.
    detail: &'a str,
    /// The part of a phrase that failed.
    thing: Option<&'a str>,
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

#[derive(Serialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
enum NothingKind {
    Plain(ReasonKind),
    Related(MissKind),
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

impl<'a> Replied<'a> {
    pub fn new(reply: &'a Reply, results: Vec<Described<'a>>) -> Self {
        let manifest = reply.manifest();
        let unit = unit(manifest);
        Self { scene: &manifest.scene, generation: manifest.generation, frame: FRAME, unit, results }
    }
}

impl<'a> Described<'a> {
    /// Describes the answers to a question: a page of them, from `offset`, of at most `limit`.
    pub fn new(
        reply: &Reply,
        (question, understood): (AskedFor, Option<&'a Phrase>),
        outcome: &'a Outcome,
        (offset, limit): (usize, usize),
    ) -> Self {
        let end = offset.saturating_add(limit);
        let page = Self {
            question,
            understood,
            kind: AnswerKind::Objects,
            searched: None,
            parts: None,
            none: None,
            next_offset: (outcome.len() > end).then_some(end),
            answers: Vec::new(),
        };
        let generation = reply.manifest().generation;
        let thing = |cluster, degree, related_to| {
            let of = AnsweredThing { cluster, degree, related_to };
            Answer::Thing(InFrame { frame: FRAME, generation, of })
        };
        match outcome {
            Outcome::Plain(answers) => {
                let list = match &answers.answers {
                    Found::Clusters(clusters) => {
                        let page = clusters.iter().skip(offset).take(limit);
                        page.map(|cluster| thing(cluster, None, None)).collect()
                    }
                    Found::Gaussians(_) => {
                        let page = reply.gaussians(answers).into_iter().skip(offset).take(limit);
                        page.map(|of| Answer::Gaussian(InFrame { frame: FRAME, generation, of })).collect()
                    }
                };
                let (searched, none) = (Some(Searched::new(answers)), Nothing::of_plain(answers));
                Self { kind: answers.kind, searched, none, answers: list, ..page }
            }
            Outcome::Related(related) => {
                let list = related.answers.iter().skip(offset).take(limit);
                let list = list.map(|(cluster, degree, to)| thing(cluster, Some(*degree), Some(&**to)));
                let (parts, none) = (Some(&*related.parts), Nothing::of_related(related));
                Self { parts, none, answers: list.collect(), ..page }
            }
        }
    }
}

impl<'a> Searched<'a> {
    fn new(answers: &'a Answers) -> Self {
        Self {
            negatives: &answers.negatives,
            score_kind: answers.score_kind,
            threshold: answers.threshold,
            threshold_source: answers.threshold_source,
            n_searched: answers.n_searched,
            n_matching: answers.n_matching,
            is_exact: answers.is_exact,
            score_error_bound: answers.score_error_bound,
            score_error_likely: answers.score_error_likely,
            area_fetched: answers.area_fetched,
            bad_cells: &answers.bad_cells,
            clustering: answers.clustering.as_ref(),
        }
    }
}

impl<'a> Nothing<'a> {
    fn of_plain(answers: &'a Answers) -> Option<Self> {
        let reason = answers.reason.as_ref()?;
        Some(Self {
            kind: NothingKind::Plain(reason.kind),
            detail: &reason.detail,
            thing: None,
            best_score: reason.best_score,
            best_degree: None,
            best_position_in_world: reason.best_position_in_world,
        })
    }

    fn of_related(related: &'a RelatedAnswers) -> Option<Self> {
        let miss = related.miss.as_ref()?;
        let part = related.parts.iter().find(|part| part.thing == miss.thing);
        Some(Self {
            kind: NothingKind::Related(miss.kind),
            detail: &miss.detail,
            thing: Some(&miss.thing),
            best_score: part.and_then(|part| part.best_score),
            best_degree: miss.best_degree,
            best_position_in_world: None,
        })
    }
}
