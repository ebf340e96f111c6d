mod cells;
mod collections;
mod index;
mod server;

use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Duration;

use clap::Parser;
use glam::DVec3;
use half::f16;
use qdrant_client::qdrant::{Distance, VectorParamsBuilder, value::Kind};
use slag_common::frames::{Aabb, GeoReference, Geographic};
use slag_common::manifest::ShardRecord;
use slag_common::shard::{ExactColumns, Positions, Profile, ScoreErrors, ShardHeader, ShardView};
use slag_math::random::Random;
use slag_test_support::assert_error;
use tonic::{Request, Response, Status};

use super::*;
use crate::store::tests::{manifest_of_boxes, new_store};
use crate::store::{Extras, Store};
use server::{Held, Server};

const DIM: usize = 16;
/// Gaussians of the cells, and those of them with an embedding.
const CELLS: [(u32, u32); 3] = [(60, 50), (7, 0), (45, 45)];
const N_POINTS: u64 = 95;
const BATCH: usize = 8;
/// 50 points in batches of 8, then 45.
const N_BATCHES: usize = 7 + 6;

/// A store of three cells, and what it was made from: id -> (mean, embedding, cell).
struct Fixture {
    _dir: tempfile::TempDir,
    store: Store,
    truth: BTreeMap<u64, (DVec3, Vec<f16>, u32)>,
}

fn fixture() -> Fixture {
    let (dir, store) = new_store();
    let mut fixture = Fixture { _dir: dir, store, truth: BTreeMap::new() };
    fixture.publish(1, 0);
    fixture
}

impl Fixture {
    /// `first_id`: first splat index.
    fn publish(&mut self, generation: u64, first_id: u32) {
        self.publish_cells(generation, first_id, &CELLS);
    }

    /// `cells`: Gaussians, and those of them with an embedding.
    fn publish_cells(&mut self, generation: u64, first_id: u32, cells: &[(u32, u32)]) {
        let mut random = Random::new(generation);
        self.truth.clear();
        let boxes: Vec<Aabb> = (0..cells.len())
            .map(|i| Aabb {
                min: DVec3::X * 100.0 * i as f64,
                max: DVec3::new(100.0 * i as f64 + 90.0, 90.0, 9.0),
            })
            .collect();
        let mut manifest = manifest_of_boxes(&boxes);
        manifest.generation = generation;
        manifest.encoder.dim = DIM as u32;
        let origin = Geographic { latitude_deg: 46.842657, longitude_deg: -91.994008, height_m: 158.5 };
        manifest.geo_reference = Some(GeoReference { origin });
        let mut next_id = first_id;
        for (cell, (n_gaussians, n_with_evidence)) in manifest.cells.iter_mut().zip(cells.iter().copied()) {
            let (n, n_with) = (n_gaussians as usize, n_with_evidence as usize);
            // Interleaved ids, so that shard order is not id order.
            let ids: Vec<u32> = (0..n_gaussians).map(|i| next_id + (i * 37) % n_gaussians).collect();
            next_id += n_gaussians;
            let positions: Vec<[u16; 3]> = (0..n as u16).map(|i| [i * 1000, 60_000 - i * 900, i]).collect();
            let embeddings: Vec<f16> =
                (0..n_with).flat_map(|_| random.unit_vector(DIM)).map(f16::from_f32).collect();
            let centroid_starts: &[u32] = if n_with == 0 { &[0] } else { &[0, n_with_evidence] };
            let n_centroids = centroid_starts.len() as u32 - 1;
            let header = ShardHeader {
                cell_id: cell.cell_id,
                n_gaussians,
                n_centroids,
                dim: DIM as u32,
                n_components: DIM as u32,
                n_subspaces: 0,
                position_bits: [16, 16, 16, 0],
                centroid_step: 1.0 / 127.0,
                errors: ScoreErrors::default(),
                origin_in_world: cell.bounds.min.to_array(),
                position_step: [90.0 / 65535.0; 3],
                box_min: cell.bounds.min.to_array(),
                box_max: cell.bounds.max.to_array(),
                encoder_id: manifest.encoder.id.0,
            };
            for i in 0..n_with {
                let steps = DVec3::from(positions[i].map(f64::from));
                let mean = cell.bounds.min + steps * (90.0 / 65535.0);
                let embedding = embeddings[i * DIM..(i + 1) * DIM].to_vec();
                self.truth.insert(u64::from(ids[i]), (mean, embedding, cell.cell_id));
            }
            let parts = ShardView {
                header,
                positions: Positions::Wide(&positions),
                centroid_starts,
                centroids: &vec![127; n_centroids as usize * DIM],
                radii: &vec![1.0; n_centroids as usize],
                basis: None,
                residuals: None,
                exact: Some(ExactColumns { input_indices: &ids, embeddings: &embeddings, fine: None }),
                packed_indices: None,
            };
            let (hash, len_bytes) = self.store.put_object(|out| parts.write(out)).expect("room");
            let record = ShardRecord {
                hash,
                len_bytes,
                n_centroids,
                score_error_bound: 1.0,
                score_errors: ScoreErrors::default(),
                position_error: 1e-3,
            };
            cell.n_gaussians = n_gaussians;
            cell.shards.insert(Profile::Exact, record);
        }
        manifest.n_gaussians = cells.iter().map(|cell| u64::from(cell.0)).sum();
        manifest.n_without_evidence = cells.iter().map(|cell| u64::from(cell.0 - cell.1)).sum();
        self.store.publish(&manifest, &Extras::new()).expect("publishes");
    }

