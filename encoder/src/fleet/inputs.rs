//! Photos, masks and the scene on their way to the bucket, and from there to a worker.

use std::collections::BTreeSet;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::Path;

use rayon::prelude::*;
use slag_common::Hash32;

use super::documents::{self, InputFile, PlannedView, RunPlan};
use super::error::FleetError;
use super::objects;
use crate::blobs::Bucket;
use crate::encode::Masks;
use crate::encode::fleet_parts::{Plan, ViewSink};
use crate::ingest;
use crate::segment;

/// Uploads the scene and the open views' files; returns the plan of a run. `open`: indices of views.
pub(super) fn upload(bucket: &Bucket, plan: &Plan<'_>, open: &[usize]) -> Result<RunPlan, FleetError> {
    let there: BTreeSet<String> = bucket.list("inputs")?.into_iter().collect();
    let put = |bytes: Vec<u8>| -> Result<Hash32, FleetError> {
        let hash = Hash32::of(&bytes);
        if !there.contains(&hash.to_string()) {
            bucket.put_new(&documents::input_key(hash), bytes)?;
        }
        Ok(hash)
    };
    let put_file = |path: &Path| -> Result<(InputFile, u64), FleetError> {
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
    let planned = |number: &usize| -> Result<(u64, PlannedView), FleetError> {
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

pub(super) fn engines_text(models: impl ToString, segmenter: &str) -> String {
    let segmenter: String = segmenter.chars().take(120).collect();
    format!("{} and {segmenter}", models.to_string())
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
