//! The reply to `/v1/changes`.

use serde::Deserialize;

/// What changed between two generations. Members that clients here do not need are left out.
#[derive(Clone, Debug, Deserialize)]
pub struct Changes {
    pub scene: String,
    /// `m`, or `world` for scenes whose scale is unknown.
    pub unit: String,
    /// The earlier generation; absent if the robot remembers none.
    pub from: Option<Compared>,
    /// The later one.
    pub to: Compared,
    /// Things of exactly the same Gaussians.
    pub n_same: u64,
    /// Things at the same place whose Gaussians changed.
    pub n_stayed: u64,
    /// Things whose place only one of the generations knows.
    pub n_not_compared: u64,
    /// New things.
    pub appeared: Vec<Changed>,
    /// Things that are gone.
    pub went: Vec<Changed>,
    /// Things that lie elsewhere.
    pub moved: Vec<Moved>,
    /// Why nothing was compared.
    pub none: Option<Miss>,
}

#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Compared {
    pub generation: u64,
    /// When it was made, Unix seconds.
    pub created_unix_secs: u64,
}

/// A thing as it is or was.
#[derive(Clone, Debug, Deserialize)]
pub struct Changed {
    pub id: String,
    /// Its middle.
    pub position_in_world: [f64; 3],
    pub box_min_in_world: [f64; 3],
    /// Greatest corner.
    pub box_max_in_world: [f64; 3],
    /// The text that it is most like, if texts were given.
    pub like: Option<Like>,
}

/// The text that a thing is most like.
#[derive(Clone, Debug, Deserialize)]
pub struct Like {
    pub text: String,
    /// Their cosine.
    pub score: f32,
}

/// A thing that lies elsewhere.
#[derive(Clone, Debug, Deserialize)]
pub struct Moved {
    pub from: Changed,
    pub to: Changed,
    /// Between the positions.
    pub distance: f64,
}

/// Why nothing was compared.
#[derive(Clone, Debug, Deserialize)]
pub struct Miss {
    /// `no-earlier-generation`.
    pub kind: String,
    /// The same in a sentence.
    pub detail: String,
}
