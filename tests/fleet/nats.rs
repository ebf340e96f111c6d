//! Workers fed by a queue: a real nats-server with JetStream.

use super::*;

use super::support::*;
use slag_tests::*;

pub struct Server {
    running: Running,
    pub port: u16,
}

impl Server {
    fn start(scene: &Scene, port: u16) -> Self {
        let (at, folder) = (port.to_string(), scene.path("nats"));
        let args = ["--jetstream", "--addr", "127.0.0.1", "--port", &at, "--store_dir", text(&folder)];
        Self { running: start_server("nats-server", port, &args), port }
    }
}

fn url(port: u16) -> String {
    format!("nats://127.0.0.1:{port}")
}

pub struct Fleet {
    pub scene: Scene,
    bucket: String,
    port: u16,
}

impl Fleet {
    pub fn new(port: u16) -> (Self, Server) {
        let scene = Scene::new();
        let server = Server::start(&scene, port);
        let bucket = text(&scene.path("bucket")).to_owned();
        (Self { scene, bucket, port }, server)
    }

    fn coordinator_of(&self, store: &str, flags: &[&str]) -> Command {
        let mut command = self.scene.encode(store);
        command.args(["--blobs", &self.bucket, "--fleet", &url(self.port)]).args(flags);
        command
    }

    /// `flags` are for it and the workers alike.
    pub fn coordinator(&self, flags: &[&str]) -> Running {
        Running::start(&mut self.coordinator_of("store", flags))
    }

    pub fn worker(&self, flags: &[&str]) -> Running {
        Running::start(&mut self.worker_at(self.port, flags))
    }

    /// Starts a worker that reaches the server over a network.
    pub fn worker_over(&self, network: &Network, flags: &[&str]) -> Running {
        Running::start(&mut self.worker_at(network.port, flags))
    }

    fn worker_at(&self, port: u16, flags: &[&str]) -> Command {
        let mut command = worker(&self.bucket);
        command.args(["--fleet", &url(port), "--threads", "1"]).args(flags);
        command
    }

    /// Kills the server and restarts it, with its files or empty.
    pub fn restart(&self, server: Server, is_lost: bool) -> Server {
        let Server { running, port, .. } = server;
        running.kill();
        if is_lost {
            fs_err::remove_dir_all(self.scene.path("nats")).expect("removed");
        }
        Server::start(&self.scene, port)
    }

    fn n_views_done(&self) -> usize {
        n_objects(&self.scene.path("bucket/views"))
    }
}

#[test]
fn a_folder_and_a_queue_conform() {
    let (fleet, _server) = Fleet::new(free_port());
    let flags = ["--ack-wait", "1"];
    let coordinator = |store: &str| fleet.coordinator_of(store, &flags);
    conforms(&fleet.scene, coordinator, |_| fleet.worker_at(fleet.port, &flags), || fleet.n_views_done());
}

/// One worker is killed, one pauses longer than the queue waits; the server is killed half way and restarts empty.
#[nightly("starts servers, and fails parts of a fleet")]
fn killed_and_paused_workers_and_an_empty_server_give_the_same_bytes() {
    let (fleet, server) = Fleet::new(free_port());
    let flags = ["--ack-wait", "1"];
    let coordinator = fleet.coordinator(&flags);
    let killed = fleet.worker(&flags);
    wait_until("a first view", || fleet.n_views_done() > 0);
    killed.kill();
    let mut paused = fleet.worker(&flags);
    let n_done = fleet.n_views_done();
    wait_until("a view of the second", || fleet.n_views_done() > n_done);
    paused.signal("STOP");
    let _server = fleet.restart(server, true);
    assert!(fleet.n_views_done() < N_VIEWS, "the faults came too late");
    let third = fleet.worker(&flags);
    wait_until("all views", || fleet.n_views_done() == N_VIEWS);
    paused.signal("CONT");
    let summary = coordinator.json();
    assert_eq!((&summary["n_views"], &summary["skipped_views"]), (&N_VIEWS.into(), &serde_json::json!([])));
    for worker in [paused, third] {
        worker.json();
    }
    fleet.scene.assert_same("store");
}

/// Views that kill their worker are given up after too many deliveries and named; the encode uses the others.
/// Without the queue's limit the next encode does them.
#[nightly("starts servers, and fails parts of a fleet")]
fn views_that_end_workers_are_given_up_and_named() {
    let (fleet, _server) = Fleet::new(free_port());
    let flags = ["--ack-wait", "1", "--max-deliver", "1"];
    let coordinator = fleet.coordinator(&flags);
    let killed = fleet.worker(&flags);
    wait_until("a first view", || fleet.n_views_done() > 0);
    killed.kill();
    // Unfinished work that the queue still assigns to the worker.
    let survivor = fleet.worker(&flags);
    let output = coordinator.output();
    assert_eq!(output.status.code(), Some(3), "{}", String::from_utf8_lossy(&output.stderr));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let skipped = summary["skipped_views"].as_array().expect("a list");
    assert!(!skipped.is_empty() && skipped.len() < N_VIEWS, "{skipped:?}");
    assert!(skipped[0]["reason"].as_str().expect("text").contains("several times"), "{skipped:?}");
    survivor.json();
    let (again, helper) = (fleet.coordinator(&[]), fleet.worker(&[]));
    assert_eq!(again.json()["n_views"], N_VIEWS);
    assert_eq!(helper.json()["n_views"], skipped.len());
}

/// Work that takes longer than the queue waits is not delivered again, because its worker reports progress.
#[nightly("starts servers, and fails parts of a fleet")]
fn work_in_progress_is_not_handed_out_again() {
    let (fleet, _server) = Fleet::new(free_port());
    // Large rasters: a view takes longer than the queue waits.
    let width = ["--raster-width", "2600"];
    let wait = ["--ack-wait", "1", "--max-deliver", "1"];
    let coordinator = fleet.coordinator(&[&wait[..], &["--strict"], &width].concat());
    let worker = fleet.worker(&wait);
    assert_eq!(coordinator.json()["n_views"], N_VIEWS);
    assert_eq!(worker.json()["n_views"], N_VIEWS);
    // Also if a view that was given up is finished after all.
    assert_eq!(n_objects(&fleet.scene.path("bucket/jobs/00000001/failed")), 0);
    run(fleet.scene.encode("alone").args(width));
    let alone = fs_err::read(fleet.scene.path("alone/manifest")).expect("published");
    fleet.scene.assert_has("store", &alone);
}
