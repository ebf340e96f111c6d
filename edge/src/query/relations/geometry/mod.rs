//! Relations as plain geometry of upright boxes: a file for each family. Each relation gives a degree from 0 to 1;
//! at [`HOLDS`] and above it holds. `docs/api.md` has the definitions for users.

mod contact;
mod distance;
mod enclosed;
mod measure;
mod outline;
mod seen;
mod solid;

pub use distance::between;
pub use seen::Viewer;
pub use solid::Solid;

use super::phrase::Relation;

/// Least degree at which a relation holds.
pub const HOLDS: f64 = 0.5;

/// Returns the degree to which a thing is so placed to another; `between` is 0 here, see [`between`].
pub fn degree(is: Relation, thing: &Solid, of: &Solid, viewer: Option<&Viewer>, metre: f64) -> f64 {
    match is {
        Relation::On => contact::on(thing, of, metre),
        Relation::Under => contact::under(thing, of, metre),
        Relation::Above => contact::under(of, thing, metre),
        Relation::In => enclosed::inside(thing, of, metre),
        Relation::Near => distance::near(thing, of, metre),
        Relation::Beside => distance::beside(thing, of, metre),
        Relation::Between => 0.0,
        Relation::LeftOf | Relation::RightOf | Relation::InFrontOf | Relation::Behind => {
            viewer.map_or(0.0, |viewer| seen::towards(is, thing, of, viewer, metre))
        }
    }
}

#[cfg(test)]
mod tests;
