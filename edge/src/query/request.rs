//! Requests and their limits.

use std::fmt;
use std::str::FromStr;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_common::frames::Aabb;

use super::relations::{self, Phrase};
use crate::score::{Ball, MAX_COORDINATE, Precision, Region};
use crate::store::Snapshot;
use crate::text::MAX_TEXT_BYTES;

pub use slag_service::params::RequestError;

/// Most clusters or objects in a request, over all its texts.
pub const MAX_CLUSTERS: usize = 10_000;
/// Most Gaussians in a request, over all its texts: 12 MB during sending.
pub const MAX_GAUSSIANS: usize = 1_000_000;
/// Most answers in a page, over all questions.
pub const MAX_PAGE: usize = MAX_CLUSTERS;
pub const MAX_TEXTS: usize = 32;
pub const MAX_NEGATIVES: usize = 16;
/// Largest heading, four turns: more are degrees.
const MAX_HEADING_RAD: f64 = 4.0 * std::f64::consts::TAU;
/// LERF's canonical negatives (Kerr et al. 2023, section 3.3).
pub const CANONICAL_NEGATIVES: [&str; 4] = ["object", "things", "stuff", "texture"];
/// Default number of answers to each text.
pub const DEFAULT_LIMIT: usize = 10;
/// Default least members of a cluster.
pub const DEFAULT_MIN_COUNT: u64 = 10;

/// Kind of answers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum AnswerKind {
    /// Objects, which the masks of several views agree on, scored as a whole.
    #[default]
    Objects,
    /// Clusters of neighbouring matches.
    Clusters,
    /// The matching Gaussians themselves.
    Gaussians,
}

impl fmt::Display for AnswerKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// Negative prompts; without any, scores are cosines.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(from = "Vec<String>")]
pub struct Negatives(pub Vec<String>);

impl From<Vec<String>> for Negatives {
    fn from(phrases: Vec<String>) -> Self {
        let is_canonical = matches!(&phrases[..], [one] if one == "canonical");
        Self(if is_canonical { CANONICAL_NEGATIVES.map(str::to_owned).to_vec() } else { phrases })
    }
}

impl FromStr for Negatives {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let phrases: Vec<String> = text.split(',').map(|phrase| phrase.trim().to_owned()).collect();
        match text.trim() {
            "none" => Ok(Self::default()),
            _ if phrases.iter().any(String::is_empty) || phrases.len() > MAX_NEGATIVES => {
                Err(format!("none, canonical, or 1 to {MAX_NEGATIVES} phrases A,B,C"))
            }
            _ => Ok(phrases.into()),
        }
    }
}

/// Parses comma-separated numbers.
pub fn numbers(text: &str) -> Option<Vec<f64>> {
    text.split(',').map(|number| number.trim().parse().ok()).collect()
}

/// The range of [`is_length`], in words.
pub const LENGTHS: &str = "more than 0, at most 1e9";

/// Returns whether a radius, margin or edge is valid, for HTTP and the command line.
pub fn is_length(length: f64) -> bool {
    length > 0.0 && length <= MAX_COORDINATE
}

/// Checks a length. `parameter`: its name, for the error.
pub fn check_length(parameter: &str, length: f64) -> Result<(), RequestError> {
    if is_length(length) { Ok(()) } else { Err(RequestError::new(parameter, &length.to_string(), LENGTHS)) }
}

fn is_within(point: DVec3) -> bool {
    point.is_finite() && point.abs().max_element() <= MAX_COORDINATE
}

