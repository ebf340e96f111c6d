//! Request and reply of `describe_place`.

use rmcp::schemars::{self, JsonSchema};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use slag_robot::api::map::{MapCell, MapStatus, MissingCell};
use slag_robot::{Reply, Results, Robot, RobotError};

/// Most words in a request, the limit of one question to the robot.
const MAX_WORDS: usize = 32;
/// Most things counted per kind; beyond, the count is marked as incomplete.
const MAX_COUNTED: u32 = 100;
const SECS_PER_HOUR: f64 = 3600.0;

/// The place, and what to count there.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Asked {
    /// Kinds of things to count, such as ["chair", "table", "door"]: how many things match each.
    #[serde(default)]
    #[schemars(length(max = 32))]
    pub words: Vec<String>,
    /// Middle of the place, [x, y, z] in the world frame; with `radius`. Absent: all that is on board.
    pub near: Option<[f64; 3]>,
    /// Radius of the place.
    #[schemars(range(min = 0.0))]
    pub radius: Option<f64>,
}

/// What the robot has on board.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Description {
    /// Name of the scene.
    pub scene: String,
    /// The state of the map.
    pub generation: u64,
    /// "m", or "world" where the scale is unknown.
    pub unit: String,
    /// Whether z is known to point up.
    pub z_is_up: bool,
    /// Hours since the map was published.
    pub age_hours: f64,
    /// Whether the map is past the time for which its publisher vouches.
    pub is_expired: bool,
    /// Least and greatest corner of all that is on board, whatever the place asked for; absent if nothing is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub box_in_world: Option<[[f64; 3]; 2]>,
    /// Whether the map on board covers the whole place: "not found" then means that it is not there.
    pub is_complete: bool,
    /// Things in the place, named or not.
    pub n_things: usize,
    /// What matches each of the words.
    pub kinds: Vec<Kind>,
}

/// Things that match a word.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Kind {
    /// The word.
    pub word: String,
    /// How many there are; at least as many if `more`.
    pub n: usize,
    /// Whether there are more.
    pub more: bool,
    /// Where the best match is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_position_in_world: Option<[f64; 3]>,
}

/// Returns a ball's centre and radius; `None`: everywhere.
pub fn ball(near: Option<[f64; 3]>, radius: Option<f64>) -> Result<Option<([f64; 3], f64)>, String> {
    match (near, radius) {
        (None, None) => Ok(None),
        (Some(near), Some(radius)) => Ok(Some((near, radius))),
        _ => Err("near and radius go together: both, or neither for everywhere".to_owned()),
    }
}

impl Asked {
    pub fn describe(&self, robot: &Robot) -> Result<Description, String> {
        let ball = ball(self.near, self.radius)?;
        if self.words.len() > MAX_WORDS {
            return Err(format!("there are {} words, expected at most {MAX_WORDS}", self.words.len()));
        }
        let refused = |error: RobotError| error.to_string();
        let place = robot.place().map_err(refused)?;
        let n_things = robot.n_objects(ball).map_err(refused)?;
        let kinds = match self.words.is_empty() {
            true => Vec::new(),
            false => self.kinds(robot.ask(&self.request(ball)).map_err(refused)?, place.generation)?,
        };
        Ok(Description::new(place, ball, n_things, kinds))
    }

    fn request(&self, ball: Option<([f64; 3], f64)>) -> Value {
        let mut request = json!({
            "texts": self.words, "kind": "objects", "relations": false, "limit": MAX_COUNTED,
        });
        if let Some((centre, radius)) = ball {
            request["region"] = json!({"ball": {"centre": centre, "radius": radius}});
        }
        request
    }

    fn kinds(&self, reply: Reply, generation: u64) -> Result<Vec<Kind>, String> {
        if reply.generation != generation {
            return Err(format!("generation {generation} became {} meanwhile; ask again", reply.generation));
        }
        let kind = |(word, results): (&String, Results)| Kind {
            word: word.clone(),
            n: results.answers.len(),
            more: results.next_offset.is_some(),
            best_position_in_world: results.answers.first().map(|best| best.position_in_world),
        };
        Ok(self.words.iter().zip(reply.results).map(kind).collect())
    }
}

impl Description {
    fn new(place: MapStatus, ball: Option<([f64; 3], f64)>, n_things: usize, kinds: Vec<Kind>) -> Self {
        let on_board = place.cells.iter().map(MapCell::bounds).reduce(|a, b| a.union(b));
        let is_missing = |cell: &MissingCell| match ball {
            Some((centre, radius)) => cell.bounds().distance_to(centre.into()) <= radius,
            None => cell.is_wanted,
        };
        let is_here = |cell: &MapCell| {
            ball.is_none_or(|(centre, radius)| cell.bounds().distance_to(centre.into()) <= radius)
        };
        Self {
            scene: place.scene,
            generation: place.generation,
            unit: place.unit.into(),
            z_is_up: place.z_is_up,
            age_hours: place.age_secs as f64 / SECS_PER_HOUR,
            is_expired: place.is_expired,
            box_in_world: on_board.map(|bounds| [bounds.min, bounds.max].map(|corner| corner.to_array())),
            is_complete: !place.missing.iter().any(is_missing) && place.cells.iter().any(is_here),
            n_things,
            kinds,
        }
    }
}
