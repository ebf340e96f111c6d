//! The file form of a scene's objects, for machines that build its cells.

use std::io::{self, Write};

use slag_common::container::{self, AlignedBytes, ContainerError, Layout};
use slag_common::manifest::Calibration;

use super::object::{NONE, Object, ObjectsReport, SceneObjects};

const MAGIC: [u8; 8] = *b"SLAGOBJS";
const VERSION: u32 = 1;

impl SceneObjects {
    /// Writes the file form, without the report.
    ///
    /// # Errors
    /// Errors of the writer.
    pub fn write(&self, out: impl Write) -> io::Result<()> {
        let objects = serde_json::to_vec(&(&self.objects, &self.calibration))?;
        let vectors: Vec<f32> = self.objects.iter().flat_map(|object| &object.vectors).copied().collect();
        let ends = |lens: &mut dyn Iterator<Item = usize>| -> Vec<u64> {
            lens.scan(0, |end, len| {
                *end += len as u64;
                Some(*end)
            })
            .collect()
        };
        let vector_ends = ends(&mut self.objects.iter().map(|object| object.vectors.len()));
        let cell_ends = ends(&mut self.object_of.iter().map(Vec::len));
        let counts = [self.objects.len() as u64, self.object_of.len() as u64];
        let object_of = self.object_of.concat();
        let sections = [
            (1, bytemuck::bytes_of(&counts)),
            (2, &objects[..]),
            (3, container::bytes_of(&vector_ends)),
            (4, container::bytes_of(&vectors)),
            (5, container::bytes_of(&cell_ends)),
            (6, container::bytes_of(&object_of)),
        ];
        container::write(out, MAGIC, VERSION, &sections)
    }

    /// Reads the file form; the report is empty. `n_gaussians_of_cell`: of the scene.
    ///
    /// # Errors
    /// [`ContainerError`], naming the byte; also if the objects belong to other cells.
    pub fn from_bytes(bytes: &AlignedBytes, n_gaussians_of_cell: &[usize]) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let damaged = |section: u32, what: &str| ContainerError::Damaged {
            offset_bytes: layout.find(section).map_or(0, |range| range.start as u64),
            what: what.to_owned(),
        };
        let [n_objects, n_cells] =
            layout.value::<[u64; 2]>(bytes, 1, "counts")?.map(|n| usize::try_from(n).unwrap_or(usize::MAX));
        let listed = layout.find(2).ok_or(ContainerError::Missing { id: 2, name: "objects" })?;
        let (mut objects, calibration): (Vec<Object>, Calibration) =
            serde_json::from_slice(&bytes[listed]).map_err(|e| damaged(2, &e.to_string()))?;
        let pieces = |section: u32, n: usize, of: u32, name: &'static str| {
            let ends = layout.column::<u64>(section, name, n)?;
            let ends: Vec<u64> = bytemuck::pod_collect_to_vec(&bytes[ends]);
            let total = ends.last().map_or(0, |end| usize::try_from(*end).unwrap_or(usize::MAX));
            let values: Vec<u32> =
                bytemuck::pod_collect_to_vec(&bytes[layout.column::<u32>(of, name, total)?]);
            let starts = std::iter::once(0).chain(ends.iter().copied());
            let piece =
                |(start, end): (u64, u64)| values.get(start as usize..end as usize).map(<[u32]>::to_vec);
            let pieces: Option<Vec<Vec<u32>>> = starts.zip(ends.iter().copied()).map(piece).collect();
            pieces.ok_or_else(|| damaged(section, "ends are out of order"))
        };
        if objects.len() != n_objects {
            return Err(damaged(2, &format!("{} objects, expected {n_objects}", objects.len())));
        }
        for (object, vectors) in objects.iter_mut().zip(pieces(3, n_objects, 4, "vectors")?) {
            object.vectors = vectors.into_iter().map(f32::from_bits).collect();
        }
        let object_of = pieces(5, n_cells, 6, "object of each Gaussian")?;
        let is_known = |object: &u32| *object == NONE || (*object as usize) < n_objects;
        if !object_of.iter().map(Vec::len).eq(n_gaussians_of_cell.iter().copied())
            || !object_of.iter().flatten().all(is_known)
        {
            return Err(damaged(6, "the objects belong to other cells"));
        }
        Ok(Self { objects, object_of, calibration, report: ObjectsReport::default() })
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use slag_common::frames::Aabb;

    use super::*;

    #[test]
    fn objects_come_back_bit_by_bit() {
        let object = |id, vectors: &[f32]| Object {
            id,
            n_gaussians: 12,
            n_masks: 3,
            position_in_world: DVec3::new(0.1, -2.0 / 3.0, 1e-300),
            box_in_world: Aabb { min: DVec3::splat(-1.0 / 3.0), max: DVec3::splat(0.7) },
            vectors: vectors.to_vec(),
            photo: "left/a.png".into(),
            photo_box_px: [1, 2, 3, 4],
        };
        let objects = SceneObjects {
            objects: vec![object(u64::MAX, &[0.1, -0.0, f32::MIN_POSITIVE]), object(7, &[])],
            object_of: vec![vec![0, NONE, 1], vec![], vec![1]],
            calibration: Calibration { score_mean: 0.1, score_spread: 1.0 / 3.0 },
            report: ObjectsReport::default(),
        };
        let mut bytes = Vec::new();
        objects.write(&mut bytes).expect("writes");
        let bytes = AlignedBytes::copy_of(&bytes);
        assert_eq!(SceneObjects::from_bytes(&bytes, &[3, 0, 1]).expect("reads"), objects);
        let refused = SceneObjects::from_bytes(&bytes, &[3, 1, 0]).expect_err("other cells").to_string();
        assert!(refused.contains("other cells"), "{refused}");
    }
}
