//! Shards of every profile, region tables and fields of a store equal the recorded ones to the byte.
//!
//! To record an intended change of `golden/store_bytes.txt`: `SLAG_RECORD=1 cargo test --workspace --test system
//! store_bytes::`; say why in the commit.

use super::*;

use slag_common::Hash32;
use slag_tests::*;

/// Section of a shard that holds its header.
const HEADER_SECTION: u32 = 1;
/// The encoder id within the header; it names the model, not the contents, and is excluded from digests.
const ENCODER_ID: std::ops::Range<usize> = 144..176;

#[test]
fn generated_scenes_have_the_recorded_bytes() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    for (scene, kinds, seed) in [("room", "room", "601"), ("yard", "yard", "602"), ("demo", "room,yard", "1")]
    {
        let made = dir.path().join(scene);
        run(lab(&["generate", "scene", "--kind", kinds, "--seed", seed, "--n-views", "12"])
            .args(["--out", text(&made)]));
        let mut encode = encoder(&["encode", "--scene", text(&made.join("scene.ply"))]);
        encode.args(["--views", text(&made.join("transforms.json")), "--masks", "graph"]);
        check(scene, encode.args(["--cell-gaussians", "16384"]), dir.path());
    }
}

/// Given masks, half-labelled photos, Gaussians of a trainer.
#[needs_shared]
fn the_house_has_the_recorded_bytes() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let house = shared("scenes/house_a");
    let mut encode = encoder(&["encode", "--scene", text(&house.join("point_cloud.ply"))]);
    encode.args(["--views", text(&house.join("transforms.json")), "--masks", text(&house.join("gt/masks"))]);
    check("house", &mut encode, dir.path());
}

fn check(scene: &str, encode: &mut std::process::Command, dir: &Path) {
    let store = match std::env::var_os("SLAG_RECORD_FROM") {
        Some(stores) => PathBuf::from(stores).join(scene),
        None => {
            let store = dir.join("store").join(scene);
            encode.args(["--models", "colours", "--metric", "--device", "cpu", "--quiet"]);
            run(encode.args(["--name", scene, "--store", text(&store)]).env("SOURCE_DATE_EPOCH", "0"));
            store
        }
    };
    let found = digests(&store);
    let path = root().join("tests/golden/store_bytes.txt");
    if std::env::var_os("SLAG_RECORD").is_some() {
        return record(&path, scene, &found);
    }
    let mut expected = read(&path);
    let expected = expected.remove(scene).expect("the scene is recorded");
    let differing: Vec<&String> =
        found.keys().chain(expected.keys()).filter(|kind| found.get(*kind) != expected.get(*kind)).collect();
    assert!(differing.is_empty(), "{scene}: these differ from {}: {differing:?}", path.display());
}

/// Digests of each shard, region table and field of a store.
fn digests(store: &Path) -> BTreeMap<String, String> {
    let reader = StoreReader::open(store).expect("a published store");
    let digest = |hash: Hash32, masked| {
        let bytes = reader.read_object(hash).expect("the object is there");
        digest_of_sections(&bytes, masked)
    };
    let mut digests = BTreeMap::new();
    for cell in &reader.manifest().cells {
        for (profile, shard) in &cell.shards {
            digests.insert(format!("shard/{}/{profile}", cell.cell_id), digest(shard.hash, Some(ENCODER_ID)));
        }
    }
    for (name, hash) in &reader.current().extras {
        if name == "regions" || name.starts_with("field/") {
            digests.insert(name.clone(), digest(*hash, None));
        }
    }
    digests
}

/// Digest of the ids and contents of a container's sections; magic, version and checksums may change.
fn digest_of_sections(bytes: &[u8], masked_in_header: Option<std::ops::Range<usize>>) -> String {
    let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
    let u64_at = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes")) as usize;
    let mut contents = Vec::with_capacity(bytes.len());
    for row in 0..u32_at(12) as usize {
        let at = 32 + row * 32;
        let (id, start, len) = (u32_at(at), u64_at(at + 8), u64_at(at + 16));
        contents.extend(id.to_le_bytes());
        contents.extend((len as u64).to_le_bytes());
        let section = contents.len();
        contents.extend(&bytes[start..start + len]);
        if let (HEADER_SECTION, Some(masked)) = (id, &masked_in_header) {
            contents[section + masked.start..section + masked.end].fill(0);
        }
    }
    Hash32::of(&contents).to_string()
}

fn read(path: &Path) -> BTreeMap<String, BTreeMap<String, String>> {
    let mut scenes: BTreeMap<String, BTreeMap<String, String>> = BTreeMap::new();
    for line in fs_err::read_to_string(path).unwrap_or_default().lines() {
        let [scene, kind, digest] = line.split('\t').collect::<Vec<_>>()[..] else { panic!("{line}") };
        scenes.entry(scene.into()).or_default().insert(kind.into(), digest.into());
    }
    scenes
}

fn record(path: &Path, scene: &str, digests: &BTreeMap<String, String>) {
    static ONE_AT_A_TIME: std::sync::Mutex<()> = std::sync::Mutex::new(());
    let _guard = ONE_AT_A_TIME.lock().expect("no writer panicked");
    let mut scenes = read(path);
    scenes.insert(scene.into(), digests.clone());
    let lines = scenes.iter().flat_map(|(scene, digests)| {
        digests.iter().map(move |(kind, digest)| format!("{scene}\t{kind}\t{digest}\n"))
    });
    fs_err::write(path, lines.collect::<String>()).expect("the recorded list is writable");
}
