//! Request and reply of `what_changed`.

use rmcp::schemars::{self, JsonSchema};
use serde::{Deserialize, Serialize};
use slag_robot::api::changes::{ChangedThing, ChangesReply, ComparedGeneration, MovedThing, NotCompared};
use slag_robot::xyz;

/// Two states of the map, and a place.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Compare {
    /// Kinds of things that may have changed, such as ["chair", "box"]: each changed thing names the one that it
    /// is most like.
    #[serde(default)]
    #[schemars(length(max = 32))]
    pub words: Vec<String>,
    /// The earlier generation; absent: the newest before the present one that the robot remembers.
    pub from_generation: Option<u64>,
    /// Middle of the place, [x, y, z] in the world frame; with `radius`. Absent: everywhere.
    pub near: Option<[f64; 3]>,
    /// Radius of the place.
    #[schemars(range(min = 0.0))]
    pub radius: Option<f64>,
}

/// What changed.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Difference {
    /// Name of the scene.
    pub scene: String,
    /// "m", or "world" where the scale is unknown.
    pub unit: String,
    /// The earlier generation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from_generation: Option<u64>,
    /// The later generation.
    pub to_generation: u64,
    /// Hours between them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hours: Option<f64>,
    /// New things.
    pub appeared: Vec<Thing>,
    /// Things that are gone; they are where they were.
    pub went: Vec<Thing>,
    /// Things that lie elsewhere.
    pub moved: Vec<Move>,
    /// Things that are as they were, anywhere.
    pub n_unchanged: usize,
    /// Things of which it is unknown whether they changed, anywhere: the robot had their place on board in one of
    /// the generations only.
    pub n_not_compared: usize,
    /// Why nothing was compared.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub none: Option<NotCompared>,
}

/// A thing as it is or was.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Thing {
    /// Its name within its generation.
    pub id: String,
    /// Its middle.
    pub position_in_world: [f64; 3],
    /// Edges of its box along the axes.
    pub size: [f64; 3],
    /// The word that it is most like, of those given; a guess: it may be none of them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub most_like: Option<String>,
    /// How much it is like that word; compare things with it, not words.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub likeness: Option<f32>,
}

/// A thing that lies elsewhere.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Move {
    /// As it was.
    pub from: Thing,
    /// As it is.
    pub to: Thing,
    /// Between the positions.
    pub distance: f64,
}

impl Compare {
    pub fn parameters(&self) -> Vec<(&'static str, String)> {
        let words = self.words.iter().map(|word| ("text", word.clone()));
        let more = [
            self.from_generation.map(|generation| ("from", generation.to_string())),
            self.near.map(|near| ("near", xyz(near))),
            self.radius.map(|radius| ("radius", radius.to_string())),
        ];
        words.chain(more.into_iter().flatten()).collect()
    }
}

impl From<ChangedThing> for Thing {
    fn from(thing: ChangedThing) -> Self {
        let (most_like, likeness) = thing.like.map(|like| (like.text, like.score)).unzip();
        Self {
            id: thing.id,
            position_in_world: thing.position_in_world.to_array(),
            size: (thing.box_max_in_world - thing.box_min_in_world).to_array(),
            most_like,
            likeness,
        }
    }
}

impl From<ChangesReply> for Difference {
    fn from(changes: ChangesReply) -> Self {
        let things = |list: Vec<ChangedThing>| list.into_iter().map(Thing::from).collect();
        let secs = |from: ComparedGeneration| {
            changes.to.created_unix_secs.saturating_sub(from.created_unix_secs) as f64
        };
        let moved = |of: MovedThing| Move { from: of.from.into(), to: of.to.into(), distance: of.distance };
        Self {
            scene: changes.scene,
            unit: changes.unit.into(),
            from_generation: changes.from.map(|from| from.generation),
            to_generation: changes.to.generation,
            hours: changes.from.map(|from| secs(from) / 3600.0),
            appeared: things(changes.appeared),
            went: things(changes.went),
            moved: changes.moved.into_iter().map(moved).collect(),
            n_unchanged: changes.n_same + changes.n_stayed,
            n_not_compared: changes.n_not_compared,
            none: changes.none,
        }
    }
}
