//! What makes two views' contributions the same, so that an encode may go on from those of an earlier one.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::Serialize;
use slag_common::{Gaussians, Hash32, Intrinsics, View};

use super::context::Engines;
use super::error::EncodeError;
use super::inputs::Inputs;
use super::settings::{EncodeSettings, MAX_RASTER_WIDTH_PX, ViewSettings};
use crate::cells::PositionError;
use crate::ingest;
use crate::segment::Segmenter;

/// Version of the steps from masks to contributions; a change makes another encode.
const REGIONS_VERSION: u32 = 4;

/// Stands for a fleet's rasterisers, which differ between machines.
#[cfg(feature = "fleet")]
pub(crate) const OF_A_FLEET: &str = "fleet";

/// Everything on which the contributions of all views depend: files by their content, settings as they are.
///
/// A setting is part of it by being a field of [`ViewSettings`].
#[derive(Serialize)]
struct SceneIdentity<'a> {
    program: &'static str,
    regions: (u32, u32),
    encoder: Hash32,
    /// Windows are no part of the encoder's id: they change no vector of a crop.
    windows: &'a [u8],
    session: Session,
    segmenter: String,
    /// Devices round differently; a fleet has many.
    rasterizer: &'a str,
    scene: Hash32,
    settings: &'a ViewSettings,
    cells: CellsIdentity,
}

/// See [`CellSplit::deciding`](crate::cells::CellSplit::deciding).
type CellsIdentity = (usize, Option<f64>, Option<PositionError>);

/// How models run: other hardware and another split of the work change vectors in the last bits.
#[derive(Serialize)]
struct Session {
    providers: Vec<String>,
    n_threads: usize,
}

#[derive(Serialize)]
struct ViewIdentity<'a> {
    of_scene: Hash32,
    name: &'a str,
    /// Hash of the photo's file; absent where it cannot be read.
    photo: Option<Hash32>,
    /// Hash of its mask file; absent where it has none.
    masks: Option<Hash32>,
    intrinsics: Intrinsics,
    camera_from_world: glam::DAffine3,
}

/// Identities of the scene and, by name, of its views. A view's includes the scene's, but no other view, so photos can
/// be added and withdrawn.
pub(super) fn identities(
    settings: &EncodeSettings,
    engines: &Engines<'_>,
    segmenter: &dyn Segmenter,
    rasterizer: &str,
    inputs: &Inputs,
) -> Result<(Hash32, BTreeMap<String, Hash32>), EncodeError> {
    let cells = inputs.split.deciding(settings.cells.limits);
    let of_scene = of_scene(&settings.view, cells, engines, segmenter, rasterizer, &inputs.scene)?;
    let of_view = |view: &View| Ok((view.name.clone(), of_view(of_scene, view, segmenter)?));
    Ok((of_scene, inputs.views.par_iter().map(of_view).collect::<Result<_, EncodeError>>()?))
}

/// Hash of everything that a view's contributions depend on, from its files as they are now.
pub(super) fn of_view(
    of_scene: Hash32,
    view: &View,
    segmenter: &dyn Segmenter,
) -> Result<Hash32, EncodeError> {
    hash_of(&ViewIdentity {
        of_scene,
        name: &view.name,
        photo: ingest::hash_file(&view.image_path).ok(),
        masks: segmenter.identity_of_view(view)?,
        intrinsics: view.intrinsics,
        camera_from_world: view.camera_from_world,
    })
}

/// Hash of everything that all views' contributions depend on.
pub(crate) fn of_scene(
    settings: &ViewSettings,
    cells: CellsIdentity,
    engines: &Engines<'_>,
    segmenter: &dyn Segmenter,
    rasterizer: &str,
    scene: &Gaussians,
) -> Result<Hash32, EncodeError> {
    let Engines { models, session, .. } = engines;
    hash_of(&SceneIdentity {
        program: env!("CARGO_PKG_VERSION"),
        regions: (REGIONS_VERSION, MAX_RASTER_WIDTH_PX),
        encoder: Hash32(models.encoder_id().hash()),
        windows: models.windows(),
        session: Session {
            providers: session.providers.iter().map(ToString::to_string).collect(),
            n_threads: session.intra_op_threads,
        },
        segmenter: segmenter.identity(),
        rasterizer,
        scene: hash_scene(scene),
        settings,
        cells,
    })
}