    async fn push_until(
        &self,
        options: &PushOptions,
        cancel: impl Future<Output = ()> + Send,
    ) -> Result<(PushReport, Vec<PushProgress>), PushError> {
        let reader = self.store.reader().expect("published");
        let mut seen = Vec::new();
        let report = push(&reader, self.store.db(), options, |p| seen.push(p), cancel).await?;
        Ok((report, seen))
    }

    async fn push(&self, options: &PushOptions) -> Result<PushReport, PushError> {
        self.push_until(options, std::future::pending()).await.map(|(report, _)| report)
    }

    async fn push_cut_off(
        &self,
        server: &Server,
        options: &PushOptions,
        n_batches: usize,
    ) -> Result<PushReport, PushError> {
        let (stop, mut stopped) = tokio::sync::watch::channel(false);
        *server.watcher.lock().expect("free") = Some(Arc::new(move |n_acknowledged| {
            if n_acknowledged == n_batches {
                let _ = stop.send(true);
            }
        }));
        let cancel = async move {
            let _ = stopped.wait_for(|stop| *stop).await;
        };
        let ended = self.push_until(options, cancel).await;
        *server.watcher.lock().expect("free") = None;
        ended.map(|(report, _)| report)
    }

    /// The server holds exactly this generation, with every value as made.
    fn assert_arrived(&self, server: &Server, generation: i64) {
        self.assert_points(&server.with(|state| state.collections["yard"].points.clone()), generation);
    }

    /// The points are exactly this generation's, with every value as made.
    fn assert_points(&self, points: &BTreeMap<u64, server::Stored>, generation: i64) {
        assert_eq!(points.keys().collect::<Vec<_>>(), self.truth.keys().collect::<Vec<_>>());
        let reader = self.store.reader().expect("published");
        let reference = reader.manifest().geo_reference.expect("geo-referenced");
        for (id, (mean, embedding, cell_id)) in &self.truth {
            let point = &points[id];
            let expected: Vec<f32> = embedding.iter().map(|v| v.to_f32()).collect();
            assert_eq!(point.vector, expected, "{id}");
            let kind = |key: &str| point.payload[key].kind.clone().expect("a value");
            for (key, value) in [("x", mean.x), ("y", mean.y), ("z", mean.z)] {
                assert_eq!(kind(key), Kind::DoubleValue(value), "{id}: {key}");
            }
            assert_eq!(kind("cell_id"), Kind::IntegerValue(i64::from(*cell_id)));
            assert_eq!(kind("generation"), Kind::IntegerValue(generation));
            assert_eq!(kind("scene"), Kind::StringValue("yard".into()));
            let Kind::StructValue(location) = kind("location") else { panic!("{id}: no location") };
            let degrees = |key: &str| location.fields[key].as_double().expect("a number");
            let place =
                Geographic { latitude_deg: degrees("lat"), longitude_deg: degrees("lon"), height_m: 158.5 };
            let back = reference.world_from_geographic(place);
            assert!((back - *mean).truncate().length() < 1e-2, "{id}: {back} {mean}");
        }
    }
}

fn options(url: &str) -> PushOptions {
    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        options: PushOptions,
    }
    let line = ["push", "--collection", "yard", "--url", url];
    let mut options = Line::parse_from(line).options;
    options.n_points_per_batch = NonZeroUsize::new(BATCH).expect("not zero");
    options.retry_delay = Duration::from_millis(1);
    options
}

async fn started() -> (Fixture, Server, String) {
    let (server, url) = Server::start(None).await;
    (fixture(), server, url)
}

