//! The body of `POST /v1/query`.

use std::time::Duration;

use schemars::JsonSchema;
use serde::Deserialize;

use super::reply::AskedFor;
use crate::http::forms::Words;
use crate::query::relations::{self, Phrase};
use crate::query::{
    AnswerKind, Area, Ask, Asked, DEFAULT_LIMIT, DEFAULT_MIN_COUNT, MAX_NEGATIVES, MAX_PAGE, MAX_TEXTS,
    Negatives, Point, QueryRequest, RequestError,
};
use crate::score::{MAX_COORDINATE, Precision};

/// Longest body: 32 vectors of 2048 components as text.
pub const MAX_BODY_BYTES: usize = 1 << 20;

/// What is asked for: at least one text, vector or phrase, 32 together at most. Everything else is optional.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, remote = "Self")]
#[schemars(rename = "Ask")]
pub struct Body {
    /// Texts for the text model; those that name a relation are understood as phrases.
    #[schemars(with = "Vec<Words>", length(max = MAX_TEXTS))]
    pub texts: Vec<String>,
    /// Vectors of the scene's embedding space; their lengths do not count.
    #[schemars(length(max = MAX_TEXTS))]
    pub vectors: Vec<Vec<f32>>,
    /// Things by their relations.
    #[schemars(length(max = MAX_TEXTS))]
    pub phrases: Vec<Phrase>,
    /// Whether texts that name a relation are understood as phrases; true if absent.
    pub relations: Option<bool>,
    /// Negative prompts; canonical alone stands for LERF's: object, things, stuff, texture.
    #[schemars(with = "Vec<Words>", length(max = MAX_NEGATIVES))]
    pub negatives: Vec<String>,
    /// Kind of answers.
    pub kind: Option<AnswerKind>,
    /// The part of space to search.
    pub region: Area,
    /// The asker's position.
    pub near: Option<Point>,
    /// The asker's heading, from x towards y, radians.
    pub heading_rad: Option<f64>,
    /// Least score of a match.
    #[schemars(range(min = -1, max = 1))]
    pub min_score: Option<f32>,
    /// Answers to each question in a page.
    #[schemars(range(min = 1, max = MAX_PAGE), extend("default" = DEFAULT_LIMIT))]
    pub limit: Option<usize>,
    /// Answers to each question before the page.
    pub offset: usize,
    /// Least Gaussians of an answer.
    #[schemars(range(min = 1), extend("default" = DEFAULT_MIN_COUNT))]
    pub min_count: Option<u64>,
    /// Edge of the voxels that join Gaussians to clusters.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = MAX_COORDINATE))]
    pub voxel: Option<f64>,
    /// Where scores come from.
    #[schemars(with = "Option<Precision>", extend("default" = Precision::default().name()))]
    pub precision: Option<String>,
    /// Most time to compute, milliseconds.
    #[schemars(range(min = 1))]
    pub time_budget_ms: Option<u64>,
}

slag_common::named_members!(Body);

/// A request, and the text behind each phrase that was understood.
pub struct Understood {
    pub ask: Ask,
    /// The question of each answer, as the client wrote it.
    pub questions: Vec<AskedFor>,
}

impl Body {
    /// Reads a body.
    ///
    /// # Errors
    /// It is no JSON, or no request.
    pub fn parse(bytes: &[u8]) -> Result<Self, RequestError> {
        let refused = |e: serde_json::Error| {
            RequestError::new("body", &e.to_string(), "a request as GET /openapi.json describes it")
        };
        serde_json::from_slice(bytes).map_err(refused)
    }

    /// Returns the most time to compute.
    ///
    /// # Errors
    /// It is nothing.
    pub fn time_budget(&self) -> Result<Option<Duration>, RequestError> {
        match self.time_budget_ms {
            Some(0) => Err(RequestError::new("time_budget_ms", "0", "at least 1")),
            time => Ok(time.map(Duration::from_millis)),
        }
    }

    /// Checks the number of questions, and understands texts. `has_objects`: whether relations can be answered;
    /// where they cannot, texts stay texts.
    ///
    /// # Errors
    /// The first parameter that is wrong.
    pub fn understand(self, has_objects: bool) -> Result<Understood, RequestError> {
        let n = self.texts.len() + self.vectors.len() + self.phrases.len();
        if !(1..=MAX_TEXTS).contains(&n) {
            let expected = format!("1 to {MAX_TEXTS} texts, vectors and phrases together");
            return Err(RequestError::new("texts", &format!("{n} questions"), expected));
        }
        let is_of_objects = matches!(self.kind, None | Some(AnswerKind::Objects));
        let with_relations = self.relations.unwrap_or(true) && has_objects && is_of_objects;
        let (mut asked, mut questions) = (Vec::with_capacity(n), Vec::with_capacity(n));
        for text in self.texts {
            questions.push(AskedFor { text: Some(text.clone()), ..AskedFor::default() });
            let phrase = if with_relations { relations::understand(&text) } else { None };
            // A phrase that breaks a limit is one text for the text model, as one without relations is.
            let phrase = phrase.filter(|phrase| phrase.check().is_ok());
            asked.push(phrase.map_or(Asked::Text(text), Asked::Phrase));
        }
        for (at, vector) in self.vectors.into_iter().enumerate() {
            questions.push(AskedFor { vector: Some(at), ..AskedFor::default() });
            asked.push(Asked::Vector(vector));
        }
        for phrase in self.phrases {
            questions.push(AskedFor { phrase: Some(phrase.clone()), ..AskedFor::default() });
            asked.push(Asked::Phrase(phrase));
        }
        let precision = match &self.precision {
            Some(name) => name.parse().map_err(|e: String| RequestError::new("precision", name, e))?,
            None => Precision::default(),
        };
        let request = QueryRequest {
            negatives: negatives(self.negatives),
            limit: self.limit,
            threshold: self.min_score,
            kind: self.kind,
            voxel: self.voxel,
            min_count: self.min_count.unwrap_or(DEFAULT_MIN_COUNT),
            precision,
            ..QueryRequest::new("")
        };
        let (near, heading_rad, offset) = (self.near, self.heading_rad, self.offset);
        let ask = Ask { asked, request, area: self.region, near, heading_rad, offset };
        Ok(Understood { ask, questions })
    }
}

/// Returns negative prompts as the engine takes them.
pub fn negatives(phrases: Vec<String>) -> Negatives {
    match phrases.as_slice() {
        [] => Negatives::None,
        [one] if one == "canonical" => Negatives::Canonical,
        _ => Negatives::Phrases(phrases),
    }
}
