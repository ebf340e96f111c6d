//! What can be asked, and its limits.

use std::str::FromStr;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::score::{Ball, MAX_COORDINATE};
use crate::text::MAX_TEXT_BYTES;

/// More answers than this are refused: a client that wants them all reads the shards.
pub const MAX_LIMIT: usize = 10_000;
/// Answers without a limit in the request.
pub const DEFAULT_LIMIT: usize = 10;
/// Smaller clusters are dropped, unless the request says otherwise.
pub const DEFAULT_MIN_COUNT: u64 = 10;

/// A part of a request that cannot be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{parameter}: found {found}, expected {expected}")]
pub struct RequestError {
    /// The parameter.
    pub parameter: String,
    /// What it is.
    pub found: String,
    /// What it may be.
    pub expected: String,
}

impl RequestError {
    /// Names a parameter, what was found (cut to 80 characters, control characters escaped) and what
    /// was expected.
    pub fn new(parameter: &str, found: &str, expected: impl Into<String>) -> Self {
        let cut: String = found.chars().take(80).collect();
        let dots = if cut.len() < found.len() { "…" } else { "" };
        Self { parameter: parameter.to_owned(), found: format!("{cut:?}{dots}"), expected: expected.into() }
    }
}

/// What answers are made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// Groups of neighbouring matches: objects.
    #[default]
    Clusters,
    /// The matches themselves.
    Gaussians,
}

impl FromStr for Level {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "clusters" => Ok(Self::Clusters),
            "gaussians" => Ok(Self::Gaussians),
            _ => Err("clusters or gaussians".into()),
        }
    }
}

/// Parses `X,Y,Z`.
///
/// # Errors
/// What was expected.
pub fn parse_point(text: &str) -> Result<DVec3, String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some([x, y, z]) if [x, y, z].iter().all(|v| v.abs() <= MAX_COORDINATE) => Ok(DVec3::new(*x, *y, *z)),
        _ => Err(format!("three numbers X,Y,Z within ±{MAX_COORDINATE:e}")),
    }
}

/// A question.
#[derive(Clone, Debug, PartialEq)]
pub struct QueryRequest {
    /// What to look for.
    pub text: String,
    /// Most answers; [`DEFAULT_LIMIT`] if absent.
    pub limit: Option<usize>,
    /// Cosine from which a Gaussian matches; the scene's own if absent.
    pub threshold: Option<f32>,
    /// Where the asker is: answers carry their distance from it and nearer ones rank higher.
    pub near: Option<DVec3>,
    /// Only Gaussians within this distance of `near` count, world units.
    pub radius: Option<f64>,
    /// What answers are made of.
    pub level: Level,
    /// Edge of the voxels that clusters are joined by, world units; the scene's own if absent.
    pub voxel: Option<f64>,
    /// Clusters with fewer Gaussians are dropped, and counted.
    pub min_count: u64,
}

impl QueryRequest {
    /// Returns the question for a text, all else as by default.
    pub fn new(text: impl Into<String>) -> Self {
        Self {
            text: text.into(),
            limit: None,
            threshold: None,
            near: None,
            radius: None,
            level: Level::default(),
            voxel: None,
            min_count: DEFAULT_MIN_COUNT,
        }
    }

    /// Checks every limit.
    ///
    /// # Errors
    /// The first parameter that is outside.
    pub fn check(&self) -> Result<(), RequestError> {
        let positive = |v: f64| v > 0.0 && v <= MAX_COORDINATE;
        let refuse = |parameter: &str, found: &dyn ToString, expected: String| {
            Err(RequestError::new(parameter, &found.to_string(), expected))
        };
        if self.text.len() > MAX_TEXT_BYTES {
            let found = format!("{} bytes", self.text.len());
            return refuse("text", &found, format!("at most {MAX_TEXT_BYTES} bytes"));
        }
        if self.text.trim().is_empty() {
            return refuse("text", &self.text, "words to look for".into());
        }
        if self.text.chars().any(|c| c.is_control() && !c.is_whitespace()) {
            return refuse("text", &self.text, "no control characters".into());
        }
        if self.limit.is_some_and(|limit| !(1..=MAX_LIMIT).contains(&limit)) {
            return refuse("limit", &self.limit.unwrap_or(0), format!("1 to {MAX_LIMIT}"));
        }
        if let Some(threshold) = self.threshold.filter(|t| !(-1.0..=1.0).contains(t)) {
            return refuse("threshold", &threshold, "a cosine, -1 to 1".into());
        }
        if let Some(near) =
            self.near.filter(|near| !(near.abs().max_element() <= MAX_COORDINATE && near.is_finite()))
        {
            return refuse("near", &near, format!("three numbers X,Y,Z within ±{MAX_COORDINATE:e}"));
        }
        if let Some(radius) = self.radius.filter(|radius| !positive(*radius)) {
            return refuse("radius", &radius, format!("more than 0, at most {MAX_COORDINATE:e}"));
        }
        if let (Some(radius), None) = (self.radius, self.near) {
            return refuse("near", &"nothing", format!("X,Y,Z, since radius is {radius}"));
        }
        if let Some(voxel) = self.voxel.filter(|voxel| !positive(*voxel)) {
            return refuse("voxel", &voxel, format!("more than 0, at most {MAX_COORDINATE:e}"));
        }
        if self.min_count == 0 {
            return refuse("min_count", &0, "at least 1".into());
        }
        Ok(())
    }

    /// Returns the part of space asked for, if it is bounded.
    pub fn ball(&self) -> Option<Ball> {
        let (centre_in_world, radius) = self.near.zip(self.radius)?;
        Some(Ball { centre_in_world, radius })
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
        assert_eq!(refused(|r| r.text = " \t ".into()), "text");
        assert_eq!(refused(|r| r.text = "x".repeat(513)), "text");
        assert_eq!(refused(|r| r.text = "a\u{1b}[2Jb".into()), "text");
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
}