fn hash_of(identity: &impl Serialize) -> Result<Hash32, EncodeError> {
    Ok(Hash32::of(&serde_json::to_vec(identity).map_err(std::io::Error::from)?))
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

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use slag_models::{ModelDir, Provider, SessionOptions};

    use super::*;
    use crate::cells::CellSplit;
    use crate::encode::Masks;
    use crate::raster::{CpuRasterizer, pinhole};
    use crate::segment::{GivenMasks, GraphSegmenter};

    fn inputs(photo: &Path) -> Inputs {
        let view = View {
            name: "a.png".into(),
            image_path: photo.to_owned(),
            intrinsics: pinhole([8, 8], 8.0),
            camera_from_world: glam::DAffine3::IDENTITY,
        };
        Inputs {
            scene: Gaussians::default(),
            split: CellSplit::default(),
            standing: std::sync::Arc::default(),
            views: vec![view],
            missing: Vec::new(),
            geo_reference: None,
            n_drawn: 0,
        }
    }

    fn identity_with(
        change: impl FnOnce(&mut EncodeSettings, &mut SessionOptions),
        segmenter: &dyn Segmenter,
        photo: &Path,
    ) -> Hash32 {
        let mut settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        settings.view.masks = Masks::Graph;
        let mut session = SessionOptions::new(PathBuf::new());
        change(&mut settings, &mut session);
        let models = ModelDir::colours();
        let engines = Engines::new(&models, &session, &CpuRasterizer);
        identities(&settings, &engines, segmenter, "cpu", &inputs(photo)).expect("readable").1["a.png"]
    }

    /// Views of two devices, or of a fleet, must not mix in one store.
    #[test]
    fn the_device_that_rasterises_counts() {
        let settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        let (models, session) = (ModelDir::colours(), SessionOptions::new(PathBuf::new()));
        let engines = Engines::new(&models, &session, &CpuRasterizer);
        let of = |device: &str| {
            let (graph, inputs) = (GraphSegmenter::default(), inputs(Path::new("absent.png")));
            identities(&settings, &engines, &graph, device, &inputs).expect("readable").0
        };
        assert!(of("cpu") != of("NVIDIA H100 F64") && of("cpu") != of(OF_A_FLEET) && of("cpu") == of("cpu"));
    }

    /// Files of equal path and length differ by content; so do masks in a single COCO file.
    #[test]
    fn photos_and_masks_count_by_content() {
        let dir = tempfile::tempdir().expect("a folder");
        let photo = dir.path().join("a.png");
        let (graph, mut found) = (GraphSegmenter::default(), Vec::new());
        for content in ["one", "two", "one"] {
            fs_err::write(&photo, content).expect("writes");
            found.push(identity_with(|_, _| {}, &graph, &photo));
        }
        assert!(found[0] == found[2] && found[0] != found[1], "photos");

        let (file, folder) = (dir.path().join("masks.json"), dir.path().join("masks"));
        fs_err::create_dir_all(&folder).expect("makes");
        for (path, given) in [(&file, &file), (&folder.join("a.json"), &folder)] {
            found.clear();
            for counts in ["[4,60]", "[5,59]", "[4,60]"] {
                let annotation =
                    format!(r#"{{"image_id": 1, "segmentation": {{"size": [8, 8], "counts": {counts}}}}}"#);
                let images = r#"[{"id": 1, "file_name": "a.png"}]"#;
                let text = format!(r#"{{"images": {images}, "annotations": [{annotation}]}}"#);
                fs_err::write(path, text).expect("writes");
                let masks = GivenMasks::open(given, Vec::new()).expect("opens");
                found.push(identity_with(|_, _| {}, &masks, &photo));
            }
            assert!(found[0] == found[2] && found[0] != found[1], "{}", given.display());
        }
    }

    #[test]
    fn the_execution_provider_and_every_view_setting_count() {
        let (graph, photo) = (GraphSegmenter::default(), Path::new("absent.png"));
        let with = |change: &dyn Fn(&mut EncodeSettings, &mut SessionOptions)| {
            identity_with(|settings, session| change(settings, session), &graph, photo)
        };
        let plain = with(&|_, _| {});
        let changed = [
            with(&|_, session| session.providers = vec![Provider::Cuda]),
            with(&|settings, _| settings.view.min_mask_px += 1),
            with(&|settings, _| settings.view.masks = Masks::Auto { n_levels: 2 }),
            with(&|settings, _| settings.cells.limits.max_gaussians -= 1),
        ];
        assert!(changed.iter().all(|identity| *identity != plain));
        // Later steps are no part of the identity.
        assert_eq!(with(&|settings, _| settings.aggregation = crate::lift::Aggregation::PLAIN), plain);
    }
}
