//! The command line.

use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use clap::builder::NonEmptyStringValueParser;
use clap::{Parser, ValueEnum};
use slag_robot::RobotArgs;

/// Puts a robot's answers on ROS 2 topics and services, without a ROS installation.
#[derive(Debug, Parser)]
#[command(name = "slag-ros", version, allow_negative_numbers = true)]
pub struct Args {
    /// The robot to ask.
    #[command(flatten)]
    pub robot: RobotArgs,
    /// Name of the node, and namespace of its topics.
    #[arg(long, default_value = "slag")]
    pub(crate) name: String,
    /// DDS domain.
    #[arg(long, default_value_t = 0, env = "ROS_DOMAIN_ID", value_parser = clap::value_parser!(u16).range(..=232))]
    pub(crate) domain_id: u16,
    /// Address of an interface to use; all if absent. May be repeated.
    #[arg(long, value_name = "IP")]
    interface: Vec<IpAddr>,
    /// 1: speak with programs of this machine only.
    #[arg(long, value_name = "0|1", default_value_t = 0, env = "ROS_LOCALHOST_ONLY", value_parser = clap::value_parser!(u8).range(..=1))]
    localhost_only: u8,
    /// What the other nodes send messages with; services differ.
    #[arg(long, default_value = "rmw_fastrtps_cpp", env = "RMW_IMPLEMENTATION")]
    pub(crate) rmw: Rmw,
    /// Frame of the scene.
    #[arg(long, value_name = "FRAME", default_value = "map")]
    pub(crate) scene_frame: String,
    /// Frame of the robot, for --position tf.
    #[arg(long, value_name = "FRAME", default_value = "base_link")]
    pub(crate) base_frame: String,
    /// Where the robot's position comes from: it is posted to the robot's program, and answers near it rank
    /// higher.
    #[arg(long, default_value = "tf")]
    pub(crate) position: Source,
    /// Least time between two positions that are posted.
    #[arg(long, value_name = "SECONDS", default_value = "1", value_parser = parse_seconds)]
    pub(crate) position_period: Duration,
    /// Most things in an answer.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    /// Radius of the robot seen from above, metres, for places to stand.
    #[arg(long, value_name = "M", default_value = "0.3", value_parser = parse_metres)]
    pub(crate) robot_radius: f64,
    /// Height of its sensor above the ground, metres.
    #[arg(long, value_name = "M", default_value = "0.4", value_parser = parse_metres)]
    pub(crate) sensor_height: f64,
    /// How close its middle must come to a thing's surface, metres.
    #[arg(long, value_name = "M", default_value = "0.8", value_parser = parse_metres)]
    pub(crate) reach: f64,
    /// Where places to stand are sent to, besides the node's own topic, so that Nav2 drives there.
    #[arg(long, default_value = "none")]
    pub(crate) send_goals: Goals,
    /// Namespace of a camera, such as /camera: its rectified photos (image_rect/compressed, camera_info) tell where
    /// the robot is, if the scene was encoded with --locate.
    #[arg(long, value_name = "NAMESPACE", value_parser = NonEmptyStringValueParser::new())]
    pub(crate) camera: Option<String>,
    /// Frame that odometry keeps: --camera publishes the scene's place in it.
    #[arg(long, value_name = "FRAME", default_value = "odom")]
    pub(crate) fixed_frame: String,
    /// Most points in the clouds of an answer.
    #[arg(long, default_value_t = 3500, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub(crate) points: u32,
}

/// How services travel, which differs between the programs that ROS sends messages with.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum Rmw {
    #[value(name = "rmw_fastrtps_cpp", alias = "rmw_fastrtps_dynamic_cpp")]
    FastDds,
    #[value(name = "rmw_cyclonedds_cpp")]
    CycloneDds,
}

/// Where places to stand are sent to.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum Goals {
    /// Nowhere.
    #[value(alias = "false")]
    None,
    /// The topic /goal_pose, as RViz does: nothing tells how it ended.
    #[value(alias = "true")]
    Topic,
    /// The action /navigate_to_pose: /slag/navigation tells how it goes.
    Action,
}

/// Where the robot's position comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Source {
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
    /// Returns the addresses of the interfaces to use; none: all.
    pub(crate) fn interfaces(&self) -> &[IpAddr] {
        const LOCAL: &[IpAddr] = &[IpAddr::V4(Ipv4Addr::LOCALHOST)];
        if self.localhost_only == 1 { LOCAL } else { &self.interface }
    }
}

fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    seconds.ok_or_else(|| "expected seconds, 0 or more".to_owned())
}

fn parse_metres(text: &str) -> Result<f64, String> {
    let metres = text.parse().ok().filter(|metres: &f64| (0.0..=1000.0).contains(metres));
    metres.ok_or_else(|| "expected metres, 0 to 1000".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ports of DDS end at domain 232 (RTPS 9.6.2.3).
    #[test]
    fn odd_values_are_refused_at_the_start() {
        let parsed = |flag: &str, value: &str| Args::try_parse_from(["slag-ros", flag, value]).is_ok();
        assert!(parsed("--domain-id", "232") && parsed("--reach", "0") && parsed("--camera", "/camera"));
        for (flag, value) in
            [("--domain-id", "233"), ("--robot-radius", "nan"), ("--sensor-height", "-1"), ("--camera", "")]
        {
            assert!(!parsed(flag, value), "{flag} {value}");
        }
    }
}