/// Checks a region of a question or list, including its polygon.
pub fn check_region(region: &Region) -> Result<(), RequestError> {
    // A flat box is empty.
    let is_box = |b: &Aabb| b.min.cmplt(b.max).all() && is_within(b.min) && is_within(b.max);
    if let Some(bounds) = region.bounds.filter(|bounds| !is_box(bounds)) {
        let found = format!("{} to {}", bounds.min, bounds.max);
        let expected = format!("two corners within ±{MAX_COORDINATE:e} that differ along each axis");
        return Err(RequestError::new("box", &found, expected));
    }
    if let Some(Ball { centre_in_world, radius }) = region.ball {
        check_length("radius", radius)?;
        if !is_within(centre_in_world) {
            let expected = format!("a centre within ±{MAX_COORDINATE:e}");
            return Err(RequestError::new("centre", &centre_in_world.to_string(), expected));
        }
    }
    Ok(())
}

/// Parses `X0,Y0,Z0,X1,Y1,Z1`: two opposite corners of a box.
pub fn parse_box(text: &str) -> Result<Aabb, String> {
    match numbers(text).as_deref() {
        Some([a, b, c, d, e, f]) if [a, b, c, d, e, f].iter().all(|v| v.abs() <= MAX_COORDINATE) => {
            let (one, other) = (DVec3::new(*a, *b, *c), DVec3::new(*d, *e, *f));
            Ok(Aabb { min: one.min(other), max: one.max(other) })
        }
        _ => Err(format!("six numbers X0,Y0,Z0,X1,Y1,Z1 within ±{MAX_COORDINATE:e}")),
    }
}

/// Parses `X,Y,Z`.
pub fn parse_point(text: &str) -> Result<DVec3, String> {
    match numbers(text).as_deref() {
        Some([x, y, z]) if [x, y, z].iter().all(|v| v.abs() <= MAX_COORDINATE) => Ok(DVec3::new(*x, *y, *z)),
        _ => Err(format!("three numbers X,Y,Z within ±{MAX_COORDINATE:e}")),
    }
}

#[derive(Clone, Debug, PartialEq)]
pub enum Asked {
    Text(String),
    /// A vector of the scene's embedding space, by its place in the request; its length is ignored.
    Vector {
        at: usize,
        vector: Vec<f32>,
    },
    /// A phrase, and the text that it was parsed from.
    Phrase {
        text: Option<String>,
        phrase: Phrase,
    },
}

impl Asked {
    /// Returns the question's name for messages.
    pub fn label(&self) -> &str {
        match self {
            Self::Text(text) => text,
            Self::Vector { .. } => "vector",
            Self::Phrase { text: Some(text), .. } => text,
            Self::Phrase { text: None, phrase } => &phrase.thing,
        }
    }

    /// Checks every limit that does not depend on the scene.
    fn check(&self, request: &QueryRequest) -> Result<(), RequestError> {
        match self {
            Self::Text(text) => check_text("text", text),
            Self::Vector { vector, .. } => match unit_vector(vector) {
                Some(_) => Ok(()),
                None => {
                    let expected = "finite numbers that are not all 0";
                    Err(RequestError::new("vectors", "a vector without a direction", expected))
                }
            },
            Self::Phrase { phrase, .. } => {
                phrase.check()?;
                if let Some(kind) = request.kind.filter(|kind| *kind != AnswerKind::Objects) {
                    let expected = "objects, since relations are between objects";
                    return Err(RequestError::new("kind", &kind.to_string(), expected));
                }
                let [needs_position, needs_heading] = phrase.needs();
                if needs_position && request.near.is_none() {
                    let expected = "where the asker is, since the phrase depends on it";
                    return Err(RequestError::new("near", "nothing", expected));
                }
                if needs_heading && request.heading_rad.is_none() {
                    let expected = "where the asker looks, since the phrase depends on it";
                    return Err(RequestError::new("heading_rad", "nothing", expected));
                }
                Ok(())
            }
        }
    }
}

/// Returns a vector at unit length; `None` if it has no direction.
pub fn unit_vector(vector: &[f32]) -> Option<Vec<f32>> {
    let length = vector.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    (length > 0.0 && length.is_finite())
        .then(|| vector.iter().map(|v| (f64::from(*v) / length) as f32).collect())
}

