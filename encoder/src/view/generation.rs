//! A generation of a store, opened for the page.

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use slag_common::manifest::CellRecord;
use slag_view::{Cell, CellState, Description, Photo, ScoresMessage, Step, cell_message};

use super::answers::Things;
use super::error::ViewError;
use super::shards::{combined, photos_of, scores_of, smallest_shard, smallest_with_appearance};
use super::splat::{PROGRAM, Splat};
use crate::lift::field::{read_field, read_regions};
use crate::lift::{CellField, RegionTable};
use crate::store::{StoreReader, StoredShard};

pub(super) struct Generation {
    pub(super) reader: StoreReader,
    pub(super) things: Things,
    /// Photos with published poses.
    photos: Vec<Photo>,
    scored: Scored,
}

/// Source of scores; it determines the order of a cell's Gaussians.
enum Scored {
    Fields(RegionTable, Vec<CellField>),
    /// The smallest shards' centroids.
    Shards,
}

impl Generation {
    pub(super) fn open(reader: StoreReader, splat: Option<&Splat>) -> Result<Self, ViewError> {
        let mut photos = Vec::new();
        let things = Things::open(&reader, |shard| photos.extend(photos_of(shard)))?;
        let Some(splat) = splat else { return Ok(Self { reader, things, photos, scored: Scored::Shards }) };
        let manifest = reader.manifest();
        let (expected, found) = (manifest.n_gaussians + manifest.n_rejected, splat.scene.len());
        if found as u64 != expected {
            return Err(ViewError::OtherSplat { expected, found });
        }
        let table = read_regions(&reader)?;
        let field = |cell: &CellRecord| {
            let field = read_field(&reader, cell.cell_id, cell.n_gaussians, table.len())?;
            match field.input_indices.iter().any(|index| *index as usize >= found) {
                true => Err(ViewError::OtherSplat { expected, found }),
                false => Ok(field),
            }
        };
        let fields = manifest.cells.par_iter().map(field).collect::<Result<Vec<_>, ViewError>>()?;
        Ok(Self { things, photos, scored: Scored::Fields(table, fields), reader })
    }

    pub(super) fn describe(&self) -> Description {
        let manifest = self.reader.manifest();
        let generation = manifest.generation;
        let cells = manifest.cells.iter().map(|cell| Cell {
            cell: cell.cell_id,
            n_gaussians: cell.n_gaussians,
            state: CellState::OnBoard,
            generation,
            box_m: cell.bounds.into(),
        });
        Description {
            program: PROGRAM,
            scene: manifest.scene.clone(),
            generation,
            n_gaussians: manifest.n_gaussians,
            up: Vec3::Z,
            metric: manifest.metric,
            geographic: manifest.geo_reference.is_some(),
            can_ask: true,
            cells: cells.collect(),
            views: self.photos.clone(),
            fetched: None,
            position_m: None,
        }
    }

    pub(super) fn cell(
        &self,
        cell_id: u32,
        generation: Option<u64>,
        step: Step,
        splat: Option<&Splat>,
    ) -> Result<Vec<u8>, ViewError> {
        let manifest = self.reader.manifest();
        let at = manifest.cells.iter().position(|cell| cell.cell_id == cell_id);
        let is_asked_for = generation.is_none_or(|asked| asked == manifest.generation);
        let at = at.filter(|_| is_asked_for).ok_or(ViewError::NoCell { cell_id })?;
        match (&self.scored, splat) {
            (Scored::Fields(_, fields), Some(splat)) => Ok(splat.message(&fields[at].input_indices, step)),
            _ => {
                let shard = smallest_with_appearance(&self.reader, &manifest.cells[at])?;
                let shard = shard.ok_or(ViewError::NoCell { cell_id })?;
                let view = shard.view();
                let n_gaussians = view.header.n_gaussians as usize;
                let positions = step.indices(n_gaussians).map(|at| view.position_in_world(at));
                let appearance = shard.layout.additions(&shard.bytes).appearance;
                Ok(cell_message(&positions.collect::<Vec<DVec3>>(), appearance, step))
            }
        }
    }

    pub(super) fn thumbnail(&self, id: u64) -> Result<Option<Vec<u8>>, ViewError> {
        let cell_id = self.things.cell_of(id);
        let cell = self.reader.manifest().cells.iter().find(|cell| Some(cell.cell_id) == cell_id);
        let shard = cell.map(|cell| smallest_with_appearance(&self.reader, cell)).transpose()?.flatten();
        let of_shard = |shard: StoredShard| {
            let objects = shard.objects()?;
            let at = objects.records.iter().position(|record| record.id == id)?;
            objects.thumbnails?.get(at).map(<[u8]>::to_vec)
        };
        Ok(shard.and_then(of_shard))
    }

    /// Message with every Gaussian's score for the first of `vectors` against the others, its negatives.
    pub(super) fn scores(&self, vectors: &[Vec<f32>]) -> Result<Vec<u8>, ViewError> {
        let manifest = self.reader.manifest();
        let of_cells: Vec<Vec<f32>> = match &self.scored {
            Scored::Fields(table, fields) => {
                let of_regions: Vec<Vec<f32>> = vectors.iter().map(|vector| table.scores(vector)).collect();
                let scores = |field: &CellField| {
                    combined(
                        of_regions.iter().map(|of_regions| field.cosines(of_regions)).collect(),
                        f32::NEG_INFINITY,
                    )
                };
                fields.iter().map(scores).collect()
            }
            Scored::Shards => {
                let scores = |cell: &CellRecord| {
                    let shard = smallest_shard(&self.reader, cell)?;
                    let n_gaussians = cell.n_gaussians as usize;
                    Ok(shard.map_or_else(|| vec![f32::NAN; n_gaussians], |shard| scores_of(&shard, vectors)))
                };
                manifest.cells.par_iter().map(scores).collect::<Result<_, ViewError>>()?
            }
        };
        // The minimum of NaN and a number is the number.
        let all = || of_cells.iter().flatten().copied();
        let range = [all().fold(f32::NAN, f32::min), all().fold(f32::NAN, f32::max)];
        let range = if range[0].is_nan() { [0.0; 2] } else { range };
        let cells: Vec<(u32, u32)> =
            manifest.cells.iter().zip(&of_cells).map(|(cell, of)| (cell.cell_id, of.len() as u32)).collect();
        let mut message = ScoresMessage::new(manifest.generation, range, &cells);
        for (at, scores) in of_cells.iter().enumerate() {
            scores.iter().enumerate().for_each(|(k, score)| message.fill(at, k..k + 1, *score));
        }
        Ok(message.into_bytes())
    }
}
