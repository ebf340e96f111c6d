//! Relations between things: "mug on the table", "second pallet from the gate". Plain geometry over objects, or over
//! clusters where no object answers, without a language model; the same scene and phrase give the same answer.

mod candidates;
mod geometry;
mod grammar;
mod phrase;
mod rank;

pub use candidates::{CandidateOf, ClustersOfThing, Found, Things, metre};
pub use geometry::{HOLDS, Viewer};
pub use grammar::{normal, understand};
pub use phrase::{ASKER, By, MAX_NTH, MAX_THINGS, Phrase, Pick, Place, Relation, is_anything};
pub use rank::{Related, Witness, relate};
