//! A run on a worker: the scene and settings, brought from the bucket and checked, and the views' files.

use std::collections::{BTreeSet, HashMap};
use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;
use slag_common::{Gaussians, Hash32, View};

use super::documents::{self, InputFile, PlannedView, RunPlan};
use super::run::Run;
use super::{damaged, objects};
use crate::blobs::Bucket;
use crate::cells::{self, CellSplit};
use crate::encode::fleet_parts::{OF_A_FLEET, Plan, RunContext, ViewSink, ViewTools, of_scene};
use crate::encode::{EncodeError, Engines, Masks, ViewSettings};
use crate::ground::{self, Standing};
use crate::memory::{MemoryPlan, Phase};
use crate::segment::{self, Segmenter};
use crate::{ingest, raster};

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
    /// Folder of photos and masks.
    folder: PathBuf,
}

impl Prepared {
    /// Fetches scene and masks to `folder`. `segmenter`: this machine's mask model.
    pub(super) fn fetch(
        bucket: &Bucket,
        (run, plan): (Run, RunPlan),
        folder: &Path,
        segmenter: Option<&PathBuf>,
        context: &RunContext<'_>,
    ) -> Result<Self, EncodeError> {
        let bytes = fetch_input(bucket, plan.scene)?;
        let key = documents::input_key(plan.scene);
        let scene = objects::unpack_scene(&bytes).map_err(|e| damaged(bucket, &key, e))?;
        drop(bytes);
        let split = context.install(|| cells::split(&scene, plan.limits));
        let mut settings = plan.settings.clone();
        match (&mut settings.masks, &plan.data_set) {
            (Masks::Given { dir, .. }, Some(data_set)) => {
                *dir = folder.join("masks.json");
                fetch_file(bucket, data_set, dir)?;
            }
            (Masks::Given { dir, .. }, None) => {
                *dir = folder.join("masks");
                fs_err::create_dir_all(&dir)?;
            }
            (Masks::Sam { dir, .. }, _) => match segmenter {
                Some(own) => dir.clone_from(own),
                None => return Err(other_engines(run, &plan.engines, "no --segmenter")),
            },
            (Masks::Auto { .. } | Masks::Graph, _) => {}
        }
        let views =
            plan.views.iter().map(|view| planned_view(view, folder)).collect::<Result<Vec<_>, _>>()?;
        let standing = Arc::new(context.install(|| Standing::find(&scene, &views)));
        let number_of = views.iter().enumerate().map(|(i, view)| (view.name.clone(), i)).collect();
        let folder = folder.to_owned();
        Ok(Self { run, plan, settings, scene, split, standing, views, number_of, folder })
    }

    /// Fetches a view's photo and masks.
    pub(super) fn fetch_view(&self, bucket: &Bucket, number: usize) -> Result<(), EncodeError> {
        let planned = &self.plan.views[number];
        let mut files = vec![(&planned.photo, photo_path(planned, &self.folder))];
        files.extend(planned.masks.as_ref().zip(mask_path(planned, &self.folder)));
        for (file, path) in files {
            if !path.is_file() {
                fetch_file(bucket, file, &path)?;
            }
        }
        Ok(())
    }

    pub(super) fn remove_view(&self, number: usize) {
        let planned = &self.plan.views[number];
        for path in mask_path(planned, &self.folder).into_iter().chain([photo_path(planned, &self.folder)]) {
            // It may never have been fetched, and the folder goes with the worker anyway.
            let _ = std::fs::remove_file(path);
        }
    }
    /// Fails if the contributions would differ from the coordinator's.
    pub(super) fn check(
        &self,
        engines: &Engines<'_>,
        segmenter: &dyn Segmenter,
        context: &RunContext<'_>,
    ) -> Result<(), EncodeError> {
        let cells = self.split.deciding(self.plan.limits);
        let found =
            context.install(|| of_scene(&self.settings, cells, engines, segmenter, OF_A_FLEET, &self.scene));
        match found? == self.plan.of_scene {
            true => Ok(()),
            false => {
                let own = engines_text(engines.models.encoder_id(), &segmenter.identity());
                Err(other_engines(self.run, &self.plan.engines, &own))
            }
        }
    }