#[tokio::test]
async fn every_point_arrives() {
    let fixture = fixture();
    let (server, url) = Server::start(Some("k3y")).await;
    let options = PushOptions { api_key: Some("k3y".into()), ..options(&url) };
    let (report, seen) = fixture.push_until(&options, std::future::pending()).await.expect("pushes");
    let expected = PushReport {
        n_points: N_POINTS,
        n_sent: N_POINTS,
        n_without_evidence: 17,
        n_retries: 0,
        n_collections: 1,
        n_created_collections: 1,
        ..PushReport::default()
    };
    assert_eq!(report, expected);
    assert_eq!(seen.len(), N_BATCHES);
    assert_eq!(seen.last(), Some(&PushProgress { n_points: N_POINTS, n_points_expected: N_POINTS }));
    fixture.assert_arrived(&server, 1);
    let found = server.with(|state| state.collections["yard"].indexed.clone());
    assert_eq!(found, ["scene", "store", "generation", "location"]);
}

/// The client itself repeats once, so it takes three failures in a row to need our repetition.
#[tokio::test]
async fn batches_that_fail_are_repeated() {
    let fixture = fixture();
    // First ids of all batches, as a push without failures sends them.
    let (undisturbed, url) = Server::start(None).await;
    fixture.push(&options(&url)).await.expect("pushes");
    let ids = undisturbed.with(|state| state.acknowledged.clone());
    assert_eq!(ids.len(), N_BATCHES);
    let (server, url) = Server::start(None).await;
    // Every third batch; every sixth is applied and only its acknowledgement lost.
    let failures = ids.iter().step_by(3).enumerate().map(|(i, id)| (*id, (3, i % 2 == 1))).collect();
    server.with(|state| state.failures = failures);
    let report = fixture.push(&options(&url)).await.expect("pushes");
    assert_eq!((report.n_points, report.n_sent), (N_POINTS, N_POINTS));
    assert_eq!(server.with(|state| state.n_failed), 3 * 5);
    // Attempts 1 and 2 fail in one call, 3 in the next, where the client's repetition succeeds.
    assert_eq!(report.n_retries, 5);
    assert_eq!(server.with(|state| state.acknowledged.clone()), ids);
    fixture.assert_arrived(&server, 1);

    let (server, url) = Server::start(None).await;
    server.with(|state| state.failures = [(ids[4], (u32::MAX, false))].into());
    let refused = fixture.push(&PushOptions { n_retries: 2, ..options(&url) }).await.expect_err("gives up");
    assert!(matches!(refused, PushError::Database { action: "upsert points", .. }), "{refused}");
    assert_eq!(server.with(|state| state.n_failed), 2 * 3);
    server.with(|state| state.failures.clear());
    let report = fixture.push(&options(&url)).await.expect("continues");
    assert_eq!(report.n_sent, N_POINTS - 4 * BATCH as u64);
    fixture.assert_arrived(&server, 1);
}

#[tokio::test]
async fn a_push_that_is_cut_off_continues() {
    // Stopped after the server's acknowledgement, before it is recorded; everywhere in turn.
    for stop_after in [1, 5, 7, 8, 12, N_BATCHES] {
        let fixture = fixture();
        let (server, url) = Server::start(None).await;
        let ended = fixture.push_cut_off(&server, &options(&url), stop_after).await;
        assert!(matches!(ended, Err(PushError::Cancelled)), "{stop_after}: {ended:?}");
        let before = server.with(|state| state.acknowledged.clone());
        assert!(before.len() >= stop_after && before.len() <= stop_after + 1, "{stop_after}: {before:?}");

        let report = fixture.push(&options(&url)).await.expect("continues");
        assert_eq!(report.n_created_collections, 0);
        assert_eq!((report.n_points, report.n_without_evidence), (N_POINTS, 17), "{stop_after}");
        let all = server.with(|state| state.acknowledged.clone());
        // Only a batch that was acknowledged but not recorded may come twice.
        let distinct: BTreeSet<u64> = all.iter().copied().collect();
        assert_eq!(distinct.len(), N_BATCHES, "{stop_after}");
        assert!(all.len() <= N_BATCHES + 1, "{stop_after}: {} batches were sent", all.len());
        fixture.assert_arrived(&server, 1);

        let again = fixture.push(&options(&url)).await.expect("nothing to do");
        assert_eq!((again.n_points, again.n_sent), (N_POINTS, 0));
    }
}

