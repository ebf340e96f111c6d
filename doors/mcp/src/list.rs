//! Request and reply of `list`.

use rmcp::schemars::{self, JsonSchema};
use serde::{Deserialize, Serialize};
use slag_robot::api::objects::{Name, ObjectOnBoard, ObjectPage};
use slag_robot::xyz;

use crate::place::ball;

/// Default number of things in an answer: a model reads every one.
const DEFAULT_LIMIT: u32 = 30;
/// Most things in an answer.
const MAX_LIMIT: u32 = 200;

/// Which things are listed.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Listing {
    /// Middle of the place, [x, y, z] in the world frame; with `radius`. Absent: everywhere.
    pub near: Option<[f64; 3]>,
    /// Radius of the place.
    #[schemars(range(min = 0.0))]
    pub radius: Option<f64>,
    /// Whether things come by their names; else the largest first.
    #[serde(default)]
    pub by_name: bool,
    /// Most things in the answer; 30 if absent.
    #[schemars(range(min = 1, max = 200))]
    pub limit: Option<u32>,
    /// `next_after` of an earlier answer to the same request: lists the things after those.
    pub after: Option<String>,
}

/// The things on the map.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Listed {
    /// Name of the scene.
    pub scene: String,
    /// The state of the map.
    pub generation: u64,
    /// "m", or "world" where the scale is unknown.
    pub unit: String,
    /// Whether things have names: if not, ask again in a few seconds, or use find.
    pub named: bool,
    /// Things in the place, listed or not.
    pub n_things: usize,
    /// The things.
    pub things: Vec<Thing>,
    /// What `after` takes for the next things; absent: these are all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub next_after: Option<String>,
}

/// A thing on the map.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Thing {
    /// Its name within this generation.
    pub id: String,
    /// What it is called, best first, each with its share among names: it orders them, and is no chance to be right.
    pub names: Vec<Name>,
    /// Its middle, [x, y, z] in the world frame.
    pub position_in_world: [f64; 3],
    /// Edges of its box along the axes.
    pub size: [f64; 3],
}

impl Listing {
    pub fn parameters(&self) -> Result<Vec<(&'static str, String)>, String> {
        let limit = self.limit.unwrap_or(DEFAULT_LIMIT);
        if !(1..=MAX_LIMIT).contains(&limit) {
            return Err(format!("limit is {limit}, expected 1 to {MAX_LIMIT}"));
        }
        let sort = if self.by_name { "name" } else { "area" };
        let mut parameters = vec![("limit", limit.to_string()), ("sort", sort.to_owned())];
        if let Some((centre, radius)) = ball(self.near, self.radius)? {
            parameters.extend([("near", xyz(centre)), ("radius", radius.to_string())]);
        }
        parameters.extend(self.after.iter().map(|after| ("after", after.clone())));
        Ok(parameters)
    }
}

impl From<ObjectPage> for Listed {
    fn from(page: ObjectPage) -> Self {
        let ObjectPage { scene, generation, unit, named, n_objects, next_after, objects, .. } = page;
        let things = objects.into_iter().map(Thing::from).collect();
        Self { scene, generation, unit: unit.into(), named, n_things: n_objects, things, next_after }
    }
}

impl From<ObjectOnBoard> for Thing {
    fn from(thing: ObjectOnBoard) -> Self {
        Self {
            id: thing.id,
            names: thing.names,
            position_in_world: thing.position_in_world.to_array(),
            size: (thing.box_max_in_world - thing.box_min_in_world).to_array(),
        }
    }
}
