//! The command line.

use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use anyhow::Result;
use clap::{Parser, ValueEnum};
use slag_robot::RobotArgs;

use crate::node::{GoalSink, Middleware, PositionSource, Settings};
use crate::stand::Body;

/// Puts a robot's answers on ROS 2 topics and services, without a ROS installation.
#[derive(Debug, Parser)]
#[command(name = "slag-ros", version)]
pub struct Args {
    /// The robot to ask.
    #[command(flatten)]
    pub robot: RobotArgs,
    /// Name of the node, and namespace of its topics.
    #[arg(long, default_value = "slag")]
    name: String,
    /// DDS domain.
    #[arg(long, default_value_t = 0, env = "ROS_DOMAIN_ID")]
    domain_id: u16,
    /// Address of an interface to use; all if absent. May be repeated.
    #[arg(long, value_name = "IP")]
    interface: Vec<IpAddr>,
    /// 1: speak with programs of this machine only.
    #[arg(long, value_name = "0|1", default_value_t = 0, env = "ROS_LOCALHOST_ONLY", value_parser = clap::value_parser!(u8).range(..=1))]
    localhost_only: u8,
    /// What the other nodes send messages with; services differ.
    #[arg(long, default_value = "rmw_fastrtps_cpp", env = "RMW_IMPLEMENTATION")]
    rmw: Rmw,
    /// Frame of the scene.
    #[arg(long, value_name = "FRAME", default_value = "map")]
    scene_frame: String,
    /// Frame of the robot, for --position tf.
    #[arg(long, value_name = "FRAME", default_value = "base_link")]
    base_frame: String,
    /// Where the robot's position comes from: it is posted to the robot's program, and answers near it rank
    /// higher.
    #[arg(long, default_value = "tf")]
    position: Source,
    /// Least time between two positions that are posted.
    #[arg(long, value_name = "SECONDS", default_value_t = 1.0)]
    position_period: f64,
    /// Most things in an answer.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1000))]
    limit: u32,
    /// Radius of the robot seen from above, metres, for places to stand.
    #[arg(long, value_name = "M", default_value_t = 0.3)]
    robot_radius: f64,
    /// Height of its sensor above the ground, metres.
    #[arg(long, value_name = "M", default_value_t = 0.4)]
    sensor_height: f64,
    /// How close its middle must come to a thing's surface, metres.
    #[arg(long, value_name = "M", default_value_t = 0.8)]
    reach: f64,
    /// Where places to stand are sent to, besides the node's own topic, so that Nav2 drives there.
    #[arg(long, default_value = "none")]
    send_goals: Goals,
    /// Namespace of a camera, such as /camera: its rectified photos (image_rect/compressed, camera_info) tell where
    /// the robot is, if the scene was encoded with --locate.
    #[arg(long, value_name = "NAMESPACE")]
    camera: Option<String>,
    /// Frame that odometry keeps: --camera publishes the scene's place in it.
    #[arg(long, value_name = "FRAME", default_value = "odom")]
    fixed_frame: String,
    /// Most points in the clouds of an answer.
    #[arg(long, default_value_t = 3500, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    points: u32,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Rmw {
    #[value(name = "rmw_fastrtps_cpp", alias = "rmw_fastrtps_dynamic_cpp")]
    FastDds,
    #[value(name = "rmw_cyclonedds_cpp")]
    CycloneDds,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Goals {
    /// Nowhere.
    #[value(alias = "false")]
    None,
    /// The topic /goal_pose, as RViz does: nothing tells how it ended.
    #[value(alias = "true")]
    Topic,
    /// The action /navigate_to_pose: /slag/navigation tells how it goes.
    Action,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Source {
    /// The place of --base-frame, from /tf and /tf_static.
    Tf,
    /// /odom, in a frame that /tf connects to the scene's.
    Odom,
    /// /fix, for geo-referenced scenes.
    Fix,
    /// Nothing is posted.
    None,
}

impl Args {
    /// Returns the node's settings.
    pub fn settings(&self) -> Result<Settings> {
        let mut interfaces = self.interface.clone();
        if self.localhost_only == 1 {
            interfaces = vec![Ipv4Addr::LOCALHOST.into()];
        }
        Ok(Settings {
            name: self.name.clone(),
            domain_id: self.domain_id,
            interfaces,
            middleware: match self.rmw {
                Rmw::FastDds => Middleware::FastDds,
                Rmw::CycloneDds => Middleware::CycloneDds,
            },
            scene_frame: self.scene_frame.clone(),
            base_frame: self.base_frame.clone(),
            position: match self.position {
                Source::Tf => PositionSource::Transforms,
                Source::Odom => PositionSource::Odometry,
                Source::Fix => PositionSource::Fix,
                Source::None => PositionSource::Nowhere,
            },
            position_period: Duration::try_from_secs_f64(self.position_period)?,
            limit: self.limit,
            n_points: self.points,
            body: Body {
                radius_m: self.robot_radius,
                sensor_height_m: self.sensor_height,
                reach_m: self.reach,
            },
            camera: self.camera.clone(),
            fixed_frame: self.fixed_frame.clone(),
            goals: match self.send_goals {
                Goals::None => GoalSink::Nowhere,
                Goals::Topic => GoalSink::Topic,
                Goals::Action => GoalSink::Action,
            },
        })
    }
}
