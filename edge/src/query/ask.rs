//! Questions as clients ask them, in JSON or in a query string.

use std::time::Duration;

use schemars::JsonSchema;
use serde::de::{DeserializeOwned, IntoDeserializer};
use serde::{Deserialize, Deserializer};
use slag_common::manifest::Manifest;

use super::area::{Area, Point};
use super::format::Format;
use super::relations::Phrase;
use super::request::{
    AnswerKind, Asked, DEFAULT_LIMIT, DEFAULT_MIN_COUNT, MAX_NEGATIVES, MAX_PAGE, MAX_TEXTS, Negatives,
    QueryRequest, RequestError, Words,
};
use crate::score::{MAX_COORDINATE, Precision};

/// What is asked for: at least one text, vector or phrase, 32 together at most. Everything else is optional.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, remote = "Self")]
pub struct Ask {
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
    pub negatives: Negatives,
    /// Kind of answers.
    #[serde(deserialize_with = "by_name_if_any")]
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
    #[serde(deserialize_with = "by_name")]
    pub precision: Precision,
    /// Most time to compute, milliseconds.
    #[schemars(range(min = 1))]
    pub time_budget_ms: Option<u64>,
    /// Format of answers that come at once, to texts as they are; absent: a page of the reply of version 1.
    #[serde(skip)]
    pub format: Option<Format>,
}

slag_common::named_members!(Ask);

/// Reads the name of a variant: serde would take `{"exact": null}` as well.
fn by_name<'de, D: Deserializer<'de>, T: DeserializeOwned>(from: D) -> Result<T, D::Error> {
    T::deserialize(String::deserialize(from)?.into_deserializer())
}

fn by_name_if_any<'de, D: Deserializer<'de>, T: DeserializeOwned>(from: D) -> Result<Option<T>, D::Error> {
    let name = Option::<String>::deserialize(from)?;
    name.map(|name| T::deserialize(name.into_deserializer())).transpose()
}

impl Ask {
    pub(crate) fn time_budget(&self) -> Result<Option<Duration>, RequestError> {
        match self.time_budget_ms {
            Some(0) => Err(RequestError::new("time_budget_ms", "0", "at least 1")),
            time => Ok(time.map(Duration::from_millis)),
        }
    }

    /// Returns the questions in a scene's world frame.
    pub(super) fn in_world(self, manifest: &Manifest) -> Result<QueryRequest, RequestError> {
        let n = self.texts.len() + self.vectors.len() + self.phrases.len();
        if !(1..=MAX_TEXTS).contains(&n) {
            let expected = format!("1 to {MAX_TEXTS} texts, vectors and phrases together");
            let counts = [
                ("texts", self.texts.len()),
                ("vectors", self.vectors.len()),
                ("phrases", self.phrases.len()),
            ];
            let most = counts.into_iter().reduce(|most, of| if of.1 > most.1 { of } else { most });
            let member = most.map_or("texts", |(member, _)| member);
            return Err(RequestError::new(member, &format!("{n} questions"), expected));
        }
        let texts = self.texts.into_iter().map(Asked::Text);
        let vectors = self.vectors.into_iter().enumerate().map(|(at, vector)| Asked::Vector { at, vector });
        let phrases = self.phrases.into_iter().map(|phrase| Asked::Phrase { text: None, phrase });
        Ok(QueryRequest {
            asked: texts.chain(vectors).chain(phrases).collect(),
            negatives: self.negatives,
            limit: self.limit,
            paged: self.format.is_none(),
            offset: self.offset,
            threshold: self.min_score,
            region: self.region.in_world(manifest)?,
            near: self.near.map(|near| near.in_world("near", manifest)).transpose()?,
            heading_rad: self.heading_rad,
            kind: self.kind,
            voxel: self.voxel,
            min_count: self.min_count.unwrap_or(DEFAULT_MIN_COUNT),
            precision: self.precision,
            members: self.format == Some(Format::Ply),
            relations: self.relations.unwrap_or(true),
        })
    }
}
