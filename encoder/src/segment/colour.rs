//! Colours in CIE L*a*b*, where distances are about proportional to perceived differences.

use image::RgbImage;

pub(super) fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let [l, m, n] = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    (l * l + m * m + n * n).sqrt()
}

/// Converts sRGB (IEC 61966-2-1) to CIE L*a*b* of illuminant D65 (CIE 15).
pub(super) fn lab_of(image: &RgbImage) -> Vec<[f32; 3]> {
    let linear: Vec<f32> = (0..=255_u8)
        .map(|value| {
            let v = f32::from(value) / 255.0;
            if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
        })
        .collect();
    let root = |t: f32| if t > 216.0 / 24389.0 { t.cbrt() } else { (24389.0 / 27.0 * t + 16.0) / 116.0 };
    let lab = |pixel: &image::Rgb<u8>| {
        let [r, g, b] = pixel.0.map(|value| linear[usize::from(value)]);
        let x = root((0.4124564 * r + 0.3575761 * g + 0.1804375 * b) / 0.95047);
        let y = root(0.2126729 * r + 0.7151522 * g + 0.072175 * b);
        let z = root((0.0193339 * r + 0.119192 * g + 0.9503041 * b) / 1.08883);
        [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
    };
    image.pixels().map(lab).collect()
}

/// Gaussian truncated at four standard deviations; border pixels are repeated outwards.
pub(super) fn smooth(lab: &mut [[f32; 3]], width: usize, sigma_px: f32) {
    let radius = (4.0 * sigma_px).ceil().clamp(0.0, 64.0) as usize;
    if radius == 0 || width == 0 {
        return;
    }
    let mut kernel: Vec<f32> =
        (0..=2 * radius).map(|i| (-0.5 * ((i as f32 - radius as f32) / sigma_px).powi(2)).exp()).collect();
    let sum: f32 = kernel.iter().sum();
    kernel.iter_mut().for_each(|weight| *weight /= sum);

    // Along rows, then along columns; sums run over whole rows, so that no pixel is handled alone.
    let height = lab.len() / width;
    let add = |sums: &mut [[f32; 3]], weight: f32, colours: &[[f32; 3]]| {
        let (sums, colours) = (sums.as_flattened_mut().iter_mut(), colours.as_flattened());
        sums.zip(colours).for_each(|(sum, colour)| *sum += weight * colour);
    };
    let mut padded = Vec::new();
    for row in lab.chunks_exact_mut(width) {
        padded.clear();
        padded.extend((0..width + 2 * radius).map(|i| row[i.saturating_sub(radius).min(width - 1)]));
        row.fill([0.0; 3]);
        kernel.iter().zip(padded.windows(width)).for_each(|(weight, shifted)| add(row, *weight, shifted));
    }
    let rows = lab.to_vec();
    for (y, row) in lab.chunks_exact_mut(width).enumerate() {
        row.fill([0.0; 3]);
        for (i, weight) in kernel.iter().enumerate() {
            let from = (y + i).saturating_sub(radius).min(height - 1) * width;
            add(row, *weight, &rows[from..from + width]);
        }
    }
}
