//! A run on a worker: the scene and settings, brought from the bucket and checked.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use slag_common::{Gaussians, View};

use super::documents::{self, RunPlan};
use super::error::FleetError;
use super::inputs::{ViewFiles, engines_text, fetch_file, fetch_input};
use super::objects;
use super::run::Run;
use crate::blobs::Bucket;
use crate::cells::{self, CellSplit};
use crate::encode::fleet_parts::{RunContext, ViewTools, of_scene};
use crate::encode::{EncodeError, Engines, Masks, ViewSettings};
use crate::ground::{self, Standing};
use crate::memory::{MemoryPlan, Phase};
use crate::raster;
use crate::segment::Segmenter;

pub(super) struct Prepared {
    pub(super) run: Run,
    pub(super) plan: RunPlan,
    pub(super) settings: ViewSettings,
    pub(super) scene: Gaussians,
    pub(super) split: CellSplit,
    pub(super) standing: Arc<Standing>,
    /// By index in the plan.
    pub(super) views: Vec<View>,
    pub(super) number_of: HashMap<String, usize>,
    pub(super) files: ViewFiles,
}

impl Prepared {
    /// Fetches scene and masks to `folder`. `segmenter`: this machine's mask model.
    pub(super) fn fetch(
        bucket: &Arc<Bucket>,
        (run, plan): (Run, RunPlan),
        folder: &Path,
        segmenter: Option<&PathBuf>,
        context: &RunContext<'_>,
    ) -> Result<Self, FleetError> {
        let bytes = fetch_input(bucket, plan.scene)?;
        let key = documents::input_key(plan.scene);
        let scene = objects::unpack_scene(&bytes).map_err(|e| FleetError::damaged(bucket, &key, e))?;
        drop(bytes);
        let split = context.install(|| cells::split(&scene, plan.limits));
        let files = ViewFiles::new(Arc::clone(bucket), folder, plan.views.clone());
        let mut settings = plan.settings.clone();
        match (&mut settings.masks, &plan.data_set) {
            (Masks::Given { dir, .. }, Some(data_set)) => {
                *dir = folder.join("masks.json");
                fetch_file(bucket, data_set, dir)?;
            }
            (Masks::Given { dir, .. }, None) => {
                *dir = files.mask_folder();
                fs_err::create_dir_all(&dir)?;
            }
            (Masks::Sam { dir, .. }, _) => match segmenter {
                Some(own) => dir.clone_from(own),
                None => {
                    let (planned, own) = (plan.engines.clone(), "no --segmenter".into());
                    return Err(FleetError::Identity { run: run.0, planned, own });
                }
            },
            (Masks::Auto { .. } | Masks::Graph, _) => {}
        }
        let views = files.views()?;
        let standing = Arc::new(context.install(|| Standing::find(&scene, &views)));
        let number_of = views.iter().enumerate().map(|(i, view)| (view.name.clone(), i)).collect();
        Ok(Self { run, plan, settings, scene, split, standing, views, number_of, files })
    }

    /// Fails if the contributions would differ from the coordinator's.
    pub(super) fn check(
        &self,
        engines: &Engines<'_>,
        segmenter: &dyn Segmenter,
        context: &RunContext<'_>,
    ) -> Result<(), FleetError> {
        let cells = self.split.deciding(self.plan.limits);
        let found = context.install(|| of_scene(&self.settings, cells, engines, segmenter, &self.scene));
        match found.map_err(FleetError::from)? == self.plan.of_scene {
            true => Ok(()),
            false => Err(FleetError::Identity {
                run: self.run.0,
                planned: self.plan.engines.clone(),
                own: engines_text(engines.models.encoder_id(), &segmenter.identity()),
            }),
        }
    }

    pub(super) fn check_memory(&self, memory_bytes: u64, tools: &ViewTools<'_>) -> Result<(), FleetError> {
        let mut memory = MemoryPlan::new(memory_bytes);
        memory.reserve(Phase::Always, "the scene", self.scene.len_bytes());
        CellSplit::reserve(&mut memory, self.scene.len());
        ground::reserve(&mut memory, self.scene.len());
        raster::reserve(&mut memory, self.scene.len());
        tools.reserve(&mut memory, &self.views);
        memory.rest(0)?;
        Ok(())
    }
}

pub(super) fn of_encode(error: EncodeError) -> FleetError {
    match error {
        EncodeError::Fleet(inner) => match inner.downcast::<FleetError>() {
            Ok(error) => *error,
            Err(inner) => FleetError::Encode(EncodeError::Fleet(inner)),
        },
        error => FleetError::Encode(error),
    }
}
