//! How lengths and shares become degrees.

/// Returns 1 below `full`, 0 above `none`, and a straight line between them.
pub fn falling(value: f64, full: f64, none: f64) -> f64 {
    ((none - value) / (none - full)).clamp(0.0, 1.0)
}
