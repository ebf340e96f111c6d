//! The robot's answers as Foxglove's JSON messages (foxglove.dev/docs/sdk/schemas), in metres in the scene's frame.

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde_json::{Value, json};
use slag_robot::api::floor::{Floor, Place};
use slag_robot::{Answer, PointAnswer};

/// Foxglove's codes of field types.
const UINT8: u32 = 1;
const FLOAT32: u32 = 7;
/// Height of letters, metres.
const LETTERS_M: f64 = 0.15;

/// Time and frame of a message.
#[derive(Clone, Copy, Debug)]
pub struct Stamp<'a> {
    /// Nanoseconds since 1970.
    pub time_ns: u64,
    pub frame: &'a str,
}

impl Stamp<'_> {
    fn time(&self) -> Value {
        json!({"sec": self.time_ns / 1_000_000_000, "nsec": self.time_ns % 1_000_000_000})
    }
}

fn vector([x, y, z]: [f64; 3]) -> Value {
    json!({"x": x, "y": y, "z": z})
}

fn pose(position: [f64; 3], [x, y, z, w]: [f64; 4]) -> Value {
    json!({"position": vector(position), "orientation": {"x": x, "y": y, "z": z, "w": w}})
}

/// Returns a `foxglove.SceneUpdate` with each thing's box and words.
pub fn things(stamp: Stamp<'_>, text: &str, answers: &[Answer]) -> Value {
    let entity = |answer: &Answer| {
        let of = &answer.oriented_box;
        let [x, y, _] = answer.position_in_world;
        let above = [x, y, answer.box_max_in_world[2] + LETTERS_M];
        json!({
            "timestamp": stamp.time(), "frame_id": stamp.frame, "id": format!("{text}/{}", answer.rank),
            "lifetime": {"sec": 0, "nsec": 0}, "frame_locked": false,
            "metadata": [
                {"key": "text", "value": text}, {"key": "id", "value": answer.id}, {"key": "score", "value": answer.score.to_string()},
            ],
            "arrows": [], "spheres": [], "cylinders": [], "lines": [], "triangles": [], "models": [],
            "cubes": [{
                "pose": pose(of.centre_in_world.to_array(), of.rotation_world_from_box.to_array()), "size": vector(of.size.to_array()),
                "color": {"r": 0.2, "g": 0.7, "b": 1.0, "a": 0.3},
            }],
            "texts": [{
                "pose": pose(above, [0.0, 0.0, 0.0, 1.0]), "billboard": true, "font_size": LETTERS_M, "scale_invariant": false,
                "color": {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0}, "text": format!("{text} {:.2}", answer.score),
            }],
        })
    };
    json!({"deletions": [], "entities": answers.iter().map(entity).collect::<Vec<_>>()})
}

/// Returns a `foxglove.PointCloud` of Gaussians: x, y, z and score of each as little-endian f32, from the first one's
/// place, as 32 bits do not hold UTM's coordinates.
pub fn points(stamp: Stamp<'_>, answers: &[PointAnswer]) -> Value {
    let origin = answers.first().map_or([0.0; 3], |first| first.position_in_world);
    let numbers = answers.iter().flat_map(|answer| {
        let at = answer.position_in_world;
        let [x, y, z] = [0, 1, 2].map(|axis| (at[axis] - origin[axis]) as f32);
        [x, y, z, answer.score]
    });
    let data: Vec<u8> = numbers.flat_map(f32::to_le_bytes).collect();
    let field = |(name, offset): (&str, u32)| json!({"name": name, "offset": offset, "type": FLOAT32});
    let fields = [("x", 0), ("y", 4), ("z", 8), ("score", 12)].map(field);
    json!({
        "timestamp": stamp.time(), "frame_id": stamp.frame, "pose": pose(origin, [0.0, 0.0, 0.0, 1.0]), "point_stride": 16,
        "fields": fields, "data": BASE64.encode(data),
    })
}

/// Returns a `foxglove.Grid`: 0 unknown, 1 unreachable, 2 reached, 3 obstacle; `None` if runs and size differ.
pub fn ground(stamp: Stamp<'_>, floor: &Floor) -> Option<Value> {
    let number = |place: Place| match place {
        Place::Unknown => 0,
        Place::Ground => 1,
        Place::Reached => 2,
        Place::Obstacle => 3,
    };
    let data: Vec<u8> = floor.cells()?.into_iter().map(number).collect();
    let [n_columns, _] = floor.size;
    Some(json!({
        "timestamp": stamp.time(), "frame_id": stamp.frame, "pose": pose(floor.origin_in_world.to_array(), [0.0, 0.0, 0.0, 1.0]),
        "column_count": n_columns, "cell_size": {"x": floor.cell_m, "y": floor.cell_m}, "row_stride": n_columns, "cell_stride": 1,
        "fields": [{"name": "ground", "offset": 0, "type": UINT8}], "data": BASE64.encode(data),
    }))
}
