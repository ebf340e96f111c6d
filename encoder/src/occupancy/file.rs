//! The file form of a scene's occupancy, for machines that build its cells.

use std::io::{self, Write};

use bytemuck::AnyBitPattern;
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};
use slag_common::occupancy::{BuiltOccupancy, Occupancy, OccupancyHeader, StoredRun};

use super::{OccupancyReport, SceneOccupancy};

const MAGIC: [u8; 8] = *b"SLAGOCCU";
const VERSION: u32 = 1;

impl SceneOccupancy {
    /// Writes the file form, without the report.
    ///
    /// # Errors
    /// Errors of the writer.
    pub fn write(&self, out: impl Write) -> io::Result<()> {
        let views = || self.cells.iter().map(BuiltOccupancy::view);
        let headers: Vec<OccupancyHeader> = views().map(|cell| cell.header).collect();
        let runs: Vec<StoredRun> = views().flat_map(|cell| cell.runs).copied().collect();
        let masks: Vec<[u64; 2]> = views().flat_map(|cell| cell.masks).copied().collect();
        let sections = [
            (1, container::bytes_of(&headers)),
            (2, container::bytes_of(&runs)),
            (3, container::bytes_of(&masks)),
        ];
        container::write(out, MAGIC, VERSION, &sections)
    }

    /// Reads the file form; the report is empty. `n_cells`: of the scene.
    ///
    /// # Errors
    /// [`ContainerError`], naming the byte; also if the places belong to other cells.
    pub fn from_bytes(bytes: &AlignedBytes, n_cells: usize) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let headers: Vec<OccupancyHeader> = column(bytes, &layout, (1, "cells"), n_cells)?;
        let sum = |count: fn(&OccupancyHeader) -> u32| headers.iter().map(|cell| count(cell) as usize).sum();
        let runs: Vec<StoredRun> = column(bytes, &layout, (2, "runs of blocks"), sum(|cell| cell.n_runs))?;
        let masks: Vec<[u64; 2]> = column(bytes, &layout, (3, "masks of blocks"), sum(|cell| cell.n_mixed))?;
        let (mut runs, mut masks) = (&runs[..], &masks[..]);
        let cells = headers.into_iter().map(|header| {
            let (of_cell, masks_of_cell);
            (of_cell, runs) = runs.split_at(header.n_runs as usize);
            (masks_of_cell, masks) = masks.split_at(header.n_mixed as usize);
            BuiltOccupancy::copy_of(Occupancy { header, runs: of_cell, masks: masks_of_cell })
        });
        Ok(Self { cells: cells.collect(), report: OccupancyReport::default() })
    }
}

fn column<T: AnyBitPattern + bytemuck::NoUninit>(
    bytes: &AlignedBytes,
    layout: &Layout,
    (id, name): (u32, &'static str),
    n: usize,
) -> Result<Vec<T>, ContainerError> {
    Ok(bytemuck::pod_collect_to_vec(&bytes[layout.column::<T>(id, name, n)?]))
}

#[cfg(test)]
mod tests {
    use slag_common::occupancy::Block;

    use super::*;

    /// Three cells, one of them empty.
    #[test]
    fn occupancy_comes_back_bit_by_bit() {
        let block = |z, occupied, free| Block { at: [-3, 7, z], occupied, free };
        let of_blocks = [vec![block(0, 1, 2), block(1, 0, !0)], vec![], vec![block(5, 4, 8)]];
        let cells = of_blocks.iter().map(|blocks| BuiltOccupancy::pack(0.05, 0.1, 2, blocks)).collect();
        let scene = SceneOccupancy { cells, report: OccupancyReport::default() };
        let mut bytes = Vec::new();
        scene.write(&mut bytes).expect("writes");
        let bytes = AlignedBytes::copy_of(&bytes);
        let back = SceneOccupancy::from_bytes(&bytes, 3).expect("reads");
        assert_eq!(back.cells, scene.cells);
        let refused = SceneOccupancy::from_bytes(&bytes, 2).err().expect("other cells").to_string();
        assert!(refused.contains("cells"), "{refused}");
    }
}
