//! Conversions of single values that several formats share.

/// Scales a quaternion to unit length; the result is zero or NaN where that is impossible, which
/// [`Gaussians::is_usable`](crate::Gaussians::is_usable) rejects.
pub(super) fn unit_rotation(wxyz: [f64; 4]) -> [f32; 4] {
    let norm = wxyz.iter().map(|q| q * q).sum::<f64>().sqrt();
    if norm == 0.0 { [0.0; 4] } else { wxyz.map(|q| (q / norm) as f32) }
}

pub(super) fn sigmoid(logit: f64) -> f32 {
    (1.0 / (1.0 + (-logit).exp())) as f32
}

/// Inserts the missing component of a unit quaternion `wxyz`, positive, at index `largest`; `others` are in order.
pub(super) fn with_largest(largest: usize, others: [f64; 3]) -> [f64; 4] {
    let rest = (1.0 - others.iter().map(|q| q * q).sum::<f64>()).max(0.0).sqrt();
    let mut others = others.into_iter();
    std::array::from_fn(|i| if i == largest { rest } else { others.next().unwrap_or(0.0) })
}

/// Inverse of [`Gaussians::rgb_dc`](crate::Gaussians::rgb_dc), for a colour in 0..=1.
pub(super) fn dc_of_colour(colour: f64) -> f32 {
    ((colour - 0.5) / f64::from(crate::gaussians::SH_C0)) as f32
}