/// A push may be cut off between collection and indexes; the next one makes those.
#[tokio::test]
async fn missing_payload_indexes_are_made_by_the_next_push() {
    let fixture = fixture();
    for n_before in 0..4 {
        let (server, url) = Server::start(None).await;
        server.with(|state| state.n_indexes_refused = 1);
        let refused = fixture.push(&options(&url)).await.expect_err("no index");
        assert!(matches!(refused, PushError::Database { action: "index a payload field", .. }), "{refused}");
        let made = ["scene", "store", "generation", "location"][..n_before].iter().map(ToString::to_string);
        server.with(|state| state.collections.get_mut("yard").expect("created").indexed = made.collect());
        let report = fixture.push(&options(&url)).await.expect("continues");
        assert_eq!((report.n_points, report.n_created_collections), (N_POINTS, 0));
        let indexed = server.with(|state| state.collections["yard"].indexed.clone());
        assert_eq!(indexed, ["scene", "store", "generation", "location"], "{n_before} were there");
    }
}

#[tokio::test]
async fn a_new_generation_starts_over_and_replaces() {
    let (mut fixture, server, url) = started().await;
    fixture.push(&options(&url)).await.expect("pushes");
    fixture.publish(2, 30);
    let report = fixture.push(&options(&url)).await.expect("pushes");
    assert_eq!((report.n_sent, report.n_created_collections), (N_POINTS, 0));
    fixture.assert_arrived(&server, 2);

    // A deleted collection is filled again, whatever the record says.
    server.with(|state| *state = server::State::default());
    let report = fixture.push(&options(&url)).await.expect("pushes");
    assert_eq!((report.n_sent, report.n_created_collections), (N_POINTS, 1));
    // Lost points are noticed and restored by the next push.
    server.with(|state| state.collections.get_mut("yard").expect("created").points.pop_first());
    let lost = fixture.push(&options(&url)).await.expect_err("a point is missing");
    assert!(matches!(lost, PushError::Count { expected: N_POINTS, found: 94, .. }), "{lost}");
    fixture.push(&options(&url)).await.expect("starts over");
    fixture.assert_arrived(&server, 2);
}

#[tokio::test]
async fn collections_that_do_not_fit_are_refused() {
    let (fixture, server, url) = started().await;
    for (dim, distance) in [(DIM as u64 + 1, Distance::Cosine), (DIM as u64, Distance::Dot)] {
        let params = VectorParamsBuilder::new(dim, distance).build();
        server.with(|state| state.collections.insert("yard".into(), server::Held::new(params)));
        let refused = fixture.push(&options(&url)).await.expect_err("does not fit").to_string();
        let expected = format!(
            "collection \"yard\" has vectors of {dim} components, distance {}, this scene needs vectors of 16 components, distance Cosine; choose another collection, or delete this one",
            distance.as_str_name()
        );
        assert_eq!(refused, expected);
    }
    for scene in ["attic", "yard"] {
        server.with(|state| state.collections.insert("yard".into(), cells::held_of(scene)));
        let refused = fixture.push(&options(&url)).await.expect_err("another store");
        assert!(matches!(refused, PushError::OtherStore { n_points: 1, .. }), "{refused}");
    }
    let found = server.with(|state| (state.collections["yard"].points.len(), state.acknowledged.len()));
    assert_eq!(found, (1, 0), "untouched");
}

#[tokio::test]
async fn errors_that_do_not_pass_are_not_repeated_and_hide_the_key() {
    let fixture = fixture();
    let (_server, url) = Server::start(Some("right")).await;
    let wrong = PushOptions { api_key: Some("wr0ng".into()), ..options(&url) };
    let refused = fixture.push(&wrong).await.expect_err("not admitted").to_string();
    assert!(refused.contains("wrong or missing key") && !refused.contains("wr0ng"), "{refused}");

    // Nothing listens: repeated, then given up.
    let unreachable = PushOptions { n_retries: 2, ..options("http://127.0.0.1:1") };
    let refused = fixture.push(&unreachable).await.expect_err("nobody there").to_string();
    assert!(refused.contains("Failed to connect") && refused.contains("6333 is REST's"), "{refused}");
    assert!(refused.len() < 300 && !refused.contains("MetadataMap"), "{refused}");
    // A server that was never reached is not waited for, however many attempts are left.
    let patient = PushOptions { n_retries: 1000, connect_patience: Duration::from_millis(50), ..unreachable };
    let begun = std::time::Instant::now();
    let refused = fixture.push(&patient).await.expect_err("nobody there").to_string();
    assert!(refused.contains("Failed to connect") && begun.elapsed() < Duration::from_secs(20), "{refused}");
    let begun = std::time::Instant::now();
    for wrong in
        ["no address", "127.0.0.1:6334", "http://", "http://host:port", "grpc://host:6334", "http://a b"]
    {
        assert_error(fixture.push(&options(wrong)).await, &[wrong, "http://HOST:6334"]);
    }
    assert!(begun.elapsed() < Duration::from_secs(10), "without a second attempt");
}