    pub(super) fn check_memory(&self, memory_bytes: u64, tools: &ViewTools<'_>) -> Result<(), EncodeError> {
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

fn photo_path(view: &PlannedView, folder: &Path) -> PathBuf {
    folder.join("photos").join(format!("{}.{}", view.id, view.photo.ending))
}

fn mask_path(view: &PlannedView, folder: &Path) -> Option<PathBuf> {
    Some(folder.join("masks").join(format!("{}.{}", view.name, view.masks.as_ref()?.ending)))
}

/// The view as it is on this machine.
fn planned_view(planned: &PlannedView, folder: &Path) -> Result<View, EncodeError> {
    let PlannedView { name, intrinsics, camera_from_world, .. } = planned;
    let is_inside = Path::new(name).components().all(|part| matches!(part, Component::Normal(_)));
    let mut files = planned.masks.iter().chain([&planned.photo]);
    if !is_inside || files.any(|file| file.ending.contains(['/', '\\'])) {
        return Err(EncodeError::Failed(format!("view {name}: its name leads out of the folder of photos")));
    }
    let (name, image_path) = (name.clone(), photo_path(planned, folder));
    Ok(View { name, image_path, intrinsics: *intrinsics, camera_from_world: *camera_from_world })
}

/// Uploads the scene and the open views' files; returns the plan of a run. `open`: indices of views.
pub(super) fn upload(bucket: &Bucket, plan: &Plan<'_>, open: &[usize]) -> Result<RunPlan, EncodeError> {
    let there: BTreeSet<String> = bucket.list("inputs")?.into_iter().collect();
    let put = |bytes: Vec<u8>| -> Result<Hash32, EncodeError> {
        let hash = Hash32::of(&bytes);
        if !there.contains(&hash.to_string()) {
            bucket.put_new(&documents::input_key(hash), bytes)?;
        }
        Ok(hash)
    };
    let put_file = |path: &Path| -> Result<(InputFile, u64), EncodeError> {
        let bytes = fs_err::read(path)?;
        let ending = path.extension().unwrap_or_default().to_string_lossy().into_owned();
        let len = bytes.len() as u64;
        Ok((InputFile { hash: put(bytes)?, ending }, len))
    };
    let scene = put(objects::pack_scene(&plan.inputs.scene)?)?;
    let (mask_folder, data_set) = match &plan.settings.view.masks {
        Masks::Given { dir, .. } if dir.is_dir() => (Some(dir), None),
        Masks::Given { dir, .. } => (None, Some(put_file(dir)?.0)),
        Masks::Auto { .. } | Masks::Graph | Masks::Sam { .. } => (None, None),
    };
    let planned = |number: &usize| -> Result<(u64, PlannedView), EncodeError> {
        let view = &plan.inputs.views[*number];
        let masks = mask_folder.and_then(|dir| segment::mask_file(dir, view));
        let masks = masks.map(|path| put_file(&path)).transpose()?;
        // Large photos cost most; at equal size, those with larger mask files.
        let cost = ingest::photo_area_px(view) + masks.as_ref().map_or(0, |(_, len)| *len);
        let planned = PlannedView {
            name: view.name.clone(),
            id: plan.job.id_of_view[&view.name],
            photo: put_file(&view.image_path)?.0,
            masks: masks.map(|(file, _)| file),
            intrinsics: view.intrinsics,
            camera_from_world: view.camera_from_world,
        };
        plan.job.check_unchanged(view, plan.segmenter.as_ref())?;
        Ok((cost, planned))
    };
    let mut views: Vec<(u64, PlannedView)> =
        plan.context.install(|| open.par_iter().map(planned).collect::<Result<_, _>>())?;
    views.sort_by_key(|(cost, _)| std::cmp::Reverse(*cost));
    Ok(RunPlan {
        program: documents::own_version(),
        // The standard library's hash keys are random for each call.
        coordinator: RandomState::new().build_hasher().finish(),
        engines: engines_text(plan.engines.models.encoder_id(), &plan.segmenter.identity()),
        of_scene: plan.job.of_scene,
        scene,
        settings: plan.settings.view.clone(),
        limits: plan.settings.cells.limits,
        data_set,
        views: views.into_iter().map(|(_, view)| view).collect(),
    })
}

fn other_engines(run: Run, planned: &str, own: &str) -> EncodeError {
    EncodeError::Failed(format!(
        "run {} was planned with {planned}, this worker would encode with {own} and make other contributions; give the worker \
         the coordinator's --models, --segmenter, --provider and program",
        run.0
    ))
}

pub(super) fn engines_text(models: impl ToString, segmenter: &str) -> String {
    let segmenter: String = segmenter.chars().take(120).collect();
    format!("{} and {segmenter}", models.to_string())
}

pub(super) fn fetch_input(bucket: &Bucket, hash: Hash32) -> Result<axum::body::Bytes, EncodeError> {
    let key = documents::input_key(hash);
    let bytes = bucket.require(&key)?;
    match Hash32::of(&bytes) {
        found if found == hash => Ok(bytes),
        found => Err(damaged(bucket, &key, format!("the content's hash is {found}"))),
    }
}

pub(super) fn fetch_file(bucket: &Bucket, file: &InputFile, path: &Path) -> Result<(), EncodeError> {
    let bytes = fetch_input(bucket, file.hash)?;
    if let Some(folder) = path.parent() {
        fs_err::create_dir_all(folder)?;
    }
    Ok(fs_err::write(path, bytes)?)
}
