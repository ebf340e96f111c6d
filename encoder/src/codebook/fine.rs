//! Fine residuals: 8 bits a component.

use slag_common::shard::ScoreErrors;

pub struct FineResiduals {
    /// `[m]`.
    pub steps: Vec<f32>,
    /// `[K]`.
    pub scales: Vec<f32>,
    /// `[n][m]`.
    pub values: Vec<i8>,
    pub errors: ScoreErrors,
}

/// Rounds residuals (`[n][m]`, divided by their centroids' scales) to 8 bits; returns them and their decoded form in
/// readers' components. Steps follow the components' sizes, scales the largest of a centroid's members.
pub(super) fn round(
    residuals: &[f32],
    m: usize,
    centroid_starts: &[u32],
    residual_scales: &[f32],
    ranges: &[f32],
) -> (FineResiduals, Vec<f32>) {
    const MOST: f32 = 127.0;
    let of_centroid =
        |centroid: usize| centroid_starts[centroid] as usize * m..centroid_starts[centroid + 1] as usize * m;
    let mut squares = vec![0.0f64; m];
    for (centroid, scale) in residual_scales.iter().enumerate() {
        for (at, v) in residuals[of_centroid(centroid)].iter().enumerate() {
            squares[at % m] += f64::from(v * scale).powi(2);
        }
    }
    let n = (residuals.len() / m).max(1) as f64;
    // At least 1e-9, against division by zero where a component has no residuals.
    let sizes: Vec<f32> = squares.iter().map(|s| ((s / n).sqrt() as f32).max(1e-9)).collect();
    let steps: Vec<f32> = sizes.iter().zip(ranges).map(|(size, range)| size / range).collect();
    let (mut scales, mut values) =
        (Vec::with_capacity(residual_scales.len()), Vec::with_capacity(residuals.len()));
    let mut decoded = Vec::with_capacity(residuals.len());
    for (centroid, residual_scale) in residual_scales.iter().enumerate() {
        let in_sizes = |(at, v): (usize, &f32)| v * residual_scale / sizes[at % m];
        let members = || residuals[of_centroid(centroid)].iter().enumerate();
        let scale = members().map(in_sizes).fold(0.0f32, |most, v| most.max(v.abs())) / MOST;
        let factor = if scale > 0.0 { scale.recip() } else { 0.0 };
        for (at, v) in members() {
            let value = (in_sizes((at, v)) * factor).round().clamp(-MOST, MOST);
            values.push(value as i8);
            decoded.push(value * steps[at % m] * scale);
        }
        scales.push(scale);
    }
    (FineResiduals { steps, scales, values, errors: ScoreErrors::default() }, decoded)
}
