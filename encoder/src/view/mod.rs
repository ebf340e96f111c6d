//! What the page at `/view` draws: a published store, a splat, or both.
//!
//! With the splat, Gaussians are in the order of the published fields and scored in full precision; without it, in the
//! order of the smallest shards with their centroids' scores, as on a robot. A splat alone can be drawn, not asked.

mod answers;
mod error;
mod generation;
mod routes;
mod shards;
mod splat;
mod viewer;

pub(crate) use answers::{Found, Things};
pub(crate) use routes::router;
pub(crate) use splat::Splat;
pub(crate) use viewer::{OpenText, Viewed, Viewer, up_of};
