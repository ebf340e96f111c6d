//! The object of what all views together say about every cell: regions, text bank, refinements, objects, places, and the
//! index of the views' contributions.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;

use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use super::documents::{self, MergedView};
use crate::blobs::Bucket;
use crate::codebook::{ScoreMetric, ScoreMetricContext, TextBank};
use crate::encode::fleet_parts::{CellsToBuild, Merged};
use crate::lift::refine::Refinement;
use crate::lift::{ContributionError, ContributionIndex, RangeReader, RegionTable};
use crate::objects::SceneObjects;
use crate::occupancy::SceneOccupancy;

const MAGIC: [u8; 8] = *b"SLAGMERG";
const VERSION: u32 = 2;

/// Requests under way for the contributions of a cell.
const N_REQUESTS: usize = 32;

/// Returns the object of the cells to build.
///
/// # Errors
/// None: memory takes what is written.
pub(super) fn pack(cells: &CellsToBuild<'_>) -> std::io::Result<Vec<u8>> {
    let Merged { table, score_context, refinement, objects, occupancy } = cells.merged;
    let (mut of_table, mut of_index) = (Vec::new(), Vec::new());
    table.write(&mut of_table)?;
    cells.index.write(&mut of_index)?;
    let bank = &score_context.bank;
    let bank_dim = bank.dim as u64;
    let (mut of_refinement, mut of_objects, mut of_places) = (Vec::new(), Vec::new(), Vec::new());
    refinement.map_or(Ok(()), |refinement| refinement.write(&mut of_refinement))?;
    objects.map_or(Ok(()), |objects| objects.write(&mut of_objects))?;
    occupancy.map_or(Ok(()), |occupancy| occupancy.write(&mut of_places))?;
    let sections = [
        (1, &of_table[..]),
        (2, &of_index[..]),
        (3, bytemuck::bytes_of(&bank_dim)),
        (4, container::bytes_of(&bank.vectors)),
        (5, bytemuck::bytes_of(&score_context.spread)),
        (6, &of_refinement[..]),
        (7, &of_objects[..]),
        (8, &of_places[..]),
    ];
    let mut bytes = Vec::new();
    container::write(&mut bytes, MAGIC, VERSION, &sections)?;
    Ok(bytes)
}

/// What a worker knows of all views.
pub(super) struct Unpacked {
    pub(super) table: RegionTable,
    pub(super) index: ContributionIndex,
    pub(super) score_context: ScoreMetricContext,
    pub(super) refinement: Option<Refinement>,
    pub(super) objects: Option<SceneObjects>,
    pub(super) occupancy: Option<SceneOccupancy>,
}

impl Unpacked {
    /// Returns what cells are made with.
    pub(super) fn merged(&self) -> Merged<'_> {
        Merged {
            table: &self.table,
            score_context: &self.score_context,
            refinement: self.refinement.as_ref(),
            objects: self.objects.as_ref(),
            occupancy: self.occupancy.as_ref(),
        }
    }
}

/// Reads the object. `views`: whose contributions are in the bucket; `n_gaussians`: of the scene.
///
/// # Errors
/// [`ContributionError`] if it is damaged or belongs to another scene.
pub(super) fn unpack(
    bytes: &[u8],
    bucket: &Arc<Bucket>,
    views: &[MergedView],
    n_gaussians: usize,
    n_gaussians_of_cell: &[usize],
) -> Result<Unpacked, ContributionError> {
    let path = PathBuf::from(bucket.url()).join("merged");
    let damaged = |source| ContributionError::Damaged { path: path.clone(), source };
    let bytes = AlignedBytes::copy_of(bytes);
    let layout = Layout::check(&bytes, MAGIC, VERSION).map_err(damaged)?;
    let section = |id: u32, name: &'static str| {
        let range = layout.find(id).ok_or(ContainerError::Missing { id, name })?;
        Ok(AlignedBytes::copy_of(&bytes[range]))
    };
    let parse = || -> Result<_, ContainerError> {
        let table = RegionTable::from_bytes(&section(1, "regions")?)?;
        let dim = usize::try_from(layout.value::<u64>(&bytes, 3, "dimension")?).unwrap_or(usize::MAX);
        let vectors: Vec<f32> = bytemuck::pod_collect_to_vec(&section(4, "texts")?);
        let spread: f32 = layout.value(&bytes, 5, "spread")?;
        if dim != table.dim() || !vectors.len().is_multiple_of(dim) {
            let what = format!("texts of {dim} components, regions of {}", table.dim());
            return Err(ContainerError::Damaged { offset_bytes: 0, what });
        }
        let bank = TextBank { dim, vectors };
        let score_context = ScoreMetricContext { metric: ScoreMetric::new(dim, &bank), bank, spread };
        let of_refinement = section(6, "refinements")?;
        let refinement = (!of_refinement.is_empty())
            .then(|| Refinement::from_bytes(&of_refinement, n_gaussians, table.len()))
            .transpose()?;
        let of_objects = section(7, "objects")?;
        let objects = (!of_objects.is_empty())
            .then(|| SceneObjects::from_bytes(&of_objects, n_gaussians_of_cell))
            .transpose()?;
        let of_places = section(8, "places")?;
        let occupancy = (!of_places.is_empty())
            .then(|| SceneOccupancy::from_bytes(&of_places, n_gaussians_of_cell.len()))
            .transpose()?;
        Ok((table, score_context, refinement, objects, occupancy, section(2, "index")?))
    };
    let (table, score_context, refinement, objects, occupancy, of_index) = parse().map_err(damaged)?;
    let names = views.iter().map(|view| PathBuf::from(&view.name)).collect();
    let reader = Arc::new(ViewObjects { bucket: Arc::clone(bucket), views: views.to_vec() });
    let index = ContributionIndex::read_shipped(&of_index, names, reader, n_gaussians_of_cell)?;
    Ok(Unpacked { table, index, score_context, refinement, objects, occupancy })
}

/// The views' contributions in the bucket.
struct ViewObjects {
    bucket: Arc<Bucket>,
    views: Vec<MergedView>,
}

impl RangeReader for ViewObjects {
    fn read(&self, wanted: &[(usize, Range<u64>)]) -> std::io::Result<Vec<Vec<u8>>> {
        let place = |(view, bytes): &(usize, Range<u64>)| {
            let MergedView { id, contributions_at_bytes: at, .. } = &self.views[*view];
            (documents::view_key(*id), bytes.start + at..bytes.end + at)
        };
        let places: Vec<(String, Range<u64>)> = wanted.iter().map(place).collect();
        let read = self.bucket.get_ranges(&places, N_REQUESTS).map_err(std::io::Error::other)?;
        Ok(read.into_iter().map(Vec::from).collect())
    }
}
