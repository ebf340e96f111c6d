//! The reply to `/v1/query`.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_api::Geographic;
use slag_api::objects::OrientedBox;

/// The results of a request, one for each question. Members unused by clients here are left out.
#[derive(Clone, Debug, Deserialize)]
pub struct Reply<A = Answer> {
    pub scene: String,
    pub generation: u64,
    pub frame: String,
    /// `m`, or `world` for scenes whose scale is unknown.
    pub unit: String,
    pub results: Vec<Results<A>>,
}

#[derive(Clone, Debug, Deserialize)]
pub struct Results<A = Answer> {
    /// The parsed phrase of a text with a relation.
    pub understood: Option<serde_json::Value>,
    /// Replacements of words unknown to the robot's model.
    #[serde(default)]
    pub asked_as: BTreeMap<String, String>,
    pub none: Option<Nothing>,
    pub next_offset: Option<u64>,
    /// Best first.
    pub answers: Vec<A>,
}

/// Why nothing was found.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct Nothing {
    /// "below-threshold", "no-such-thing", "no-such-pair", "too-few", "not-in-region", "not-looked-there" or others.
    pub kind: String,
    /// The same in a sentence.
    pub detail: String,
}

#[derive(Clone, Debug, Deserialize)]
pub struct Answer {
    /// 1 is the best.
    pub rank: u32,
    /// Stable within a generation.
    pub id: String,
    pub position_in_world: [f64; 3],
    pub geographic: Option<Geographic>,
    pub box_min_in_world: [f64; 3],
    pub box_max_in_world: [f64; 3],
    /// Edges of that box.
    pub size: [f64; 3],
    pub oriented_box: OrientedBox,
    pub score: f32,
    /// Distance from the asker, if the request had a position.
    pub distance: Option<f64>,
    /// How well the relation holds, 0 to 1.
    pub degree: Option<f64>,
    #[serde(default)]
    pub related_to: Vec<Witness>,
}

#[derive(Clone, Copy, Debug, Deserialize)]
pub struct PointAnswer {
    pub position_in_world: [f64; 3],
    pub score: f32,
}

/// The other thing of a relation.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "Related")]
pub struct Witness {
    /// Its words.
    pub thing: String,
    /// Its id; absent for the asker.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// Its middle.
    pub position_in_world: [f64; 3],
}
