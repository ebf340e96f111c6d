//! The file form of a scene's refinements, for machines that build its cells.

use std::io::{self, Write};

use bytemuck::{Pod, Zeroable};
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use super::Refinement;
use super::mixture::{MixtureRegion, Mixtures};
use super::points::Point;
use super::views::FirstRegions;

const MAGIC: [u8; 8] = *b"SLAGREFI";
const VERSION: u32 = 1;
/// Marks a superpoint without a region.
const NONE: u32 = u32::MAX;
/// Sections of the first mixtures; those of the next ones follow.
const MIXTURES: u32 = 10;
const SECTIONS_PER_MIXTURE: u32 = 3;
/// Most scales of superpoints.
const MAX_MIXTURES: usize = 8;

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct RegionRow {
    region: u32,
    length: f32,
}

impl Refinement {
    /// Writes the file form.
    ///
    /// # Errors
    /// Errors of the writer.
    pub fn write(&self, out: impl Write) -> io::Result<()> {
        let settings = serde_json::to_vec(&self.settings)?;
        let weights: Vec<f32> = self.mixtures.iter().map(|mixtures| mixtures.weight).collect();
        let row = |region: &Option<MixtureRegion>| match region {
            Some(MixtureRegion { region, length }) => RegionRow { region: *region, length: *length },
            None => RegionRow { region: NONE, length: 0.0 },
        };
        let rows: Vec<Vec<RegionRow>> =
            self.mixtures.iter().map(|mixtures| mixtures.regions.iter().map(row).collect()).collect();
        let lens: Vec<[u64; 2]> = (self.mixtures.iter())
            .map(|mixtures| [mixtures.of_gaussian.len() as u64, mixtures.regions.len() as u64])
            .collect();
        let counts = [
            self.first_regions.0.len(),
            self.mask_counts.len(),
            self.region_points.len(),
            self.mixtures.len(),
        ]
        .map(|n| n as u64);
        let mut sections = vec![
            (1, bytemuck::bytes_of(&counts)),
            (2, &settings[..]),
            (3, container::bytes_of(&self.first_regions.0)),
            (4, container::bytes_of(&self.mask_counts)),
            (5, container::bytes_of(&self.region_points)),
            (6, container::bytes_of(&weights)),
        ];
        for (i, ((mixtures, rows), lens)) in self.mixtures.iter().zip(&rows).zip(&lens).enumerate() {
            let first = MIXTURES + i as u32 * SECTIONS_PER_MIXTURE;
            sections.push((first, bytemuck::bytes_of(lens)));
            sections.push((first + 1, container::bytes_of(&mixtures.of_gaussian)));
            sections.push((first + 2, container::bytes_of(rows)));
        }
        container::write(out, MAGIC, VERSION, &sections)
    }

    /// Reads the file form. `n_gaussians`: of the scene; `n_regions`: of the table that [`super::Begun::finish`] left.
    ///
    /// # Errors
    /// [`ContainerError`], naming the byte; also if it belongs to another scene or table.
    pub fn from_bytes(
        bytes: &AlignedBytes,
        n_gaussians: usize,
        n_regions: usize,
    ) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let len = |n: u64| usize::try_from(n).unwrap_or(usize::MAX);
        let [n_views, n_counts, n_points, n_mixtures] =
            layout.value::<[u64; 4]>(bytes, 1, "counts")?.map(len);
        let settings = layout.find(2).ok_or(ContainerError::Missing { id: 2, name: "settings" })?;
        let damaged = |what: String| ContainerError::Damaged { offset_bytes: 0, what };
        let settings = serde_json::from_slice(&bytes[settings]).map_err(|e| damaged(e.to_string()))?;
        let first_regions = layout.column::<u32>(3, "first regions", n_views)?;
        let mask_counts = layout.column::<f32>(4, "mask counts", n_counts)?;
        let region_points = layout.column::<Point>(5, "region points", n_points)?;
        let weights = layout.column::<f32>(6, "weights", n_mixtures)?;
        let weights: Vec<f32> = bytemuck::pod_collect_to_vec(&bytes[weights]);
        if n_mixtures > MAX_MIXTURES || n_counts > n_regions || (n_points > 0 && n_points != n_regions) {
            return Err(damaged(format!("{n_points} points, the table has {n_regions} regions")));
        }
        let mut mixtures = Vec::with_capacity(n_mixtures);
        for (i, weight) in weights.into_iter().enumerate() {
            let first = MIXTURES + i as u32 * SECTIONS_PER_MIXTURE;
            let [n_of_gaussian, n_rows] = layout.value::<[u64; 2]>(bytes, first, "lengths")?.map(len);
            let of_gaussian = layout.column::<u32>(first + 1, "superpoints", n_of_gaussian)?;
            let rows = layout.column::<RegionRow>(first + 2, "regions", n_rows)?;
            let rows: Vec<RegionRow> = bytemuck::pod_collect_to_vec(&bytes[rows]);
            if n_of_gaussian != n_gaussians
                || rows.iter().any(|row| row.region != NONE && row.region as usize >= n_regions)
            {
                return Err(damaged("superpoints of another scene".into()));
            }
            let region = |row: RegionRow| {
                let RegionRow { region, length } = row;
                (region != NONE).then_some(MixtureRegion { region, length })
            };
            mixtures.push(Mixtures {
                weight,
                of_gaussian: bytemuck::pod_collect_to_vec(&bytes[of_gaussian]),
                regions: rows.into_iter().map(region).collect(),
            });
        }
        Ok(Self {
            settings,
            first_regions: FirstRegions(bytemuck::pod_collect_to_vec(&bytes[first_regions])),
            mask_counts: bytemuck::pod_collect_to_vec(&bytes[mask_counts]),
            region_points: bytemuck::pod_collect_to_vec(&bytes[region_points]),
            mixtures,
        })
    }
}
