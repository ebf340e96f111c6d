//! Requests and their limits.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_common::frames::Aabb;

use crate::score::{Ball, MAX_COORDINATE, Polygon, Precision, Region};
use crate::text::MAX_TEXT_BYTES;

/// Most clusters or objects in a request, over all its texts.
pub const MAX_CLUSTERS: usize = 10_000;
/// Most Gaussians in a request, over all its texts: 12 MB while they are sent.
pub const MAX_GAUSSIANS: usize = 1_000_000;
pub const MAX_TEXTS: usize = 32;
pub const MAX_NEGATIVES: usize = 16;
/// LERF's canonical negatives (Kerr et al. 2023, section 3.3).
pub const CANONICAL_NEGATIVES: [&str; 4] = ["object", "things", "stuff", "texture"];
/// Answers to each text unless the request sets a limit.
pub const DEFAULT_LIMIT: usize = 10;
/// Least members of a cluster unless the request sets another number.
pub const DEFAULT_MIN_COUNT: u64 = 10;

/// An invalid part of a request.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{parameter}: found {found}, expected {expected}")]
pub struct RequestError {
    pub parameter: String,
    pub found: String,
    pub expected: String,
}

impl RequestError {
    /// Names a parameter, the value found (cut to 80 characters, control characters escaped) and the values
    /// expected.
    pub fn new(parameter: &str, found: &str, expected: impl Into<String>) -> Self {
        let cut: String = found.chars().take(80).collect();
        let dots = if cut.len() < found.len() { "…" } else { "" };
        Self { parameter: parameter.to_owned(), found: format!("{cut:?}{dots}"), expected: expected.into() }
    }
}

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

impl AnswerKind {
    /// Every kind, coarsest first.
    pub const ALL: [Self; 3] = [Self::Objects, Self::Clusters, Self::Gaussians];

    /// Returns the name used in URLs, flags and JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Objects => "objects",
            Self::Clusters => "clusters",
            Self::Gaussians => "gaussians",
        }
    }
}

impl fmt::Display for AnswerKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for AnswerKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|kind| kind.name() == text);
        found.ok_or_else(|| format!("one of {}", Self::ALL.map(Self::name).join(", ")))
    }
}

/// Negative prompts.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Negatives {
    /// None: scores are cosines.
    #[default]
    None,
    /// [`CANONICAL_NEGATIVES`].
    Canonical,
    Phrases(Vec<String>),
}

impl Negatives {
    pub fn phrases(&self) -> Vec<&str> {
        match self {
            Self::None => Vec::new(),
            Self::Canonical => CANONICAL_NEGATIVES.to_vec(),
            Self::Phrases(phrases) => phrases.iter().map(String::as_str).collect(),
        }
    }
}

impl FromStr for Negatives {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let phrases: Vec<String> = text.split(',').map(|phrase| phrase.trim().to_owned()).collect();
        match text.trim() {
            "none" => Ok(Self::None),
            "canonical" => Ok(Self::Canonical),
            _ if phrases.iter().any(String::is_empty) || phrases.len() > MAX_NEGATIVES => {
                Err(format!("none, canonical, or 1 to {MAX_NEGATIVES} phrases A,B,C"))
            }
            _ => Ok(Self::Phrases(phrases)),
        }
    }
}

/// Parses `X0,Y0,Z0,X1,Y1,Z1`: two opposite corners of a box.
pub fn parse_box(text: &str) -> Result<Aabb, String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some([a, b, c, d, e, f]) if [a, b, c, d, e, f].iter().all(|v| v.abs() <= MAX_COORDINATE) => {
            let (one, other) = (DVec3::new(*a, *b, *c), DVec3::new(*d, *e, *f));
            Ok(Aabb { min: one.min(other), max: one.max(other) })
        }
        _ => Err(format!("six numbers X0,Y0,Z0,X1,Y1,Z1 within ±{MAX_COORDINATE:e}")),
    }
}

/// Parses `X,Y,Z`.
pub fn parse_point(text: &str) -> Result<DVec3, String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some([x, y, z]) if [x, y, z].iter().all(|v| v.abs() <= MAX_COORDINATE) => Ok(DVec3::new(*x, *y, *z)),
        _ => Err(format!("three numbers X,Y,Z within ±{MAX_COORDINATE:e}")),
    }
}

/// Checks a text that the text model is to encode. `parameter`: its name, for the error.
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

