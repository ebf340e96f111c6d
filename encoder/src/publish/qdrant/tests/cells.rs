//! One collection a cell, and snapshots.

use super::server::Stored;
use super::*;

const NAMES: [&str; 3] = ["yard-cell-0", "yard-cell-1", "yard-cell-2"];

fn cells(url: &str) -> PushOptions {
    PushOptions { layout: Layout::Cells, ..options(url) }
}

fn vectors() -> qdrant_client::qdrant::VectorParams {
    VectorParamsBuilder::new(DIM as u64, Distance::Cosine).build()
}

/// A point of this scene, which another store has, too.
pub(super) fn held_of(scene: &str) -> Held {
    let mut held = Held::new(vectors());
    let payload = [("scene", scene), ("store", "another")].map(|(key, value)| (key.to_owned(), value.into()));
    held.points.insert(7, Stored { vector: vec![1.0; DIM], payload: payload.into() });
    held
}

fn names(server: &Server) -> Vec<String> {
    server.with(|state| state.collections.keys().cloned().collect())
}

impl Fixture {
    /// Each cell's collection holds only that cell's points, and together they hold all.
    fn assert_cells_arrived(&self, server: &Server, generation: i64) {
        let collections = server.with(|state| state.collections.clone());
        let n_cells = self.store.reader().expect("published").manifest().cells.len();
        let mut all = BTreeMap::new();
        for (cell_id, name) in NAMES.iter().enumerate().take(n_cells) {
            let held = &collections[*name];
            let of_cell = self.truth.iter().filter(|(_, (_, _, cell))| *cell as usize == cell_id);
            let expected: Vec<&u64> = of_cell.map(|(id, _)| id).collect();
            assert_eq!(held.points.keys().collect::<Vec<_>>(), expected, "{name}");
            assert_eq!(held.indexed, ["scene", "store", "generation", "location"], "{name}");
            all.extend(held.points.clone());
        }
        self.assert_points(&all, generation);
    }
}

#[tokio::test]
async fn each_cell_has_its_collection_with_its_points_and_settings() {
    let (fixture, server, url) = started().await;
    let index = IndexSettings { hnsw_m: Some(0), ..IndexSettings::default() };
    let options = PushOptions { index, ..cells(&url) };
    let (report, seen) = fixture.push_until(&options, std::future::pending()).await.expect("pushes");
    let expected = PushReport {
        n_points: N_POINTS,
        n_sent: N_POINTS,
        n_without_evidence: 17,
        n_collections: 3,
        n_created_collections: 3,
        ..PushReport::default()
    };
    assert_eq!(report, expected);
    let n_points: Vec<u64> = seen.iter().map(|at| at.n_points).collect();
    assert!(n_points.is_sorted() && n_points.last() == Some(&N_POINTS), "{n_points:?}");
    // The cell without any embedding too.
    assert_eq!(names(&server), NAMES);
    fixture.assert_cells_arrived(&server, 1);
    for created in server.with(|state| state.created.clone()) {
        assert_eq!(created.hnsw_config.and_then(|hnsw| hnsw.m), Some(0), "{}", created.collection_name);
    }
}

/// A dropped cell, or one with a lost point, is pushed again; the others stay.
#[tokio::test]
async fn a_cell_is_repaired_alone() {
    let (fixture, server, url) = started().await;
    fixture.push(&cells(&url)).await.expect("pushes");
    server.with(|state| state.collections.remove(NAMES[0]));
    // Cut off in the new collection: the old one's record must not count.
    let n_before = server.with(|state| state.acknowledged.len());
    fixture.push_cut_off(&server, &cells(&url), n_before + 2).await.expect_err("stopped");
    assert_eq!(fixture.push(&cells(&url)).await.expect("fills it again").n_points, N_POINTS);
    fixture.assert_cells_arrived(&server, 1);
    server.with(|state| state.collections.get_mut(NAMES[2]).expect("pushed").points.pop_first());
    let lost = fixture.push(&cells(&url)).await.expect_err("a point is missing");
    let PushError::Count { collection, expected: 45, found: 44 } = &lost else { panic!("{lost}") };
    assert_eq!(collection, NAMES[2]);
    let report = fixture.push(&cells(&url)).await.expect("starts over");
    assert_eq!((report.n_points, report.n_sent), (N_POINTS, 45));
    fixture.assert_cells_arrived(&server, 1);
}

