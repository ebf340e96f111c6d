//! What `what_changed` takes and gives.

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
    /// Returns the parameters of `GET /v1/changes`.
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

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// Each parameter is sent under its name in the robot's interface, and an absent one is not sent.
    #[test]
    fn asks_for_what_is_given() {
        let compare: Compare = serde_json::from_value(json!({
            "words": ["chair", "a box"], "from_generation": 3, "near": [1.5, -2.0, 0.25], "radius": 4.5,
        }))
        .expect("fits");
        let expected =
            [("text", "chair"), ("text", "a box"), ("from", "3"), ("near", "1.5,-2,0.25"), ("radius", "4.5")];
        let found = compare.parameters();
        assert_eq!(found.iter().map(|(name, value)| (*name, value.as_str())).collect::<Vec<_>>(), expected);
        let nothing: Compare = serde_json::from_value(json!({})).expect("fits");
        assert!(nothing.parameters().is_empty());
    }

    /// A reply with every member, and what becomes of each: 5400 s are 1.5 h, 3 + 4 things are unchanged, a box
    /// from (1, 2, 3) to (2, 4, 6) has edges of 1, 2 and 3.
    #[test]
    fn replies_become_differences() {
        let thing = |id: &str| {
            json!({
                "id": id, "position_in_world": [1.5, 3.0, 4.5],
                "box_min_in_world": [1.0, 2.0, 3.0], "box_max_in_world": [2.0, 4.0, 6.0],
                "n_gaussians_in_scene": 9, "photo": "p.jpg", "like": { "text": "chair", "score": 0.5 },
            })
        };
        let bare = json!({
            "id": "o2", "position_in_world": [0.0, 0.0, 0.0],
            "box_min_in_world": [-1.0, -1.0, -1.0], "box_max_in_world": [1.0, 1.0, 1.0],
            "n_gaussians_in_scene": 9, "photo": "p.jpg",
        });
        let reply = json!({
            "scene": "yard", "unit": "m", "frame": "world", "generations": [4, 6],
            "from": { "generation": 4, "created_unix_secs": 1000 },
            "to": { "generation": 6, "created_unix_secs": 6400 },
            "n_same": 3, "n_stayed": 4, "n_not_compared": 5,
            "appeared": [thing("o1")], "went": [bare],
            "moved": [{ "from": thing("o3"), "to": thing("o4"), "distance": 2.5 }], "none": null,
        });
        let of = |reply: &serde_json::Value| {
            let changes: ChangesReply = serde_json::from_value(reply.clone()).expect("a reply");
            json!(Difference::from(changes))
        };
        let shown = |id: &str| {
            json!({
                "id": id, "position_in_world": [1.5, 3.0, 4.5], "size": [1.0, 2.0, 3.0],
                "most_like": "chair", "likeness": 0.5,
            })
        };
        let expected = json!({
            "scene": "yard", "unit": "m", "from_generation": 4, "to_generation": 6, "hours": 1.5,
            "appeared": [shown("o1")],
            "went": [{ "id": "o2", "position_in_world": [0.0, 0.0, 0.0], "size": [2.0, 2.0, 2.0] }],
            "moved": [{ "from": shown("o3"), "to": shown("o4"), "distance": 2.5 }],
            "n_unchanged": 7, "n_not_compared": 5,
        });
        assert_eq!(of(&reply), expected);

        // The clock of the machine that encoded may have gone backwards; and there may be nothing to compare with.
        let mut early = reply.clone();
        early["to"]["created_unix_secs"] = 500.into();
        assert_eq!(of(&early)["hours"], 0.0);
        let mut none = reply;
        (none["from"], none["none"]) =
            (json!(null), json!({ "kind": "no-earlier-generation", "detail": "the robot has had none" }));
        let none = of(&none);
        assert_eq!(
            none["none"],
            json!({ "kind": "no-earlier-generation", "detail": "the robot has had none" })
        );
        assert!(none.get("hours").is_none() && none.get("from_generation").is_none());
    }
}
