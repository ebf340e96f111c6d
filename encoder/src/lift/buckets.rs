//! Brings the sums of all views together by cell, within a memory budget.

use std::io::{self, Write};
use std::path::PathBuf;

use bytemuck::{Pod, Zeroable};

/// A sum `a(k, r)`: the blending weight of a Gaussian over the pixels of a region.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct SumEntry {
    /// The Gaussian, by its index within its cell.
    pub local: u32,
    /// The region: a view's own until it is put into a bucket, then of the whole scene.
    pub region: u32,
    /// The sum.
    pub weight: f32,
}

/// One growing list of entries a cell, spilled to files when they outgrow the budget.
///
/// Entries come back in the order in which they were put in, spilled or not.
pub struct CellBuckets {
    folder: PathBuf,
    in_memory: Vec<Vec<SumEntry>>,
    spilled_entries: Vec<u64>,
    entries_in_memory: usize,
    max_entries_in_memory: usize,
}

impl CellBuckets {
    /// Starts with empty buckets. Files of an earlier, interrupted run in `folder` are removed.
    ///
    /// # Errors
    /// Whatever the file system gives.
    pub fn new(folder: PathBuf, n_cells: usize, memory_bytes: u64) -> io::Result<Self> {
        if folder.exists() {
            fs_err::remove_dir_all(&folder)?;
        }
        fs_err::create_dir_all(&folder)?;
        Ok(Self {
            folder,
            in_memory: vec![Vec::new(); n_cells],
            spilled_entries: vec![0; n_cells],
            entries_in_memory: 0,
            // Vectors grow by doubling: half of the budget may be slack.
            max_entries_in_memory: (memory_bytes as usize / 2 / size_of::<SumEntry>()).max(1),
        })
    }

    /// Appends a view's entries of one cell, its regions renumbered from `first_region` on.
    ///
    /// # Errors
    /// Whatever the file system gives when the buckets are spilled.
    pub fn put(&mut self, cell_id: u32, first_region: u32, entries: &[SumEntry]) -> io::Result<()> {
        let renumbered = entries.iter().map(|e| SumEntry { region: e.region + first_region, ..*e });
        self.in_memory[cell_id as usize].extend(renumbered);
        self.entries_in_memory += entries.len();
        if self.entries_in_memory > self.max_entries_in_memory {
            self.spill()?;
        }
        Ok(())
    }

    fn path(&self, cell_id: usize) -> PathBuf {
        self.folder.join(format!("{cell_id}.entries"))
    }

    fn spill(&mut self) -> io::Result<()> {
        for cell_id in 0..self.in_memory.len() {
            let entries = std::mem::take(&mut self.in_memory[cell_id]);
            if !entries.is_empty() {
                let mut file =
                    fs_err::OpenOptions::new().create(true).append(true).open(self.path(cell_id))?;
                file.write_all(bytemuck::cast_slice(&entries))?;
                self.spilled_entries[cell_id] += entries.len() as u64;
            }
        }
        self.entries_in_memory = 0;
        Ok(())
    }

    /// Returns all entries of a cell and forgets them.
    ///
    /// # Errors
    /// Whatever the file system gives.
    pub fn take(&mut self, cell_id: u32) -> io::Result<Vec<SumEntry>> {
        let cell_id = cell_id as usize;
        let rest = std::mem::take(&mut self.in_memory[cell_id]);
        self.entries_in_memory -= rest.len();
        if self.spilled_entries[cell_id] == 0 {
            return Ok(rest);
        }
        let mut entries = vec![SumEntry::zeroed(); self.spilled_entries[cell_id] as usize];
        let mut file = fs_err::File::open(self.path(cell_id))?;
        io::Read::read_exact(&mut file, bytemuck::cast_slice_mut(&mut entries))?;
        fs_err::remove_file(self.path(cell_id))?;
        self.spilled_entries[cell_id] = 0;
        entries.extend(rest);
        Ok(entries)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: plain vectors. The smaller budget spills many times.
    #[test]
    fn spilled_buckets_give_the_same_entries_in_the_same_order() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        for memory_bytes in [0, 500, 1 << 20] {
            let mut buckets = CellBuckets::new(dir.path().join("b"), 3, memory_bytes).expect("opens");
            let mut expected = vec![Vec::new(); 3];
            for i in 0..200u32 {
                let entries: Vec<SumEntry> =
                    (0..i % 7).map(|j| SumEntry { local: j, region: j, weight: (i * j) as f32 }).collect();
                buckets.put(i % 3, i, &entries).expect("puts");
                expected[(i % 3) as usize]
                    .extend(entries.iter().map(|e| SumEntry { region: e.region + i, ..*e }));
            }
            for cell_id in [2, 0, 1] {
                assert_eq!(buckets.take(cell_id).expect("takes"), expected[cell_id as usize]);
            }
        }
    }
}
