//! Answers as messages.

use glam::DVec3;
use ros2_client::builtin_interfaces::{Duration, Time};
use slag_robot::api::goal::Goal;
use slag_robot::api::objects::{ObjectPage, OrientedBox};
use slag_robot::{Answer, PointAnswer};

use crate::geometry::{Point, Pose};
use crate::messages::{
    BoundingBox3D, Color, CompressedImage, Detection3D, Detection3DArray, Header, Marker, MarkerArray,
    ObjectHypothesisWithPose, PointCloud2, PointField, PoseStamped, PoseWithCovariance,
};

/// Points per message, to stay below 64 kB, the most that UDP takes at once.
const POINTS_IN_CLOUD: usize = 3500;
/// Things in a list of those on board, for the same reason: one with three names takes 1.3 kB.
pub const MAX_OBJECTS: usize = 45;
/// Bytes of a point: x, y, z and score.
const POINT_BYTES: u32 = 16;
/// `sensor_msgs/PointField.FLOAT32`.
const FLOAT32: u8 = 7;
const CUBE: i32 = 1;
const TEXT_VIEW_FACING: i32 = 9;
const ADD: i32 = 0;
const DELETE_ALL: i32 = 3;
/// Height of a marker's letters, and their distance above the box.
const LETTERS_M: f64 = 0.15;
const BOX_COLOR: Color = Color { r: 0.1, g: 0.7, b: 1.0, a: 0.35 };
const TEXT_COLOR: Color = Color { r: 1.0, g: 1.0, b: 1.0, a: 1.0 };
/// Boxes of flat surfaces have no thickness; viewers refuse markers without extent.
const MIN_EDGE_M: f64 = 0.01;

pub fn header(frame_id: &str) -> Header {
    Header { stamp: Time::now(), frame_id: frame_id.to_owned() }
}

fn pose(oriented: &OrientedBox) -> Pose {
    Pose {
        position: oriented.centre_in_world.to_array().into(),
        orientation: oriented.rotation_world_from_box.to_array().into(),
    }
}

/// Returns a thing with its possible names, best first, with scores. The covariance is unknown: zero.
fn detection<'a>(
    header: &Header,
    id: &str,
    oriented: &OrientedBox,
    classes: impl Iterator<Item = (&'a str, f64)>,
) -> Detection3D {
    let hypothesis = |(class, score): (&str, f64)| ObjectHypothesisWithPose {
        class_id: class.to_owned(),
        score,
        pose: PoseWithCovariance { pose: pose(oriented), covariance: [[0.0; 6]; 6] },
    };
    Detection3D {
        header: header.clone(),
        results: classes.map(hypothesis).collect(),
        bbox: BoundingBox3D { center: pose(oriented), size: oriented.size.to_array().into() },
        id: id.to_owned(),
    }
}

pub fn detections(header: &Header, text: &str, answers: &[Answer]) -> Detection3DArray {
    let detection = |answer: &Answer| {
        let score = f64::from(answer.score);
        detection(header, &answer.id, &answer.oriented_box, std::iter::once((text, score)))
    };
    Detection3DArray { header: header.clone(), detections: answers.iter().map(detection).collect() }
}

/// Returns the things on board with their names and confidences.
pub fn objects(header: &Header, page: &ObjectPage) -> Detection3DArray {
    let detections = page.objects.iter().map(|object| {
        let names = object.names.iter().map(|name| (name.name.as_str(), name.confidence));
        detection(header, &object.id, &object.oriented_box, names)
    });
    Detection3DArray { header: header.clone(), detections: detections.collect() }
}

pub fn goal_pose(header: &Header, goal: &Goal) -> PoseStamped {
    let pose = Pose {
        position: goal.position_in_world.to_array().into(),
        orientation: goal.orientation_xyzw.into(),
    };
    PoseStamped { header: header.clone(), pose }
}

pub fn best_pose(header: &Header, answers: &[Answer]) -> Option<PoseStamped> {
    answers.first().map(|best| PoseStamped { header: header.clone(), pose: pose(&best.oriented_box) })
}

