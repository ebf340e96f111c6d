//! Conversions of single values that several formats share.

/// Returns a quaternion scaled to unit length. The result is zero or NaN if the quaternion has no length or is not
/// finite; [`Gaussians::is_usable`](crate::Gaussians::is_usable) rejects both.
pub(super) fn unit_rotation(wxyz: [f64; 4]) -> [f32; 4] {
    let norm = wxyz.iter().map(|q| q * q).sum::<f64>().sqrt();
    if norm == 0.0 { [0.0; 4] } else { wxyz.map(|q| (q / norm) as f32) }
}

pub(super) fn sigmoid(logit: f64) -> f32 {
    (1.0 / (1.0 + (-logit).exp())) as f32
}

/// Returns the quaternion `wxyz` given all components but the one at index `largest`, in order; the missing one is
/// positive and follows from unit length.
pub(super) fn with_largest(largest: usize, others: [f64; 3]) -> [f64; 4] {
    let rest = (1.0 - others.iter().map(|q| q * q).sum::<f64>()).max(0.0).sqrt();
    let mut others = others.into_iter();
    std::array::from_fn(|i| if i == largest { rest } else { others.next().unwrap_or(0.0) })
}

/// Returns the coefficient of degree 0 for a colour in 0..=1: the inverse of
/// [`Gaussians::rgb_dc`](crate::Gaussians::rgb_dc).
pub(super) fn dc_of_colour(colour: f64) -> f32 {
    ((colour - 0.5) / f64::from(crate::gaussians::SH_C0)) as f32
}