#[tokio::test]
async fn a_new_generation_replaces_cells_and_deletes_those_it_lacks() {
    let (mut fixture, server, url) = started().await;
    fixture.push(&cells(&url)).await.expect("pushes");
    // Of an earlier generation pushed from elsewhere, of another scene, empty, and of other names.
    let others = [
        ("yard-cell-31", held_of("yard")),
        ("yard-cell-32", held_of("attic")),
        ("yard-cell-33", Held::new(vectors())),
        ("yard", held_of("yard")),
        ("yard-cell-007", held_of("yard")),
        ("yard-cell-+7", held_of("yard")),
        ("yard-cell-3-cell-1", held_of("yard")),
        ("backyard-cell-5", held_of("yard")),
    ];
    let others = others.map(|(name, held)| (name.to_owned(), held));
    server.with(|state| state.collections.extend(others));
    // The second cell is now empty; the third is gone as well.
    fixture.publish_cells(2, 20, &[(30, 25)]);
    let report = fixture.push(&cells(&url)).await.expect("pushes");
    assert_eq!((report.n_points, report.n_collections, report.n_created_collections), (25, 1, 0));
    assert_eq!(report.deleted_collections, ["yard-cell-1", "yard-cell-2"]);
    let left = [
        "backyard-cell-5",
        "yard",
        "yard-cell-+7",
        "yard-cell-0",
        "yard-cell-007",
        "yard-cell-3-cell-1",
        "yard-cell-31",
        "yard-cell-32",
        "yard-cell-33",
    ];
    assert_eq!(names(&server), left);
    fixture.assert_cells_arrived(&server, 2);

    // A generation with these cells makes them anew.
    fixture.publish(3, 0);
    server.with(|state| state.collections.retain(|name, _| name == NAMES[0]));
    let report = fixture.push(&cells(&url)).await.expect("pushes");
    assert_eq!((report.n_points, report.n_created_collections), (N_POINTS, 2));
    fixture.assert_cells_arrived(&server, 3);
    // The other layout leaves the cells alone.
    assert_eq!(fixture.push(&options(&url)).await.expect("pushes").deleted_collections, [""; 0]);
    fixture.assert_cells_arrived(&server, 3);
    fixture.assert_arrived(&server, 3);
}

/// The last cell's collection is foreign: nothing is written to the first ones, either.
#[tokio::test]
async fn foreign_cells_are_refused_before_anything_is_written() {
    let (fixture, server, url) = started().await;
    server.with(|state| state.collections.insert(NAMES[2].into(), held_of("attic")));
    let refused = fixture.push(&cells(&url)).await.expect_err("another scene");
    let PushError::OtherStore { collection, n_points: 1, .. } = &refused else { panic!("{refused}") };
    assert_eq!(collection, NAMES[2]);
    assert_eq!(names(&server), [NAMES[2]]);
    let mut held = Held::new(vectors());
    held.vectors.size += 1;
    server.with(|state| state.collections.insert(NAMES[2].into(), held));
    let refused = fixture.push(&cells(&url)).await.expect_err("other vectors");
    assert!(matches!(refused, PushError::Collection { .. }), "{refused}");
    assert_eq!((names(&server), server.with(|state| state.acknowledged.len())), (vec![NAMES[2].into()], 0));
}

fn snapshot(collection: &str, number: usize, n_points: u64) -> Snapshot {
    Snapshot {
        collection: collection.into(),
        name: format!("{collection}-{number}.snapshot"),
        size_bytes: 1000 + n_points,
        sha256: Some(format!("sha256 of {collection}")),
    }
}

#[tokio::test]
async fn each_collection_has_a_snapshot_of_its_generation() {
    let (fixture, server, url) = started().await;
    assert_eq!(fixture.push(&cells(&url)).await.expect("pushes").snapshots, [], "none unless asked");
    let options = PushOptions { snapshots: true, ..cells(&url) };
    server.with(|state| state.n_snapshots_allowed = Some(2));
    assert_error(fixture.push(&options).await, &["create a snapshot", "the disk is full"]);
    server.with(|state| state.n_snapshots_allowed = None);
    let report = fixture.push(&options).await.expect("goes on");
    let made = [snapshot(NAMES[0], 2, 50), snapshot(NAMES[1], 2, 0), snapshot(NAMES[2], 1, 45)];
    assert_eq!(report.snapshots, made);
    let json = serde_json::to_value(&report).expect("JSON");
    let expected = serde_json::json!({
        "collection": "yard-cell-2",
        "name": "yard-cell-2-1.snapshot",
        "size_bytes": 1045,
        "sha256": "sha256 of yard-cell-2",
    });
    assert_eq!(json["snapshots"][2], expected);
    // Of a scene in one collection.
    let one = PushOptions { snapshots: true, ..super::options(&url) };
    assert_eq!(fixture.push(&one).await.expect("pushes").snapshots, [snapshot("yard", 1, N_POINTS)]);
}
