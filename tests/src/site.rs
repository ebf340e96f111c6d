//! A generated room: encoded, served, and fetched to a robot's storage.

use std::path::PathBuf;

use crate::{Service, edge, encode_room, encoded_into, encoder, generated, run, text};

/// The room that most tests share.
pub const ROOM: [&str; 2] = ["--n-views", "8"];

/// Flags of the encode of a [`Site`].
pub const SITE: [&str; 6] = ["--models", "colours", "--occupancy", "0.1", "--name", "room"];

/// A service with a generated room whose objects are known by colour, and a robot's storage with it.
pub struct Site {
    /// The service that robots fetch from.
    pub store: Service,
    dir: tempfile::TempDir,
}

impl Site {
    pub fn new() -> Self {
        Self::of(&ROOM, &SITE)
    }

    /// Serves and fetches a generated room. `scene`: flags of `slag-lab generate scene`; `flags`: of the encode.
    pub fn of(scene: &[&str], flags: &[&str]) -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let store = dir.path().join("store");
        encoded_into(&store, scene, flags);
        let store = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
        let site = Self { store, dir };
        let at = ["fetch", "--trust-first", "--from", &site.store.url, "--at", "3.5,2.7,0", "--cache"];
        run(edge(&at).arg(site.cache()));
        site
    }

    /// Publishes a room with other objects, and fetches this second generation.
    pub fn publish_another(&self) {
        let other = generated(&["--n-views", "12", "--seed", "2"]);
        run(encode_room(&other, &self.dir.path().join("store")).args(SITE));
        run(edge(&["fetch", "--cache"]).arg(self.cache()));
    }

    pub fn cache(&self) -> PathBuf {
        self.dir.path().join("cache")
    }

    pub fn robot(&self, args: &[&str]) -> Service {
        Service::start(edge(&["serve", "--models", "colours", "--cache", text(&self.cache())]).args(args))
    }
}

impl Default for Site {
    fn default() -> Self {
        Self::new()
    }
}
