//! The one shape of reply to `/v1/query`.

use glam::DVec3;
use serde::Serialize;
use serde_json::Value;

use crate::query::relations::{self, MissKind, Phrase, Witness};
use crate::query::{
    AnswerKind, Answers, BadCellAnswer, ClusterAnswer, Clustering, FRAME, Found, GaussianAnswer, Outcome,
    ReasonKind, RelatedAnswers, Reply, ScoreKind, ThresholdSource,
};

/// A reply.
#[derive(Serialize)]
pub struct Replied<'a> {
    scene: &'a str,
    generation: u64,
    frame: &'static str,
    unit: &'static str,
    results: Vec<Described<'a>>,
}

/// The answers to a question.
#[derive(Serialize)]
pub struct Described<'a> {
    question: Value,
    understood: Option<&'a Phrase>,
    kind: AnswerKind,
    #[serde(flatten)]
    searched: Option<Searched<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    parts: Option<&'a [relations::Found]>,
    none: Option<Nothing<'a>>,
    next_offset: Option<usize>,
    answers: Vec<Answer<'a>>,
}

/// How a text or vector was searched for.
#[derive(Serialize)]
struct Searched<'a> {
    #[serde(skip_serializing_if = "is_empty")]
    negatives: &'a [String],
    score_kind: ScoreKind,
    threshold: f32,
    threshold_source: ThresholdSource,
    n_searched: u64,
    n_matching: u64,
    is_exact: bool,
    score_error_bound: f32,
    #[serde(skip_serializing_if = "Option::is_none")]
    score_error_likely: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    area_fetched: Option<bool>,
    #[serde(skip_serializing_if = "is_empty")]
    bad_cells: &'a [BadCellAnswer],
    #[serde(skip_serializing_if = "Option::is_none")]
    clustering: Option<&'a Clustering>,
}

fn is_empty<T>(list: &&[T]) -> bool {
    list.is_empty()
}

/// Why nothing was found.
#[derive(Serialize)]
struct Nothing<'a> {
    kind: NothingKind,
    detail: &'a str,
    thing: Option<&'a str>,
    best_score: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    best_degree: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    best_position_in_world: Option<DVec3>,
}

#[derive(Serialize)]
#[serde(untagged)]
enum NothingKind {
    Plain(ReasonKind),
    Related(MissKind),
}

/// An answer, with the frame and the generation of its positions.
#[derive(Serialize)]
struct Answer<'a> {
    frame: &'static str,
    generation: u64,
    #[serde(flatten)]
    what: What<'a>,
    #[serde(skip_serializing_if = "Option::is_none")]
    degree: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    related_to: Option<&'a [Witness]>,
}

#[derive(Serialize)]
#[serde(untagged)]
enum What<'a> {
    Cluster(&'a ClusterAnswer),
    Gaussian(GaussianAnswer),
}

impl<'a> Replied<'a> {
    pub fn new(reply: &'a Reply, results: Vec<Described<'a>>) -> Self {
        let manifest = reply.manifest();
        let unit = if manifest.metric { "m" } else { "world" };
        Self { scene: &manifest.scene, generation: manifest.generation, frame: FRAME, unit, results }
    }
}

impl<'a> Described<'a> {
    /// Describes the answers to a question: a page of them, from `offset`, of at most `limit`.
    pub fn new(
        reply: &Reply,
        (question, understood): (Value, Option<&'a Phrase>),
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
        let answer = |what| Answer { frame: FRAME, generation, what, degree: None, related_to: None };
        match outcome {
            Outcome::Plain(answers) => {
                let list = match &answers.answers {
                    Found::Clusters(clusters) => {
                        let page = clusters.iter().skip(offset).take(limit);
                        page.map(|cluster| answer(What::Cluster(cluster))).collect()
                    }
                    Found::Gaussians(_) => {
                        let page = reply.gaussians(answers).into_iter().skip(offset).take(limit);
                        page.map(|gaussian| answer(What::Gaussian(gaussian))).collect()
                    }
                };
                let (searched, none) = (Some(Searched::new(answers)), Nothing::of_plain(answers));
                Self { kind: answers.kind, searched, none, answers: list, ..page }
            }
            Outcome::Related(related) => {
                let list = related.answers.iter().skip(offset).take(limit);
                let list = list.map(|(cluster, degree, to)| Answer {
                    degree: Some(*degree),
                    related_to: Some(to),
                    ..answer(What::Cluster(cluster))
                });
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