/// One or several questions of the same kind.
#[derive(Clone, Debug, PartialEq)]
pub struct QueryRequest {
    /// Texts to look for; each is answered separately.
    pub texts: Vec<String>,
    /// Negative prompts.
    pub negatives: Negatives,
    /// Most answers to each text; [`DEFAULT_LIMIT`] if absent.
    pub limit: Option<usize>,
    /// Least score of a match: a cosine, or with negatives a relevancy; the scene's own if absent.
    pub threshold: Option<f32>,
    /// Position of the asker: answers carry their distance from it, and nearer ones rank higher.
    pub near: Option<DVec3>,
    /// Restricts the search to this distance from `near`, world units.
    pub radius: Option<f64>,
    /// Restricts the search to this ball, whatever `near` is; instead of `radius`.
    pub ball: Option<Ball>,
    /// Restricts the search to this box.
    pub bounds: Option<Aabb>,
    /// Restricts the search to this polygon.
    pub polygon: Option<Arc<Polygon>>,
    /// Kind of answers; if absent, objects where the scene has them, else clusters.
    pub kind: Option<AnswerKind>,
    /// Edge of the voxels used for clustering, world units; the scene's own if absent.
    pub voxel: Option<f64>,
    /// Least members of a cluster; smaller ones are only counted.
    pub min_count: u64,
    /// Which data scores come from.
    pub precision: Precision,
    /// Whether clusters and objects list their Gaussians.
    pub members: bool,
}

impl QueryRequest {
    /// Makes a request for a text, with defaults otherwise.
    pub fn new(text: impl Into<String>) -> Self {
        Self {
            texts: vec![text.into()],
            negatives: Negatives::None,
            limit: None,
            threshold: None,
            near: None,
            radius: None,
            ball: None,
            bounds: None,
            polygon: None,
            kind: None,
            voxel: None,
            min_count: DEFAULT_MIN_COUNT,
            precision: Precision::default(),
            members: false,
        }
    }

    /// Checks every limit.
    pub fn check(&self) -> Result<(), RequestError> {
        let positive = |v: f64| v > 0.0 && v <= MAX_COORDINATE;
        let refuse = |parameter: &str, found: &dyn ToString, expected: String| {
            Err(RequestError::new(parameter, &found.to_string(), expected))
        };
        if !(1..=MAX_TEXTS).contains(&self.texts.len()) {
            return refuse(
                "text",
                &format!("{} of them", self.texts.len()),
                format!("1 to {MAX_TEXTS} texts"),
            );
        }
        let negatives = self.negatives.phrases();
        if negatives.len() > MAX_NEGATIVES {
            let found = format!("{} of them", negatives.len());
            return refuse("negatives", &found, format!("at most {MAX_NEGATIVES} phrases"));
        }
        let texts = self.texts.iter().map(|text| ("text", text.as_str()));
        for (parameter, text) in texts.chain(negatives.iter().map(|text| ("negatives", *text))) {
            check_text(parameter, text)?;
        }
        let most = match self.kind {
            Some(AnswerKind::Gaussians) => MAX_GAUSSIANS,
            _ => MAX_CLUSTERS,
        } / self.texts.len();
        if let Some(limit) = self.limit.filter(|limit| !(1..=most).contains(limit)) {
            let answers = self.kind.map_or("answers".to_owned(), |kind| kind.to_string());
            return refuse("limit", &limit, format!("1 to {most} {answers} per text"));
        }
        let (thresholds, expected) = match self.negatives {
            Negatives::None => (-1.0..=1.0, "a cosine, -1 to 1"),
            _ => (0.0..=1.0, "a relevancy, 0 to 1, because there are negatives"),
        };
        if let Some(threshold) = self.threshold.filter(|t| !thresholds.contains(t)) {
            return refuse("threshold", &threshold, expected.into());
        }
        if let Some(bounds) = self.bounds.filter(|b| {
            !(b.min.cmple(b.max).all() && b.min.abs().max(b.max.abs()).max_element() <= MAX_COORDINATE)
        }) {
            let found = format!("{} to {}", bounds.min, bounds.max);
            return refuse(
                "box",
                &found,
                format!("two corners, the lower first, within ±{MAX_COORDINATE:e}"),
            );
        }
        if let Some(near) =
            self.near.filter(|near| !(near.abs().max_element() <= MAX_COORDINATE && near.is_finite()))
        {
            return refuse("near", &near, format!("three numbers X,Y,Z within ±{MAX_COORDINATE:e}"));
        }
        if let Some(radius) = self.radius.filter(|radius| !positive(*radius)) {
            return refuse("radius", &radius, format!("more than 0, at most {MAX_COORDINATE:e}"));
        }
        if let Some(ball) = self.ball.filter(|ball| {
            let centre = ball.centre_in_world;
            !(positive(ball.radius) && centre.is_finite() && centre.abs().max_element() <= MAX_COORDINATE)
        }) {
            let found = format!("{} around {}", ball.radius, ball.centre_in_world);
            return refuse("region", &found, format!("a radius and a centre within ±{MAX_COORDINATE:e}"));
        }
        if let (Some(radius), None) = (self.radius, self.near) {
            return refuse("near", &"nothing", format!("X,Y,Z, because radius is {radius}"));
        }
        if let Some(voxel) = self.voxel.filter(|voxel| !positive(*voxel)) {
            return refuse("voxel", &voxel, format!("more than 0, at most {MAX_COORDINATE:e}"));
        }
        if self.min_count == 0 {
            return refuse("min_count", &0, "at least 1".into());
        }
        Ok(())
    }

