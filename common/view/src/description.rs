//! `GET /v1/view`: what there is to draw.

use std::time::{Duration, Instant};

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
    /// Describes the photos of a shard with this origin, whose pictures were not published.
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
    /// Those of most things first: the words that the text model knows, or of one that takes any text everyday
    /// words that find something.
    pub words: Vec<Word>,
    /// Whether all are counted; if not, the next request goes on.
    pub complete: bool,
}

impl Words {
    /// Most words that are counted: lists of phrases for people are shorter.
    pub const MAX: usize = 2048;
    /// Time after which a request encodes no further everyday word: questions wait meanwhile.
    const ENCODING: Duration = Duration::from_millis(500);

    /// Encodes words as long as there is time for it. Returns what `encode` made of them, and whether all were
    /// encoded.
    pub fn encode<'a, V, E>(
        words: impl IntoIterator<Item = &'a str>,
        mut encode: impl FnMut(&'a str) -> Result<V, E>,
    ) -> Result<(Vec<V>, bool), E> {
        let (started, mut encoded) = (Instant::now(), Vec::new());
        for word in words {
            if started.elapsed() > Self::ENCODING {
                return Ok((encoded, false));
            }
            encoded.push(encode(word)?);
        }
        Ok((encoded, true))
    }

    /// Orders words by their things; equal ones stay in the model's order.
    pub fn new(generation: u64, mut words: Vec<Word>, complete: bool) -> Self {
        words.sort_by_key(|word| std::cmp::Reverse(word.n_things));
        Self { generation, words, complete }
    }
}

/// A word to ask for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct Word {
    /// The word, or phrase.
    pub word: String,
    /// Things that are found by it.
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
    fn words_are_encoded_while_there_is_time() {
        let of = |pause: Duration| {
            Words::encode(["mug", "chair", "lamp"], |word| {
                std::thread::sleep(pause);
                Ok::<_, ()>(word.len())
            })
        };
        assert_eq!(of(Duration::ZERO), Ok((vec![3, 5, 4], true)));
        // What has begun is finished.
        assert_eq!(of(Words::ENCODING), Ok((vec![3], false)));
        assert_eq!(
            Words::encode(["mug", "chair"], |word| if word == "mug" { Ok(()) } else { Err(word) }),
            Err("chair")
        );
    }
}
