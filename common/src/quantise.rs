//! Rounding of vectors to 8-bit components.

/// Rounds values to 8 bits; returns them with their common step.
pub fn quantise(values: &[f32]) -> (Vec<i8>, f32) {
    let largest = values.iter().fold(0.0f32, |most, v| most.max(v.abs()));
    let step = largest / 127.0;
    let round = |v: &f32| if step > 0.0 { (v / step).round() as i8 } else { 0 };
    (values.iter().map(round).collect(), step)
}