    /// Returns the part of space asked for.
    pub fn region(&self) -> Region {
        let around = self.near.zip(self.radius);
        let around = around.map(|(centre_in_world, radius)| Ball { centre_in_world, radius });
        Region { ball: self.ball.or(around), bounds: self.bounds, polygon: self.polygon.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poison_is_refused_by_name() {
        let refused = |edit: fn(&mut QueryRequest)| {
            let mut request = QueryRequest::new("chair");
            assert_eq!(request.check(), Ok(()));
            edit(&mut request);
            request.check().expect_err("must be refused").parameter
        };
        assert_eq!(refused(|r| r.texts = vec![" \t ".into()]), "text");
        assert_eq!(refused(|r| r.texts.push("x".repeat(513))), "text");
        assert_eq!(refused(|r| r.texts.push("a\u{1b}[2Jb".into())), "text");
        assert_eq!(refused(|r| r.texts.clear()), "text");
        assert_eq!(refused(|r| r.texts = vec!["a".into(); MAX_TEXTS + 1]), "text");
        assert_eq!(refused(|r| r.negatives = Negatives::Phrases(vec!["\0".into()])), "negatives");
        assert_eq!(
            refused(|r| r.negatives = Negatives::Phrases(vec!["a".into(); MAX_NEGATIVES + 1])),
            "negatives"
        );
        assert_eq!(refused(|r| (r.negatives, r.threshold) = (Negatives::Canonical, Some(-0.1))), "threshold");
        assert_eq!(refused(|r| r.limit = Some(MAX_CLUSTERS + 1)), "limit");
        assert_eq!(
            refused(|r| (r.kind, r.limit) = (Some(AnswerKind::Gaussians), Some(MAX_GAUSSIANS + 1))),
            "limit"
        );
        assert_eq!(
            refused(|r| {
                (r.kind, r.limit) = (Some(AnswerKind::Gaussians), Some(MAX_GAUSSIANS / 2 + 1));
                r.texts.push("table".into());
            }),
            "limit"
        );
        let bounds = |min: f64, max: f64| Some(Aabb { min: DVec3::splat(min), max: DVec3::splat(max) });
        let boxes = [bounds(1.0, 0.0), bounds(f64::NAN, 0.0), bounds(0.0, f64::INFINITY), bounds(-1e10, 0.0)];
        for bounds in boxes {
            let request = QueryRequest { bounds, ..QueryRequest::new("chair") };
            assert_eq!(request.check().expect_err("must be refused").parameter, "box");
        }
        assert_eq!(refused(|r| r.limit = Some(0)), "limit");
        assert_eq!(refused(|r| r.limit = Some(usize::MAX)), "limit");
        assert_eq!(refused(|r| r.threshold = Some(f32::NAN)), "threshold");
        assert_eq!(refused(|r| r.threshold = Some(1.5)), "threshold");
        assert_eq!(refused(|r| r.near = Some(DVec3::new(0.0, f64::INFINITY, 0.0))), "near");
        assert_eq!(refused(|r| r.near = Some(DVec3::new(0.0, 0.0, f64::NAN))), "near");
        assert_eq!(refused(|r| r.radius = Some(5.0)), "near");
        assert_eq!(refused(|r| (r.near, r.radius) = (Some(DVec3::ZERO), Some(f64::NAN))), "radius");
        assert_eq!(refused(|r| (r.near, r.radius) = (Some(DVec3::ZERO), Some(-1.0))), "radius");
        assert_eq!(refused(|r| r.voxel = Some(0.0)), "voxel");
        assert_eq!(refused(|r| r.min_count = 0), "min_count");
    }

    #[test]
    fn points_parse_or_say_what_they_should_be() {
        assert_eq!(parse_point("1, -2.5,3e2"), Ok(DVec3::new(1.0, -2.5, 300.0)));
        for bad in ["", "1,2", "1,2,3,4", "1,2,x", "NaN,0,0", "inf,0,0", "0,0,1e10"] {
            assert!(parse_point(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn negatives_and_boxes_parse_or_say_what_they_should_be() {
        assert_eq!("none".parse(), Ok(Negatives::None));
        assert_eq!(" canonical".parse(), Ok(Negatives::Canonical));
        let phrases = Negatives::Phrases(vec!["white wall".into(), "floor".into()]);
        assert_eq!("white wall, floor".parse(), Ok(phrases));
        for bad in ["", ",", "wall,,floor", &["x"; MAX_NEGATIVES + 1].join(",")] {
            assert!(bad.parse::<Negatives>().is_err(), "{bad}");
        }
        let bounds = Aabb { min: DVec3::new(-1.0, 0.0, 2.0), max: DVec3::new(4.0, 5.0, 3.0) };
        assert_eq!(parse_box("4,0, 3,-1,5,2"), Ok(bounds));
        for bad in ["", "1,2,3", "1,2,3,4,5", "1,2,3,4,5,6,7", "0,0,0,1,1,NaN", "0,0,0,1,1,1e10"] {
            assert!(parse_box(bad).is_err(), "{bad}");
        }
    }
}
