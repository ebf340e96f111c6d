//! What makes two encodes the same, so that one may go on from the other's views.

use rayon::prelude::*;
use serde::Serialize;
use slag_common::{Gaussians, Hash32, Intrinsics, View};

use super::engines::Engines;
use super::error::EncodeError;
use super::plan::Inputs;
use super::settings::{EncodeSettings, LONG_BORDERS, MAX_RASTER_WIDTH_PX, ViewSettings};
use crate::cells::CellLimits;
use crate::segment::Segmenter;

/// Version of the steps from masks to contributions; another number is another encode.
const REGIONS_VERSION: u32 = 3;

/// Everything on which the contributions of views depend: files by their content, settings as they are.
///
/// A setting is part of it by being a field of [`ViewSettings`].
#[derive(Serialize)]
struct Identity<'a> {
    program: &'static str,
    regions: (u32, f64, u32),
    encoder: Hash32,
    session: Session,
    segmenter: String,
    perturbation: Option<String>,
    scene: Hash32,
    views: Vec<ViewIdentity<'a>>,
    settings: &'a ViewSettings,
    cells: CellLimits,
}

/// How models run: other hardware and another split of the work change vectors in the last bits.
#[derive(Serialize)]
struct Session {
    providers: Vec<String>,
    n_threads: usize,
}

#[derive(Serialize)]
struct ViewIdentity<'a> {
    name: &'a str,
    /// Hash of the photo's file; absent where it cannot be read.
    photo: Option<Hash32>,
    intrinsics: Intrinsics,
    camera_from_world: glam::DAffine3,
}

/// Returns the hash of everything on which the contributions of views depend.
///
/// # Errors
/// [`EncodeError::Segment`] if a file of masks cannot be read.
pub(super) fn identity(
    settings: &EncodeSettings,
    engines: &Engines<'_>,
    segmenter: &dyn Segmenter,
    inputs: &Inputs,
) -> Result<Hash32, EncodeError> {
    let Engines { models, session, perturbation, .. } = engines;
    let identity = Identity {
        program: env!("CARGO_PKG_VERSION"),
        regions: (REGIONS_VERSION, LONG_BORDERS, MAX_RASTER_WIDTH_PX),
        encoder: Hash32(models.encoder_id().hash()),
        session: Session {
            providers: session.providers.iter().map(ToString::to_string).collect(),
            n_threads: session.intra_op_threads,
        },
        segmenter: segmenter.identity()?,
        perturbation: perturbation.map(|perturbation| perturbation.identity()),
        scene: hash_scene(&inputs.scene),
        views: inputs.views.par_iter().map(identity_of_view).collect(),
        settings: &settings.view,
        cells: settings.cells.limits,
    };
    Ok(Hash32::of(&serde_json::to_vec(&identity).map_err(std::io::Error::from)?))
}

fn hash_scene(scene: &Gaussians) -> Hash32 {
    let columns: [&[u8]; 4] = [
        bytemuck::cast_slice(&scene.means_in_world),
        bytemuck::cast_slice(&scene.rotations_wxyz),
        bytemuck::cast_slice(&scene.scales),
        bytemuck::cast_slice(&scene.opacities),
    ];
    Hash32::of(&columns.map(|column| Hash32::of(column).0).concat())
}

fn identity_of_view(view: &View) -> ViewIdentity<'_> {
    ViewIdentity {
        name: &view.name,
        photo: fs_err::metadata(&view.image_path).ok().map(|m| Hash32::of(&m.len().to_le_bytes())),
        intrinsics: view.intrinsics,
        camera_from_world: view.camera_from_world,
    }
}