/// Questions with shared settings, as the engine interprets them: in the world frame.
#[derive(Clone, Debug, PartialEq)]
pub struct QueryRequest {
    /// Each is answered separately.
    pub asked: Vec<Asked>,
    pub negatives: Negatives,
    /// Most answers to each question; [`DEFAULT_LIMIT`] if absent.
    pub limit: Option<usize>,
    /// Whether answers are paged: `offset` is allowed, and an extra answer is ranked to detect a next page.
    pub paged: bool,
    /// Answers to each question before the page.
    pub offset: usize,
    /// Least score of a match: a cosine, or with negatives a relevancy; the scene's own if absent.
    pub threshold: Option<f32>,
    /// Asker's position: answers carry their distance from it, and nearer ones rank higher.
    pub near: Option<DVec3>,
    /// Asker's heading, from x towards y, radians.
    pub heading_rad: Option<f64>,
    pub region: Region,
    /// Kind of answers; if absent, objects, and clusters for a question that no object answers.
    pub kind: Option<AnswerKind>,
    /// Edge of the voxels used for clustering, world units; the scene's own if absent.
    pub voxel: Option<f64>,
    /// Least members of a cluster; smaller ones are only counted.
    pub min_count: u64,
    pub precision: Precision,
    pub members: bool,
    /// Whether texts that name a relation are understood as phrases.
    pub relations: bool,
}

impl QueryRequest {
    pub fn new(text: impl Into<String>) -> Self {
        Self {
            asked: vec![Asked::Text(text.into())],
            negatives: Negatives::default(),
            limit: None,
            paged: false,
            offset: 0,
            threshold: None,
            near: None,
            heading_rad: None,
            region: Region::default(),
            kind: None,
            voxel: None,
            min_count: DEFAULT_MIN_COUNT,
            precision: Precision::default(),
            members: false,
            relations: true,
        }
    }

    /// Parses texts with relations, if answers are objects and the generation has them.
    ///
    /// # Errors
    /// A text that breaks a phrase's limit: without its relations it would ask for something else.
    pub(super) fn understand(&mut self, snapshot: &Snapshot) -> Result<(), RequestError> {
        let may_be_objects = matches!(self.kind, None | Some(AnswerKind::Objects));
        if !self.relations || !may_be_objects || snapshot.objects.is_empty() {
            return Ok(());
        }
        for asked in &mut self.asked {
            let Asked::Text(text) = asked else { continue };
            if let Some(phrase) = relations::understand(text)? {
                // Nobody gave a phrase.
                phrase.check().map_err(|error| RequestError { parameter: "text".to_owned(), ..error })?;
                *asked = Asked::Phrase { text: Some(std::mem::take(text)), phrase };
            }
        }
        Ok(())
    }

    pub fn page(&self) -> usize {
        self.limit.unwrap_or(DEFAULT_LIMIT)
    }

    /// Returns the answers that are ranked for each question.
    pub fn n_ranked(&self) -> usize {
        self.offset + self.page() + usize::from(self.paged)
    }

    /// Checks every limit that does not depend on the scene.
    pub fn check(&self) -> Result<(), RequestError> {
        let refuse = |parameter: &str, found: &dyn ToString, expected: String| {
            Err(RequestError::new(parameter, &found.to_string(), expected))
        };
        self.check_texts()?;
        self.asked.iter().try_for_each(|asked| asked.check(self))?;
        self.check_page()?;
        let (thresholds, expected) = match self.negatives.0.is_empty() {
            true => (-1.0..=1.0, "a cosine, -1 to 1"),
            false => (0.0..=1.0, "a relevancy, 0 to 1, because there are negatives"),
        };
        if let Some(threshold) = self.threshold.filter(|t| !thresholds.contains(t)) {
            return refuse("threshold", &threshold, expected.into());
        }
        if let Some(heading) =
            self.heading_rad.filter(|heading| !(-MAX_HEADING_RAD..=MAX_HEADING_RAD).contains(heading))
        {
            return refuse(
                "heading_rad",
                &heading,
                format!("radians within ±{MAX_HEADING_RAD:.1}, four turns"),
            );
        }
        if let Some(near) = self.near.filter(|near| !is_within(*near)) {
            return refuse("near", &near, format!("three numbers X,Y,Z within ±{MAX_COORDINATE:e}"));
        }
        check_region(&self.region)?;
        if let Some(voxel) = self.voxel {
            check_length("voxel", voxel)?;
        }
        if self.min_count == 0 {
            return refuse("min_count", &0, "at least 1".into());
        }
        Ok(())
    }