/// Returns boxes with their words and scores; the first marker clears earlier ones.
pub fn markers(header: &Header, text: &str, answers: &[Answer]) -> MarkerArray {
    let mut markers = vec![Marker { action: DELETE_ALL, ..marker(header, "", 0) }];
    for (id, answer) in (0..).zip(answers) {
        let edges = answer.oriented_box.size.max(DVec3::splat(MIN_EDGE_M));
        markers.push(Marker {
            kind: CUBE,
            pose: pose(&answer.oriented_box),
            scale: edges.to_array().into(),
            ..marker(header, "boxes", id)
        });
        let [x, y, _] = answer.oriented_box.centre_in_world.to_array();
        markers.push(Marker {
            kind: TEXT_VIEW_FACING,
            pose: Pose::at([x, y, answer.box_max_in_world[2] + LETTERS_M]),
            scale: Point { x: 0.0, y: 0.0, z: LETTERS_M },
            color: TEXT_COLOR,
            text: format!("{text} {:.2}", answer.score),
            ..marker(header, "words", id)
        });
    }
    MarkerArray { markers }
}

fn marker(header: &Header, ns: &str, id: i32) -> Marker {
    Marker {
        header: header.clone(),
        ns: ns.to_owned(),
        id,
        kind: CUBE,
        action: ADD,
        pose: Pose::at([0.0; 3]),
        scale: Point { x: 1.0, y: 1.0, z: 1.0 },
        color: BOX_COLOR,
        lifetime: Duration::from_nanos(0),
        frame_locked: false,
        points: Vec::new(),
        colors: Vec::new(),
        texture_resource: String::new(),
        texture: CompressedImage { header: header.clone(), format: String::new(), data: Vec::new() },
        uv_coordinates: Vec::new(),
        text: String::new(),
        mesh_resource: String::new(),
        mesh_filename: String::new(),
        mesh_data: Vec::new(),
        mesh_use_embedded_materials: false,
    }
}

/// Returns clouds of all points, each below 64 kB; an empty one without points, which clears a viewer.
pub fn clouds(header: &Header, points: &[PointAnswer]) -> Vec<PointCloud2> {
    let fields = ["x", "y", "z", "score"].iter().zip(0..).map(|(name, at)| PointField {
        name: (*name).to_owned(),
        offset: 4 * at,
        datatype: FLOAT32,
        count: 1,
    });
    let fields: Vec<PointField> = fields.collect();
    let cloud = |points: &[PointAnswer]| {
        let values = points.iter().flat_map(|point| {
            let [x, y, z] = point.position_in_world.map(|value| value as f32);
            [x, y, z, point.score]
        });
        let row_step = POINT_BYTES * points.len() as u32;
        PointCloud2 {
            header: header.clone(),
            height: 1,
            width: points.len() as u32,
            fields: fields.clone(),
            is_bigendian: false,
            point_step: POINT_BYTES,
            row_step,
            data: values.flat_map(f32::to_le_bytes).collect(),
            is_dense: true,
        }
    };
    if points.is_empty() { vec![cloud(&[])] } else { points.chunks(POINTS_IN_CLOUD).map(cloud).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clouds_stay_below_what_udp_takes() {
        let point = |i: usize| PointAnswer { position_in_world: [i as f64, 0.5, -2.0], score: 0.25 };
        let points: Vec<PointAnswer> = (0..9000).map(point).collect();
        let clouds = clouds(&header("map"), &points);
        assert_eq!(clouds.iter().map(|cloud| cloud.width as usize).sum::<usize>(), points.len());
        assert!(clouds.iter().all(|cloud| cloud.data.len() < 60_000));
        assert!(clouds.iter().all(|cloud| cloud.data.len() as u32 == cloud.row_step));
        let second = &clouds[1].data[..16];
        let expected = [POINTS_IN_CLOUD as f32, 0.5, -2.0, 0.25].map(f32::to_le_bytes).concat();
        assert_eq!(second, expected);
        assert_eq!(super::clouds(&header("map"), &[]).len(), 1);
    }
}
