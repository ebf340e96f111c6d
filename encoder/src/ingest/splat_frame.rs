//! The frame of the splat against that of the poses: which file says so.

use std::fmt;
use std::path::{Path, PathBuf};

use slag_common::poses::{AppliedTransform, FRAME_FILE, PoseError, PoseSource, SplatFrame, SplatFromPoses};
use slag_common::{Gaussians, Similarity};

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum FrameChoice {
    /// By `dataparser_transforms.json` beside the splat, if there is one.
    #[default]
    Auto,
    /// Nowhere: splat and poses have one frame.
    None,
    File(PathBuf),
}

/// What a splat file has in place of logarithms of scales and logits of opacities.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Activated {
    pub scales: bool,
    pub opacities: bool,
}

impl Activated {
    /// Restores the file's values in a splat that was decoded as usual.
    pub(crate) fn undo(self, scene: &mut Gaussians) {
        if self != Self::default() {
            scene.deactivate(self.scales, self.opacities);
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct FoundFrame {
    pub path: PathBuf,
    pub stated: SplatFromPoses,
}

/// Finds the file with the frame of the splat at `scene`; `source` and `applied` are those of the poses.
pub(crate) fn find_frame(
    scene: &Path,
    choice: &FrameChoice,
    source: PoseSource,
    applied: Option<AppliedTransform>,
) -> Result<Option<FoundFrame>, PoseError> {
    let path = match choice {
        FrameChoice::None => return Ok(None),
        FrameChoice::File(path) => path.clone(),
        FrameChoice::Auto => {
            let beside = scene.with_file_name(FRAME_FILE);
            if !beside.is_file() {
                return Ok(None);
            }
            beside
        }
    };
    let stated = SplatFrame::read(&path)?.splat_from_poses(source, applied);
    Ok(Some(FoundFrame { path, stated }))
}

impl FoundFrame {
    pub fn splat_from_poses(&self) -> Similarity {
        self.stated.similarity
    }
}

/// Moves the splat at `path` into the poses' world if a file states its frame, and then drops harmonics above degree 0.
/// `source` and `applied` are those of the poses.
pub fn to_poses(
    scene: &mut Gaussians,
    path: &Path,
    choice: &FrameChoice,
    source: PoseSource,
    applied: Option<AppliedTransform>,
) -> Result<(), PoseError> {
    if let Some(frame) = find_frame(path, choice, source, applied)? {
        tracing::info!("{frame}; the splat is brought into the world of the poses");
        frame.stated.similarity.inverse().transform_gaussians(scene);
    }
    Ok(())
}

impl fmt::Display for FoundFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let SplatFromPoses { similarity, begins_at } = self.stated;
        write!(
            f,
            "{}: the splat's world is that of the poses times {:.6}, rotated by {:.2} degrees and moved; the transform \
             begins at {begins_at}",
            self.path.display(),
            similarity.scale,
            similarity.rotation.angle_between(Similarity::IDENTITY.rotation).to_degrees(),
        )
    }
}
