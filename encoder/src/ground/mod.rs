//! The ground, and what stands on it: from above, a car and its park may share a colour, but not a height.
//!
//! Separating things from terrain by height follows laser scanning (Zhang et al., "A Progressive Morphological
//! Filter", IEEE TGRS 41(4), 2003).

mod height;
mod standing;
pub(crate) mod up;

pub(crate) use standing::{Footprint, NO_THING, Standing, reserve};
