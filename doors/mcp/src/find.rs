//! Request and reply of `find`.

use std::collections::BTreeMap;

use rmcp::schemars::{self, JsonSchema};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use slag_robot::{Answer, Nothing, Reply, Results, Witness};

/// Default number of things in an answer: a model reads every one.
const DEFAULT_LIMIT: u32 = 5;
/// Most things in an answer.
const MAX_LIMIT: u32 = 50;

/// What is looked for.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Wanted {
    /// A thing in a few words, such as "red office chair". May name one relation or comparison: "mug on the
    /// table", "nearest door to the sofa", "second largest box".
    #[schemars(length(min = 1, max = 512))]
    pub what: String,
    /// Where the asker is, [x, y, z] in the world frame. Left and right are seen from there, and answers have
    /// their distance from there.
    pub near: Option<[f64; 3]>,
    /// Where the asker looks, radians from the world's x axis towards y. For "left of me" and the like.
    pub heading_rad: Option<f64>,
    /// Only things within this distance of `near`.
    #[schemars(range(min = 0.0))]
    pub radius: Option<f64>,
    /// Most things in the answer; 5 if absent.
    #[schemars(range(min = 1, max = 50))]
    pub limit: Option<u32>,
}

/// The things that match, best first.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Found {
    /// Name of the scene.
    pub scene: String,
    /// The state of the map; positions of different generations are not comparable.
    pub generation: u64,
    /// "m", or "world" where the scale is unknown.
    pub unit: String,
    /// How the words were read, if they name a relation or a comparison.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<serde_json::Map<String, Value>>")]
    pub understood: Option<Value>,
    /// What was asked in place of words that the robot's model does not know.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub asked_as: BTreeMap<String, String>,
    /// Best first. Empty: see `none`.
    pub things: Vec<Thing>,
    /// Whether there are more than were asked for.
    pub more: bool,
    /// Why nothing was found.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub none: Option<Nothing>,
}

/// A thing on the map.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Thing {
    /// Its name within this generation.
    pub id: String,
    /// Its middle, [x, y, z] in the world frame; where the unit is "m", z points up.
    pub position_in_world: [f64; 3],
    /// Edges of its box along the axes.
    pub size: [f64; 3],
    /// How well it matches the words; comparable within one answer only.
    pub score: f32,
    /// Distance from `near`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
    /// Latitude and longitude (WGS 84), where the scene is geo-referenced.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lat_lon_deg: Option<[f64; 2]>,
    /// How well the relation holds, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub degree: Option<f64>,
    /// What the relation holds with.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(default)]
    pub related_to: Vec<Witness>,
}

impl Wanted {
    pub fn request(&self) -> Result<Value, String> {
        let limit = self.limit.unwrap_or(DEFAULT_LIMIT);
        if !(1..=MAX_LIMIT).contains(&limit) {
            return Err(format!("limit is {limit}, expected 1 to {MAX_LIMIT}"));
        }
        let mut request = json!({"texts": [self.what], "limit": limit});
        if let Some(near) = self.near {
            request["near"] = json!(near);
        }
        if let Some(heading_rad) = self.heading_rad {
            request["heading_rad"] = json!(heading_rad);
        }
        match (self.near, self.radius) {
            (Some(near), Some(radius)) => {
                request["region"] = json!({"ball": {"centre": near, "radius": radius}});
            }
            (None, Some(_)) => return Err("radius needs near: within that distance of where?".to_owned()),
            (_, None) => {}
        }
        Ok(request)
    }
}

impl Found {
    pub fn new(reply: Reply) -> Result<Self, String> {
        let [Results { understood, asked_as, none, next_offset, answers }] =
            <[Results; 1]>::try_from(reply.results)
                .map_err(|results| format!("the robot gave {} results to one question", results.len()))?;
        Ok(Self {
            scene: reply.scene,
            generation: reply.generation,
            unit: reply.unit,
            understood,
            asked_as,
            things: answers.into_iter().map(Thing::from).collect(),
            more: next_offset.is_some(),
            none,
        })
    }
}

impl From<Answer> for Thing {
    fn from(answer: Answer) -> Self {
        Self {
            id: answer.id,
            position_in_world: answer.position_in_world,
            size: answer.size,
            score: answer.score,
            distance: answer.distance,
            lat_lon_deg: answer.geographic.map(|place| [place.latitude_deg, place.longitude_deg]),
            degree: answer.degree,
            related_to: answer.related_to,
        }
    }
}
