//! Messages of ROS packages, with members in wire order.

use ros2_client::Message;
use ros2_client::builtin_interfaces::{Duration, Time};
use serde::{Deserialize, Serialize};

use crate::geometry::{Point, Pose, Quaternion, Vector3};

macro_rules! messages {
    ($($(#[$doc:meta])* $name:ident { $($member:ident: $kind:ty),* $(,)? })*) => {
        $(
            $(#[$doc])*
            #[derive(Clone, Debug, Serialize, Deserialize)]
            pub struct $name { $(pub $member: $kind),* }
            impl Message for $name {}
        )*
    };
}

messages! {
    /// `std_msgs/String`.
    Text { data: String }
    /// `std_msgs/Header`.
    Header { stamp: Time, frame_id: String }
    /// `std_msgs/ColorRGBA`.
    Color { r: f32, g: f32, b: f32, a: f32 }
    /// `geometry_msgs/PoseStamped`.
    PoseStamped { header: Header, pose: Pose }
    /// `geometry_msgs/PoseWithCovariance`. The covariance is row-major.
    PoseWithCovariance { pose: Pose, covariance: [[f64; 6]; 6] }
    /// `geometry_msgs/PoseWithCovarianceStamped`.
    PoseWithCovarianceStamped { header: Header, pose: PoseWithCovariance }
    /// `geometry_msgs/TransformStamped`.
    TransformStamped { header: Header, child_frame_id: String, translation: Vector3, rotation: Quaternion }
    /// `tf2_msgs/TFMessage`.
    Transforms { transforms: Vec<TransformStamped> }
    /// `nav_msgs/Odometry`, as far as it is read.
    Odometry { header: Header, child_frame_id: String, pose: PoseWithCovariance }
    /// `sensor_msgs/NavSatFix`, as far as it is read. A negative status is no fix.
    NavSatFix { header: Header, status: i8, service: u16, latitude: f64, longitude: f64, altitude: f64 }
    /// `sensor_msgs/CameraInfo`, as far as it is read: up to P, of rectified images.
    CameraInfo {
        header: Header, height: u32, width: u32, distortion_model: String, d: Vec<f64>, k: [f64; 9], r: [f64; 9],
        p: [[f64; 4]; 3],
    }
    /// `sensor_msgs/PointField`.
    PointField { name: String, offset: u32, datatype: u8, count: u32 }
    /// `sensor_msgs/PointCloud2`.
    PointCloud2 {
        header: Header, height: u32, width: u32, fields: Vec<PointField>, is_bigendian: bool, point_step: u32,
        row_step: u32, data: Vec<u8>, is_dense: bool,
    }
    /// `sensor_msgs/CompressedImage`.
    CompressedImage { header: Header, format: String, data: Vec<u8> }
    /// `vision_msgs/ObjectHypothesisWithPose`; the hypothesis is its first two members.
    ObjectHypothesisWithPose { class_id: String, score: f64, pose: PoseWithCovariance }
    /// `vision_msgs/BoundingBox3D`.
    BoundingBox3D { center: Pose, size: Vector3 }
    /// `vision_msgs/Detection3D`.
    Detection3D { header: Header, results: Vec<ObjectHypothesisWithPose>, bbox: BoundingBox3D, id: String }
    /// `vision_msgs/Detection3DArray`.
    Detection3DArray { header: Header, detections: Vec<Detection3D> }
    /// `visualization_msgs/UVCoordinate`.
    UvCoordinate { u: f32, v: f32 }
    /// `visualization_msgs/Marker`; the mesh file is the two members before the last.
    Marker {
        header: Header, ns: String, id: i32, kind: i32, action: i32, pose: Pose, scale: Vector3, color: Color,
        lifetime: Duration, frame_locked: bool, points: Vec<Point>, colors: Vec<Color>, texture_resource: String,
        texture: CompressedImage, uv_coordinates: Vec<UvCoordinate>, text: String, mesh_resource: String,
        mesh_filename: String, mesh_data: Vec<u8>, mesh_use_embedded_materials: bool,
    }
    /// `visualization_msgs/MarkerArray`.
    MarkerArray { markers: Vec<Marker> }
    /// `nav_msgs/MapMetaData`.
    MapMetaData { map_load_time: Time, resolution: f32, width: u32, height: u32, origin: Pose }
    /// `nav_msgs/OccupancyGrid`: 0 free, 100 occupied, -1 unknown.
    OccupancyGrid { header: Header, info: MapMetaData, data: Vec<i8> }
    /// Goal of `nav2_msgs/NavigateToPose`.
    NavigationGoal { pose: PoseStamped, behavior_tree: String }
    NavigationFeedback {
        current_pose: PoseStamped, navigation_time: Duration, estimated_time_remaining: Duration,
        number_of_recoveries: i16, distance_remaining: f32,
    }
    /// Request of `slag_msgs/srv/Stand`.
    StandRequest { text: String }
    /// Reply of `slag_msgs/srv/Stand`.
    StandReply {
        success: bool, message: String, pose: PoseStamped, clearance_m: f64, visible_share: f64, way_m: f64,
    }
    /// Request of `slag_msgs/srv/Find`.
    FindRequest { text: String, limit: u32 }
    /// Reply of `slag_msgs/srv/Find`.
    FindReply { success: bool, message: String, detections: Detection3DArray }
}

// A message without members has one on the wire. Later versions add an error text behind the code, which is not
// read.
#[cfg(not(feature = "jazzy"))]
messages! {
    /// Result of `nav2_msgs/NavigateToPose`.
    NavigationResult { structure_needs_at_least_one_member: u8 }
}
#[cfg(feature = "jazzy")]
messages! {
    /// Result of `nav2_msgs/NavigateToPose`.
    NavigationResult { error_code: u16 }
}
