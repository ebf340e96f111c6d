//! The ground, and what stands on it: in photos from above a car and its park have one colour, but not one height.
//!
//! Separating things from terrain by height follows laser scanning (Zhang et al., "A Progressive Morphological
//! Filter", IEEE TGRS 41(4), 2003).

mod height;
mod standing;
pub(crate) mod up;

pub(crate) use standing::{Footprint, NO_THING, Standing, reserve, up_by};
