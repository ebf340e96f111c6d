//! Every invalid value in every field of a scene: unusable Gaussians are rejected and counted, the store stays finite.

use super::*;

use slag_tests::*;

/// Converts a PLY of floats into one of doubles.
struct Ply {
    names: Vec<String>,
    rows: Vec<f64>,
}

impl Ply {
    fn read(path: &Path) -> Self {
        let bytes = fs_err::read(path).expect("reads");
        let end = b"end_header\n";
        let start = bytes.windows(end.len()).position(|w| w == end).expect("a header") + end.len();
        let header = std::str::from_utf8(&bytes[..start]).expect("text");
        let names = header
            .lines()
            .filter_map(|line| line.strip_prefix("property float "))
            .map(String::from)
            .collect();
        let value = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]).into();
        Self { names, rows: bytes[start..].chunks_exact(4).map(value).collect() }
    }

    fn len(&self) -> usize {
        self.rows.len() / self.names.len()
    }

    fn set(&mut self, row: usize, name: &str, value: f64) {
        let column = self.names.iter().position(|n| n == name).expect("the property is there");
        let at = row * self.names.len() + column;
        self.rows[at] = value;
    }

    fn write(&self, path: &Path) {
        let mut text = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", self.len());
        self.names.iter().for_each(|name| text += &format!("property double {name}\n"));
        let mut bytes = (text + "end_header\n").into_bytes();
        self.rows.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        fs_err::write(path, bytes).expect("writes");
    }
}

/// Values of some properties, and whether the Gaussian stays usable.
fn poisons() -> Vec<(Vec<(&'static str, f64)>, bool)> {
    let (nan, infinity) = (f64::NAN, f64::INFINITY);
    let rotation = ["rot_0", "rot_1", "rot_2", "rot_3"];
    let mut all = Vec::new();
    for name in ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"].into_iter().chain(rotation) {
        all.extend([nan, infinity, -infinity].map(|bad| (vec![(name, bad)], false)));
    }
    for name in ["scale_0", "scale_1", "scale_2"] {
        // Logarithms: minus infinity is a flat Gaussian; exp(100) exceeds f32.
        all.extend([nan, infinity, 100.0].map(|bad| (vec![(name, bad)], false)));
        all.push((vec![(name, -infinity)], true));
    }
    all.push((vec![("opacity", nan)], false));
    all.extend(
        [infinity, -infinity, 1e308, -1e308, 50.0, -50.0].map(|logit| (vec![("opacity", logit)], true)),
    );
    all.extend([1e308, -1e308, 1e39].map(|far| (vec![("x", far), ("y", -far)], false)));
    all.push((rotation.map(|name| (name, 0.0)).to_vec(), false));
    // Their squares are 0 even in f64.
    all.push((rotation.map(|name| (name, 1e-310)).to_vec(), false));
    all.push((rotation.map(|name| (name, 3e-42)).to_vec(), true));
    all.push((rotation.map(|name| (name, 5e30)).to_vec(), true));
    all
}

#[test]
fn a_poisoned_scene_leaves_no_nan_in_the_store() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (room, store, scene) = (generated(&ROOM), dir.path().join("store"), dir.path().join("poisoned.ply"));
    let mut ply = Ply::read(&room.join("scene.ply"));
    let poisons = poisons();
    let stride = ply.len() / (3 * poisons.len());
    let mut rejected = BTreeSet::new();
    for place in 0..3 * poisons.len() {
        let (values, is_usable) = &poisons[place % poisons.len()];
        let row = place * stride;
        values.iter().for_each(|(name, value)| ply.set(row, name, *value));
        if !is_usable {
            rejected.insert(row as u32);
        }
    }
    ply.write(&scene);

    let (views, cells) = (room.join("transforms.json"), "20000");
    let mut encode = encoder(&["encode", "--scene", text(&scene), "--views", text(&views)]);
    encode.args(["--masks", text(&room.join("gt/masks")), "--raster-width", "320"]);
    let summary = run_json(encode.args(["--cell-gaussians", cells, "--store", text(&store)]));
    let n_rejected = rejected.len() as u64;
    println!("{n_rejected} of {} Gaussians rejected", ply.len());
    assert_eq!(summary["n_rejected"], n_rejected);
    assert_eq!(summary["n_gaussians"], ply.len() as u64 - n_rejected);
    let reader = StoreReader::open(&store).expect("opens");
    let manifest = reader.manifest();
    assert_eq!((manifest.n_rejected, manifest.n_gaussians), (n_rejected, ply.len() as u64 - n_rejected));

    let table = read_regions(&reader).expect("regions");
    for component in 0..table.dim() {
        let mut query = vec![0.0; table.dim()];
        query[component] = 1.0;
        assert!(table.scores(&query).iter().all(|v| v.is_finite()));
    }
    let (mut stored, mut n_with_evidence) = (BTreeSet::new(), 0);
    for cell in &manifest.cells {
        let field = read_field(&reader, cell.cell_id, cell.n_gaussians, table.len()).expect("a field");
        let columns = [&field.weights, &field.total_weights, &field.mean_lengths];
        assert!(columns.into_iter().flatten().all(|v| v.is_finite() && *v >= 0.0));
        for (profile, shard) in &cell.shards {
            assert!(shard.score_error_bound.is_finite() && shard.position_error.is_finite());
            let bytes: AlignedBytes = reader.read_object(shard.hash).expect("a shard");
            let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
            assert!(shard.scores(&vec![1.0; shard.header.dim as usize]).iter().all(|v| v.is_finite()));
            assert!(shard.radii.iter().all(|v| v.is_finite()));
            assert!(shard.bounds().min.is_finite() && shard.bounds().max.is_finite());
            assert!((0..shard.header.n_gaussians as usize).all(|i| shard.position_in_world(i).is_finite()));
            if *profile == Profile::Exact {
                let exact = shard.exact.expect("exact");
                assert!(exact.embeddings.iter().all(|v| v.is_finite()));
                stored.extend(exact.input_indices);
                n_with_evidence += shard.n_with_evidence() as u64;
            }
        }
    }
    let usable: BTreeSet<u32> = (0..ply.len() as u32).filter(|row| !rejected.contains(row)).collect();
    assert!(stored == usable, "every usable Gaussian lies in a cell, and no other");
    assert_eq!(manifest.n_without_evidence, manifest.n_gaussians - n_with_evidence);
    assert!(n_with_evidence > manifest.n_gaussians / 4, "the poison must not blind the views");
}