    fn check_texts(&self) -> Result<(), RequestError> {
        let n_of_them = |n: usize| format!("{n} of them");
        let n = self.asked.len();
        if !(1..=MAX_TEXTS).contains(&n) {
            return Err(RequestError::new("text", &n_of_them(n), format!("1 to {MAX_TEXTS} texts")));
        }
        let negatives = &self.negatives.0;
        if negatives.len() > MAX_NEGATIVES {
            let expected = format!("at most {MAX_NEGATIVES} phrases");
            return Err(RequestError::new("negatives", &n_of_them(negatives.len()), expected));
        }
        negatives.iter().try_for_each(|text| check_text("negatives", text))?;
        // A text equal to its negative scores the same everywhere.
        let mut texts = self.asked.iter().filter(|of| !matches!(of, Asked::Vector { .. })).map(Asked::label);
        let negatives: Vec<String> = negatives.iter().map(|text| relations::normal(text)).collect();
        match texts.find(|text| negatives.contains(&relations::normal(text))) {
            Some(text) => Err(RequestError::new("negatives", text, "words other than those asked for")),
            None => Ok(()),
        }
    }

    fn check_page(&self) -> Result<(), RequestError> {
        let n = self.asked.len();
        let (most, answers) = match self.kind {
            Some(AnswerKind::Gaussians) => (MAX_GAUSSIANS / n, "gaussians"),
            _ => (MAX_CLUSTERS / n, "answers"),
        };
        let of_page = if self.paged { most.min(MAX_PAGE / n) } else { most };
        if !(1..=of_page).contains(&self.page()) {
            let expected = format!("1 to {of_page} {answers} to each of {n} questions");
            return Err(RequestError::new("limit", &self.page().to_string(), expected));
        }
        if self.offset > 0 && !self.paged {
            let expected = "0, since all answers come at once; /v1/query has pages";
            return Err(RequestError::new("offset", &self.offset.to_string(), expected));
        }
        if self.offset.saturating_add(self.page()) > most {
            let found = format!("{} after {}", self.page(), self.offset);
            return Err(RequestError::new("limit", &found, format!("to end within {most} {answers}")));
        }
        Ok(())
    }
}

/// At most 512 bytes of UTF-8, without control characters.
#[derive(JsonSchema)]
#[schemars(rename = "Text")]
#[expect(dead_code, reason = "the schema of texts, which are read as strings and checked by `check_text`")]
pub struct Words(
    #[schemars(
        length(min = 1, max = MAX_TEXT_BYTES),
        regex(
            pattern = r"^[^\u0000-\u001f\u007f-\u009f]*[^\s\u0000-\u001f\u007f-\u009f][^\u0000-\u001f\u007f-\u009f]*$"
        )
    )]
    String,
);

/// Checks a text for the text model. `parameter`: its name, for the error.
pub fn check_text(parameter: &str, text: &str) -> Result<(), RequestError> {
    if text.len() > MAX_TEXT_BYTES {
        let found = format!("{} bytes", text.len());
        return Err(RequestError::new(parameter, &found, format!("at most {MAX_TEXT_BYTES} bytes")));
    }
    if text.trim().is_empty() {
        return Err(RequestError::new(parameter, text, "words to look for"));
    }
    if text.chars().any(|c| c.is_control() && !c.is_whitespace()) {
        return Err(RequestError::new(parameter, text, "no control characters"));
    }
    Ok(())
}
