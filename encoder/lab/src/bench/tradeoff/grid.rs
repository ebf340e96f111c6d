//! The grid of flags to measure: built in, or read from a file.
//!
//! ```json
//! {"points": [{
//!   "axis": "views by coverage", "name": "25 %",
//!   "views": "--view-order coverage --views-limit 25%",
//!   "lift": "--compact-error 0.1",
//!   "profile": "compact"
//! }]}
//! ```
//!
//! `axis` names the varied setting. `views` are the flags of `encode` that change the views' contributions, `lift`
//! its other flags. The shards of `profile` are evaluated and measured; all profiles are made, because the exact
//! shards tell which Gaussian is which.
//!
//! `{masks}` stands for the scene's folder of true masks, `{sam}` for the model directory of Segment Anything;
//! without these a point is not run. Points of a scene with the same `views` share one store, and their
//! contributions are computed once.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};
use slag_common::shard::Profile;

use crate::scenes::SceneFiles;

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Grid {
    pub(super) points: Vec<Point>,
}

#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Point {
    /// The varied setting.
    pub(super) axis: String,
    pub(super) name: String,
    #[serde(default)]
    pub(super) views: String,
    #[serde(default)]
    pub(super) lift: String,
    #[serde(default = "compact")]
    pub(super) profile: Profile,
}

fn compact() -> Profile {
    Profile::Compact
}

impl Grid {
    pub(super) fn find(path: &Path) -> Result<Self> {
        let text = match path.to_str() {
            Some("quick") => include_str!("quick.json").to_owned(),
            Some("full") => include_str!("full.json").to_owned(),
            Some("paper") => include_str!("paper.json").to_owned(),
            _ => fs_err::read_to_string(path)?,
        };
        Self::parse(&text).with_context(|| path.display().to_string())
    }

    pub(super) fn parse(text: &str) -> Result<Self> {
        let grid: Self = serde_json::from_str(text).context(
            "expected {\"points\": [..]}, each with axis and name, and optionally views, lift, profile",
        )?;
        for (number, point) in grid.points.iter().enumerate() {
            if grid.points[..number].iter().any(|p| p.axis == point.axis && p.name == point.name) {
                bail!("{} / {} occurs twice", point.axis, point.name);
            }
        }
        Ok(grid)
    }
}

/// Flags with their placeholders filled in, or what is missing to do so.
pub(super) type Expanded = Result<Vec<String>, &'static str>;

/// Replaces the placeholders in flags; the inner error says what the scene or machine lacks.
pub(super) fn expand(flags: &str, scene: &SceneFiles, segmenter: Option<&PathBuf>) -> Result<Expanded> {
    let mut words = Vec::new();
    for word in flags.split_whitespace() {
        let (path, missing) = match word {
            "{masks}" => (&scene.true_masks, "it has no gt/masks"),
            "{sam}" => (&segmenter.cloned(), "no --segmenter is given"),
            _ if word.contains(['{', '}']) => {
                bail!("{flags:?}: unknown placeholder {word}; known are {{masks}} and {{sam}}")
            }
            _ => {
                words.push(word.to_owned());
                continue;
            }
        };
        match path {
            Some(path) => words.push(path.display().to_string()),
            None => return Ok(Err(missing)),
        }
    }
    Ok(Ok(words))
}
