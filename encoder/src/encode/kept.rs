//! The inputs of the views that a store keeps: an encode that cannot reuse these views says why, and how many Gaussians of the splat
//! are the same.

use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use slag_common::{Gaussians, Hash32, durable};

/// The file in the job's folder: the record as a line of JSON, then a fingerprint a Gaussian, sorted, 8 bytes each.
const FILE: &str = "inputs";

/// Bytes of the line, at most: it has two hashes.
const MAX_LINE_BYTES: usize = 1024;

/// The inputs that all views depend on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct InputsRecord {
    /// The splat: means, rotations, scales and opacities.
    pub(super) scene: Hash32,
    /// Models and settings of views.
    pub(super) settings: Hash32,
}

/// Kept views that an encode cannot take over, since their splat, models or settings were others.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LostViews {
    /// How many were kept.
    pub n_views: usize,
    /// What the splat shares with theirs; absent where it is the same, or where nothing is known of theirs.
    pub splat: Option<SharedGaussians>,
    /// All this in words.
    pub reason: String,
}

/// Gaussians of two splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct SharedGaussians {
    /// Gaussians whose means, rotations, scales and opacities have the same bits in both, wherever they stand in the files.
    pub n_same: u64,
    /// Gaussians of the splat of the kept views.
    pub n_before: u64,
    /// Gaussians of this encode's.
    pub n_now: u64,
}

/// Records what the kept views were made from. `job`: the folder of the job.
///
/// # Errors
/// If the file cannot be written.
pub(super) fn remember(job: &Path, record: &InputsRecord, scene: &Gaussians) -> std::io::Result<()> {
    if read_line(job).is_some_and(|(found, _)| found == *record) {
        return Ok(());
    }
    let mut bytes = serde_json::to_vec(record)?;
    bytes.push(b'\n');
    fingerprints(scene).iter().for_each(|fingerprint| bytes.extend(fingerprint.to_le_bytes()));
    durable::write(&path(job), &bytes)
}

/// Says why none of `n_views` kept views can be taken over. `job`: their folder; `own`, `scene`: what this encode has.
pub(super) fn lost(job: &Path, n_views: usize, own: &InputsRecord, scene: &Gaussians) -> LostViews {
    let kept = read_line(job);
    let has_other_settings = kept.as_ref().is_some_and(|(record, _)| record.settings != own.settings);
    let splat = kept.filter(|(record, _)| record.scene != own.scene);
    // Of a file that ends too early nothing is known.
    let splat = splat.and_then(|(_, file)| share(&fingerprints(scene), file).ok());
    let because = "no view is taken over, since what a Gaussian contributes to a photo depends on all those before it; \
                   all views are done anew";
    let reason = match (splat, has_other_settings) {
        (Some(SharedGaussians { n_same, n_before, n_now }), others) => {
            let settings = if others { ", and so are models or settings of views" } else { "" };
            format!(
                "the splat is another than that of the {n_views} kept views{settings}: of its {n_now} Gaussians {n_same} are the same as \
                 before ({n_before} then); {because}"
            )
        }
        (None, true) => format!(
            "models or settings of views are others than those of the {n_views} kept views; all views are done anew"
        ),
        (None, false) => format!(
            "the splat, models or settings of views are others than those of the {n_views} kept views; all views are done anew"
        ),
    };
    LostViews { n_views, splat, reason }
}

fn path(job: &Path) -> PathBuf {
    job.join(FILE)
}

/// Reads the record, and leaves the file at the first fingerprint; `None` where there is none.
fn read_line(job: &Path) -> Option<(InputsRecord, BufReader<fs_err::File>)> {
    let mut file = BufReader::new(fs_err::File::open(path(job)).ok()?);
    let mut line = Vec::new();
    for byte in file.by_ref().bytes().take(MAX_LINE_BYTES) {
        match byte.ok()? {
            b'\n' => return Some((serde_json::from_slice(&line).ok()?, file)),
            byte => line.push(byte),
        }
    }
    None
}

