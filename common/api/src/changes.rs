//! `GET /v1/changes`.

use std::borrow::Cow;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{FRAME, Geographic, UNITS};

/// Nothing was compared: the robot remembers no earlier generation.
pub const NO_EARLIER: &str = "no-earlier-generation";

/// The changes from one generation to another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "Changes")]
pub struct ChangesReply {
    /// Name of the scene.
    pub scene: String,
    /// Frame of every position.
    #[schemars(extend("enum" = [FRAME]))]
    pub frame: Cow<'static, str>,
    /// Unit of every position and length: `m`, or `world` if the scene is not metric.
    #[schemars(extend("enum" = UNITS))]
    pub unit: Cow<'static, str>,
    /// The earlier generation; absent if the robot remembers none.
    pub from: Option<ComparedGeneration>,
    /// The later one.
    pub to: ComparedGeneration,
    /// All generations that can be compared, ascending.
    pub generations: Vec<u64>,
    /// Things of exactly the same Gaussians, anywhere.
    pub n_same: usize,
    /// Things at the same place whose Gaussians changed, anywhere.
    pub n_stayed: usize,
    /// Things that are not compared, anywhere: only one of the generations knows their place, the splat there is the
    /// same, or they are sparse pieces of things that both have.
    pub n_not_compared: usize,
    /// Things that are new.
    pub appeared: Vec<ChangedThing>,
    /// Things that are gone.
    pub went: Vec<ChangedThing>,
    /// Things that lie elsewhere.
    pub moved: Vec<MovedThing>,
    /// Why nothing was compared.
    pub none: Option<NotCompared>,
}

/// A generation that was compared.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "Compared")]
pub struct ComparedGeneration {
    /// Its number.
    pub generation: u64,
    /// When it was made, Unix seconds.
    pub created_unix_secs: u64,
}

/// Why nothing was compared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NotCompared {
    /// The reason.
    #[schemars(extend("enum" = [NO_EARLIER]))]
    pub kind: Cow<'static, str>,
    /// The same in a sentence.
    pub detail: String,
}

/// A thing as it is or was.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ChangedThing {
    /// Its id in its generation: `o` and 16 hex digits.
    pub id: String,
    /// Mean of its Gaussians inside the box.
    #[schemars(with = "[f64; 3]")]
    pub position_in_world: DVec3,
    /// The same on the earth, if the scene is geo-referenced.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geographic: Option<Geographic>,
    /// Smallest corner of its box.
    #[schemars(with = "[f64; 3]")]
    pub box_min_in_world: DVec3,
    /// Largest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_max_in_world: DVec3,
    /// Its Gaussians in the whole scene.
    pub n_gaussians_in_scene: u32,
    /// Name of the photo that shows it best.
    pub photo: String,
    /// The text that it is most like, if the request has any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub like: Option<Likeness>,
}

/// The text that a thing is most like.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Likeness {
    /// The text.
    pub text: String,
    /// Cosine of its vector and the mean of the thing's masks' vectors.
    pub score: f32,
}

/// A thing that lies elsewhere.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MovedThing {
    /// As it was.
    pub from: ChangedThing,
    /// As it is.
    pub to: ChangedThing,
    /// Between the positions.
    pub distance: f64,
}
