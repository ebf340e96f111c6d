//! Photos, masks and the scene on their way to the bucket, and from there to a worker.

use std::collections::BTreeSet;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;
use slag_common::{Hash32, View};

use super::documents::{self, InputFile, PlannedView, RunPlan};
use super::error::FleetError;
use super::objects;
use crate::blobs::Bucket;
use crate::encode::Masks;
use crate::encode::fleet_parts::{Plan, RunContext, ViewSink};
use crate::ingest;
use crate::segment;

/// Uploads the scene and the open views' files; returns the plan of a run. `open`: indices of views.
pub(super) fn upload(
    bucket: &Bucket,
    plan: &Plan<'_>,
    open: &[usize],
    context: &RunContext<'_>,
) -> Result<RunPlan, FleetError> {
    let there: BTreeSet<String> = bucket.list("inputs")?.into_iter().collect();
    let put = |path: &Path| -> Result<(InputFile, u64), FleetError> {
        let bytes = fs_err::read(path)?;
        let ending = path.extension().unwrap_or_default().to_string_lossy().into_owned();
        let (file, len) = (InputFile { hash: Hash32::of(&bytes), ending }, bytes.len() as u64);
        if !there.contains(&file.hash.to_string()) {
            bucket.put_new(&documents::input_key(file.hash), bytes)?;
        }
        Ok((file, len))
    };
    let scene = objects::pack_scene(&plan.inputs.scene)?;
    let scene_hash = Hash32::of(&scene);
    if !there.contains(&scene_hash.to_string()) {
        bucket.put_new(&documents::input_key(scene_hash), scene)?;
    }
    let (mask_folder, data_set) = match &plan.settings.view.masks {
        Masks::Given { dir, .. } if dir.is_dir() => (Some(dir), None),
        Masks::Given { dir, .. } => (None, Some(put(dir)?.0)),
        Masks::Auto { .. } | Masks::Graph | Masks::Sam { .. } => (None, None),
    };
    let planned = |number: &usize| -> Result<(u64, PlannedView), FleetError> {
        let view = &plan.inputs.views[*number];
        let masks = mask_folder.and_then(|dir| segment::mask_file(dir, view));
        let masks = masks.map(|path| put(&path)).transpose()?;
        // Large photos cost most; at equal size, those with larger mask files.
        let cost = ingest::photo_area_px(view) + masks.as_ref().map_or(0, |(_, len)| *len);
        let planned = PlannedView {
            name: view.name.clone(),
            id: plan.job.id_of(&view.name),
            photo: put(&view.image_path)?.0,
            masks: masks.map(|(file, _)| file),
            intrinsics: view.intrinsics,
            camera_from_world: view.camera_from_world,
        };
        plan.job.check_unchanged(view, plan.segmenter.as_ref())?;
        Ok((cost, planned))
    };
    let mut views: Vec<(u64, PlannedView)> =
        context.install(|| open.par_iter().map(planned).collect::<Result<_, _>>())?;
    views.sort_by_key(|(cost, _)| std::cmp::Reverse(*cost));
    Ok(RunPlan {
        program: documents::own_version(),
        // The standard library's hash keys are random for each call.
        coordinator: RandomState::new().build_hasher().finish(),
        engines: engines_text(plan.engines.models.encoder_id(), &plan.segmenter.identity()),
        of_scene: plan.job.of_scene(),
        scene: scene_hash,
        settings: plan.settings.view.clone(),
        limits: plan.settings.cells.limits,
        data_set,
        views: views.into_iter().map(|(_, view)| view).collect(),
    })
}

pub(super) fn engines_text(models: impl ToString, segmenter: &str) -> String {
    let segmenter: String = segmenter.chars().take(120).collect();
    format!("{} and {segmenter}", models.to_string())
}

pub(super) struct ViewFiles {
    bucket: Arc<Bucket>,
    folder: PathBuf,
    views: Vec<PlannedView>,
}

impl ViewFiles {
    pub(super) fn new(bucket: Arc<Bucket>, folder: &Path, views: Vec<PlannedView>) -> Self {
        Self { bucket, folder: folder.to_owned(), views }
    }

    pub(super) fn mask_folder(&self) -> PathBuf {
        self.folder.join("masks")
    }

    fn photo_path(&self, view: &PlannedView) -> PathBuf {
        self.folder.join("photos").join(format!("{}.{}", view.id, view.photo.ending))
    }

    fn mask_path(&self, view: &PlannedView) -> Option<PathBuf> {
        let file = view.masks.as_ref()?;
        Some(self.mask_folder().join(format!("{}.{}", view.name, file.ending)))
    }

    pub(super) fn views(&self) -> Result<Vec<View>, FleetError> {
        let view = |planned: &PlannedView| {
            let is_inside = |path: &Path| path.components().all(|part| matches!(part, Component::Normal(_)));
            let endings = planned.masks.iter().map(|file| &file.ending).chain([&planned.photo.ending]);
            let are_endings = endings.clone().all(|ending| !ending.contains(['/', '\\']));
            if !is_inside(Path::new(&planned.name)) || !are_endings {
                let reason = "its name leads out of the folder of photos".into();
                return Err(FleetError::View { view: planned.name.clone(), reason });
            }
            Ok(View {
                name: planned.name.clone(),
                image_path: self.photo_path(planned),
                intrinsics: planned.intrinsics,
                camera_from_world: planned.camera_from_world,
            })
        };
        self.views.iter().map(view).collect()
    }

    fn planned(&self, view: &View) -> Option<&PlannedView> {
        self.views.iter().find(|planned| planned.name == view.name)
    }

    pub(super) fn remove(&self, view: &View) {
        let Some(planned) = self.planned(view) else { return };
        for path in std::iter::once(self.photo_path(planned)).chain(self.mask_path(planned)) {
            // It may never have been fetched, and the folder goes with the worker anyway.
            let _ = std::fs::remove_file(path);
        }
    }

    pub(super) fn fetch(&self, view: &View) -> Result<(), FleetError> {
        let Some(planned) = self.planned(view) else { return Ok(()) };
        let mut files = vec![(&planned.photo, self.photo_path(planned))];
        files.extend(planned.masks.as_ref().zip(self.mask_path(planned)));
        for (file, path) in files {
            if !path.is_file() {
                fetch_file(&self.bucket, file, &path)?;
            }
        }
        Ok(())
    }
}

pub(super) fn fetch_input(bucket: &Bucket, hash: Hash32) -> Result<axum::body::Bytes, FleetError> {
    let key = documents::input_key(hash);
    let bytes = bucket.require(&key)?;
    match Hash32::of(&bytes) {
        found if found == hash => Ok(bytes),
        found => Err(FleetError::damaged(bucket, &key, format!("the content's hash is {found}"))),
    }
}

pub(super) fn fetch_file(bucket: &Bucket, file: &InputFile, path: &Path) -> Result<(), FleetError> {
    let bytes = fetch_input(bucket, file.hash)?;
    if let Some(folder) = path.parent() {
        fs_err::create_dir_all(folder)?;
    }
    Ok(fs_err::write(path, bytes)?)
}
