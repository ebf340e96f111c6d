//! A generated room that is encoded, served, and fetched to a robot's storage.

use std::path::{Path, PathBuf};

use crate::{Service, edge, encode_room, encoder, lab, run, text};

/// A service with a generated room whose things are known by their colours, and a robot's storage that holds it.
pub struct Site {
    /// The service that robots fetch from.
    pub store: Service,
    dir: tempfile::TempDir,
}

impl Site {
    /// Generates, encodes, serves and fetches the room.
    pub fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let store = dir.path().join("store");
        encode(&dir.path().join("room"), &store, 1);
        let store = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
        let site = Self { store, dir };
        let at = ["fetch", "--trust-first", "--from", &site.store.url, "--at", "3.5,2.7,0"];
        run(edge(&at).args(["--cache", text(&site.cache())]));
        site
    }

    /// Replaces the room by one with other things, and fetches this second generation.
    pub fn publish_another(&self) {
        encode(&self.dir.path().join("other-room"), &self.dir.path().join("store"), 2);
        run(edge(&["fetch"]).args(["--cache", text(&self.cache())]));
    }

    /// Returns the robot's storage.
    pub fn cache(&self) -> PathBuf {
        self.dir.path().join("cache")
    }

    /// Starts the robot.
    pub fn robot(&self, args: &[&str]) -> Service {
        Service::start(edge(&["serve", "--models", "colours", "--cache", text(&self.cache())]).args(args))
    }
}

impl Default for Site {
    fn default() -> Self {
        Self::new()
    }
}

/// Generates a room and encodes it into a store.
fn encode(room: &Path, store: &Path, seed: u32) {
    let seed = seed.to_string();
    run(&mut lab(&["generate", "scene", "--out", text(room), "--n-views", "12", "--seed", &seed]));
    run(encode_room(room, store).args(["--models", "colours", "--occupancy", "0.1", "--name", "room"]));
}