/// Counts what a sorted list of fingerprints has in common with a file of them.
///
/// # Errors
/// If the file cannot be read, or ends within a fingerprint.
fn share(own: &[u64], mut file: impl Read) -> std::io::Result<SharedGaussians> {
    let (mut own_left, mut n_same, mut n_before) = (own, 0, 0);
    loop {
        let mut bytes = [0; 8];
        match file.read(&mut bytes[..1])? {
            0 => return Ok(SharedGaussians { n_same, n_before, n_now: own.len() as u64 }),
            _ => file.read_exact(&mut bytes[1..])?,
        }
        let fingerprint = u64::from_le_bytes(bytes);
        n_before += 1;
        own_left = &own_left[own_left.partition_point(|own| *own < fingerprint)..];
        if own_left.first() == Some(&fingerprint) {
            n_same += 1;
            own_left = &own_left[1..];
        }
    }
}

/// Returns a fingerprint of each Gaussian, sorted: `[N]`, the first 8 bytes of a hash of what its contributions depend on.
fn fingerprints(scene: &Gaussians) -> Vec<u64> {
    let fingerprint = |i: usize| {
        let mut bytes = [0; 56];
        bytes[..24].copy_from_slice(bytemuck::bytes_of(&scene.means_in_world[i]));
        bytes[24..40].copy_from_slice(bytemuck::bytes_of(&scene.rotations_wxyz[i]));
        bytes[40..52].copy_from_slice(bytemuck::bytes_of(&scene.scales[i]));
        bytes[52..].copy_from_slice(bytemuck::bytes_of(&scene.opacities[i]));
        let hash = Hash32::of(&bytes).0;
        u64::from_le_bytes(std::array::from_fn(|i| hash[i]))
    };
    let mut all: Vec<u64> = (0..scene.len()).into_par_iter().map(fingerprint).collect();
    all.par_sort_unstable();
    all
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// Gaussians that differ by their place alone.
    fn scene(places: &[f64]) -> Gaussians {
        let n = places.len();
        Gaussians {
            means_in_world: places.iter().map(|x| DVec3::new(*x, 0.0, 1.0)).collect(),
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[0.1; 3]; n],
            opacities: vec![0.5; n],
            ..Gaussians::default()
        }
    }

    fn record(scene: u8, settings: u8) -> InputsRecord {
        InputsRecord { scene: Hash32([scene; 32]), settings: Hash32([settings; 32]) }
    }

    /// By hand: two of five stayed, in another order, and one that was there twice stayed once; then each part of the record alone.
    #[test]
    fn what_stayed_is_counted_wherever_it_stands() {
        let dir = tempfile::tempdir().expect("a folder");
        remember(dir.path(), &record(1, 1), &scene(&[0.0, 1.0, 2.0, 2.0, 3.0])).expect("writes");
        let now = scene(&[9.0, 2.0, 8.0, 0.0]);
        let found = lost(dir.path(), 7, &record(2, 1), &now);
        assert_eq!(found.splat, Some(SharedGaussians { n_same: 2, n_before: 5, n_now: 4 }));
        assert!(found.reason.contains("7 kept views: of its 4 Gaussians 2"), "{}", found.reason);
        let mut thicker = scene(&[0.0, 1.0]);
        thicker.opacities[1] = 0.6;
        let both = lost(dir.path(), 7, &record(2, 2), &thicker);
        assert_eq!(both.splat.map(|splat| splat.n_same), Some(1));
        assert!(both.reason.contains("and so are models"), "{}", both.reason);

        let settings = lost(dir.path(), 7, &record(1, 2), &now);
        assert!(
            settings.splat.is_none() && settings.reason.starts_with("models or settings"),
            "{settings:?}"
        );
        // A file that was cut off, and none.
        let bytes = fs_err::read(path(dir.path())).expect("reads");
        fs_err::write(path(dir.path()), &bytes[..bytes.len() - 3]).expect("writes");
        for _ in 0..2 {
            let unknown = lost(dir.path(), 7, &record(2, 1), &now);
            assert!(
                unknown.splat.is_none() && unknown.reason.starts_with("the splat, models or"),
                "{unknown:?}"
            );
            let _ = fs_err::remove_file(path(dir.path()));
        }
    }
}
