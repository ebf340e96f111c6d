//! `GET /v1/view`: the scene to draw.

use std::collections::BTreeMap;

use glam::{DVec3, Vec3};
use schemars::JsonSchema;
use serde::Serialize;
use slag_common::frames::Aabb;
use slag_common::photo_poses::PhotoPoses;

/// The scene as the page first sees it. Lengths are in world units, metres in a metric scene.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Description {
    /// The program that answers.
    pub program: &'static str,
    /// Name of the scene.
    pub scene: String,
    /// Its generation; cells and scores are of one.
    pub generation: u64,
    /// Gaussians of all cells that can be drawn.
    pub n_gaussians: u64,
    /// Unit vector upward.
    #[schemars(with = "[f32; 3]")]
    pub up: Vec3,
    /// Whether a world unit is a metre.
    pub metric: bool,
    /// Whether the world is east, north and up of a place on the earth.
    pub geographic: bool,
    /// Whether the scene can be asked.
    pub can_ask: bool,
    /// The cells, by id.
    pub cells: Vec<Cell>,
    /// The photos whose poses are known.
    pub views: Vec<Photo>,
    /// What the robot fetched.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fetched: Option<Fetched>,
    /// Where the robot is.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<[f64; 3]>")]
    pub position_m: Option<DVec3>,
}

/// A cell.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Cell {
    /// Its id.
    pub cell: u32,
    /// Its Gaussians; 0 if it is missing.
    pub n_gaussians: u32,
    /// Whether it can be drawn.
    pub state: CellState,
    /// The generation that it is of.
    pub generation: u64,
    /// The box around its Gaussians.
    pub box_m: Corners,
}

/// Whether a cell can be drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CellState {
    /// Yes.
    OnBoard,
    /// Yes, from an earlier generation.
    Stale,
    /// No.
    Missing,
}

/// The corners of a box.
#[derive(Clone, Copy, Debug, Serialize, JsonSchema)]
pub struct Corners {
    /// Smallest.
    #[schemars(with = "[f64; 3]")]
    pub min: DVec3,
    /// Largest.
    #[schemars(with = "[f64; 3]")]
    pub max: DVec3,
}

impl From<Aabb> for Corners {
    fn from(Aabb { min, max }: Aabb) -> Self {
        Self { min, max }
    }
}

/// A photo's name and pose.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Photo {
    /// Its name.
    pub name: String,
    /// Where it was taken.
    #[schemars(with = "[f64; 3]")]
    pub position_m: DVec3,
    /// World from camera (x right, y down, z forward).
    pub rotation_xyzw: [f32; 4],
    /// Its size and focal length, pixels.
    pub width_px: u32,
    /// See `width_px`.
    pub height_px: u32,
    /// See `width_px`.
    pub focal_px: f32,
    /// Whether the program has the picture itself.
    pub has_picture: bool,
}

impl Photo {
    /// Describes the photos of a shard with this origin, without published pictures.
    pub fn of_shard<'a>(origin: DVec3, photos: PhotoPoses<'a>) -> impl Iterator<Item = Self> + use<'a> {
        photos.iter().map(move |(pose, name)| Self {
            name: name.to_owned(),
            position_m: origin + DVec3::from(pose.offset.map(f64::from)),
            rotation_xyzw: pose.rotation_xyzw,
            width_px: pose.width_px,
            height_px: pose.height_px,
            focal_px: pose.focal_px,
            has_picture: false,
        })
    }
}

/// Reply of `GET /v1/view/words`: what the page suggests.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Words {
    /// The generation whose things are counted.
    pub generation: u64,
    /// The names of things, the likeliest first; then the other words of a model that knows some and not others.
    pub words: Vec<Word>,
    /// Whether things have their names; if not, ask again in a second.
    pub complete: bool,
}

impl Words {
    /// Counts things by their best names, each with its confidence; adds the other words of a
    /// `vocabulary`. Ordered by the expected number of things: the sum of confidences.
    pub fn new<'a>(
        generation: u64,
        best: impl IntoIterator<Item = (&'a str, f32)>,
        vocabulary: &[String],
    ) -> Self {
        let mut counts: BTreeMap<&str, (f32, usize)> = BTreeMap::new();
        for (name, confidence) in best {
            let (expected, n_things) = counts.entry(name).or_default();
            (*expected, *n_things) = (*expected + confidence, *n_things + 1);
        }
        let others = vocabulary.iter().filter(|word| !counts.contains_key(word.as_str()));
        let others = others.map(|word| Word { word: word.clone(), n_things: 0 });
        let mut named: Vec<(&str, (f32, usize))> = counts.iter().map(|(name, of)| (*name, *of)).collect();
        named.sort_by(|a, b| b.1.0.total_cmp(&a.1.0));
        let named = named.into_iter().map(|(name, (_, n_things))| Word { word: name.to_owned(), n_things });
        Self { generation, words: named.chain(others).collect(), complete: true }
    }

    pub fn pending(generation: u64) -> Self {
        Self { generation, words: Vec::new(), complete: false }
    }
}

/// A word to ask for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct Word {
    /// The word, or phrase.
    pub word: String,
    /// Things whose best name it is.
    pub n_things: usize,
}

/// The area that a robot fetched.
#[derive(Clone, Copy, Debug, Serialize, JsonSchema)]
pub struct Fetched {
    /// Its middle.
    #[schemars(with = "[f64; 3]")]
    pub centre_m: DVec3,
    /// Its radius.
    pub radius_m: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn likely_names_come_first_and_words_of_no_thing_last() {
        let best = [("mug", 0.4), ("crib", 0.1), ("chair", 0.9), ("crib", 0.2), ("crib", 0.05)];
        let vocabulary = ["lamp", "mug", "sofa"].map(str::to_owned);
        let words = Words::new(7, best, &vocabulary);
        let found: Vec<(&str, usize)> = words.words.iter().map(|of| (&*of.word, of.n_things)).collect();
        assert_eq!(found, [("chair", 1), ("mug", 1), ("crib", 3), ("lamp", 0), ("sofa", 0)]);
        assert!(words.complete && words.generation == 7 && !Words::pending(7).complete);
    }
}
