//! What came of it.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;
use slag_math::stats::median;

use super::asked::MIN_SHOWN;
use super::voxels::Voxels;

/// Clearance by which a pose may fall short: a cell of the true map on either side.
const TOLERANCE_M: f64 = 0.03;

/// What the robot's program said of a thing.
#[derive(Clone, Debug)]
pub enum Verdict {
    /// The thing is no object on board.
    NoObject,
    /// No pose, for a reason.
    None(String),
    /// A pose, and the truth about it.
    Pose { clearance_m: f64, is_reached: bool, shown: f64, height_error_m: f64 },
}

impl Verdict {
    fn is_shown(&self) -> bool {
        matches!(self, Self::Pose { shown, .. } if *shown >= MIN_SHOWN)
    }

    /// Returns whether it is wrong.
    pub fn is_fault(&self, is_reachable: bool) -> bool {
        if is_reachable { !self.is_shown() } else { matches!(self, Self::Pose { .. }) }
    }
}

/// The figures over all scenes.
#[derive(Clone, Debug, Default, Serialize)]
pub struct GoalReport {
    /// The scenes.
    pub scenes: Vec<String>,
    /// Voxels called free.
    pub voxels: Voxels,
    /// Things that the robot truly reaches: places within reach from which they are shown.
    pub n_reachable: usize,
    /// Those with a pose from which the true surfaces show them.
    pub n_shown: usize,
    /// Those with a pose from which they do not.
    pub n_hidden: usize,
    /// Those without a pose, by reason; `no-object` are no object on board.
    pub missed: BTreeMap<String, usize>,
    /// Things that the robot truly does not reach.
    pub n_unreachable: usize,
    /// Those with a pose.
    pub n_unreachable_with_pose: usize,
    /// Poses.
    pub n_poses: usize,
    /// Poses closer than the robot's radius to a true surface, by more than 3 cm.
    pub n_too_close: usize,
    /// Poses in places that no way leads to.
    pub n_cut_off: usize,
    /// Largest distance of a pose's ground from the true one.
    pub max_height_error_m: f64,
    /// Time of each request.
    #[serde(skip)]
    pub millis: Vec<f64>,
}

impl GoalReport {
    pub(super) fn count(&mut self, radius_m: f64, is_reachable: bool, verdict: &Verdict) {
        if let Verdict::Pose { clearance_m, is_reached, height_error_m, .. } = verdict {
            self.n_poses += 1;
            self.n_cut_off += usize::from(!is_reached);
            self.n_too_close += usize::from(*clearance_m < radius_m - TOLERANCE_M);
            self.max_height_error_m = self.max_height_error_m.max(*height_error_m);
        }
        if !is_reachable {
            self.n_unreachable += 1;
            self.n_unreachable_with_pose += usize::from(matches!(verdict, Verdict::Pose { .. }));
            return;
        }
        self.n_reachable += 1;
        match verdict {
            Verdict::NoObject => *self.missed.entry("no-object".into()).or_default() += 1,
            Verdict::None(reason) => *self.missed.entry(reason.clone()).or_default() += 1,
            verdict if verdict.is_shown() => self.n_shown += 1,
            Verdict::Pose { .. } => self.n_hidden += 1,
        }
    }
}

impl fmt::Display for GoalReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |n: u64, of: u64| if of == 0 { 0.0 } else { 100.0 * n as f64 / of as f64 };
        let Voxels { n_free, n_false, len_bytes } = self.voxels;
        writeln!(f, "{} scenes: {}", self.scenes.len(), self.scenes.join(", "))?;
        writeln!(
            f,
            "free voxels        {n_free}, {n_false} of them false: {:.3} %",
            percent(n_false, n_free)
        )?;
        writeln!(f, "occupancy          {len_bytes} bytes in each profile")?;
        let share = percent(self.n_shown as u64, self.n_reachable as u64);
        writeln!(
            f,
            "reachable things   {}, {} with a pose that shows them: {share:.1} %",
            self.n_reachable, self.n_shown
        )?;
        writeln!(
            f,
            "                   {} with a pose that does not; without a pose: {:?}",
            self.n_hidden, self.missed
        )?;
        writeln!(
            f,
            "unreachable things {}, {} with a pose",
            self.n_unreachable, self.n_unreachable_with_pose
        )?;
        writeln!(
            f,
            "poses              {}, {} closer to a surface than the radius, {} cut off; ground off by at most {:.3} m",
            self.n_poses, self.n_too_close, self.n_cut_off, self.max_height_error_m
        )?;
        let mut millis = self.millis.clone();
        let worst = millis.iter().copied().fold(0.0, f64::max);
        writeln!(
            f,
            "requests           {:.1} ms median, {worst:.1} ms at most",
            median(&mut millis).unwrap_or(0.0)
        )
    }
}
