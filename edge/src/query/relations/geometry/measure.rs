//! How lengths and shares become degrees.

/// What lengths are measured by.
#[derive(Clone, Copy, Debug)]
pub struct Scale {
    /// A metre in world units; in a scene that is not metric, what stands for one.
    pub metre: f64,
}

/// Returns 1 below `full`, 0 above `none`, and a straight line between them.
pub fn falling(value: f64, full: f64, none: f64) -> f64 {
    ((none - value) / (none - full)).clamp(0.0, 1.0)
}
