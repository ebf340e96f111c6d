use super::*;
use crate::random::mix64;

fn random(n: usize, seed: u64) -> Vec<f32> {
    (0..n as u64).map(|i| (mix64(seed << 32 | i) >> 40) as f32 / (1u64 << 23) as f32 - 1.0).collect()
}

/// Oracle: the same sums in float64; the first column of the largest.
#[test]
fn products_and_largest_columns() {
    for (n, k, width) in [(1, 1, 1), (7, 5, 33), (300, 96, 70), (9, 130, 512)] {
        let (a, b) = (random(n * k, 1), random(k * width, 2));
        let offsets = random(width, 3);
        let panels = Panels::new(k, width, |i, j| b[i * width + j]);
        let product = panels.product(Rows::all(&a, k));
        let largest = panels.largest(Rows::all(&a, k), &offsets);
        for i in 0..n {
            let exact: Vec<f64> = (0..width)
                .map(|j| (0..k).map(|l| f64::from(a[i * k + l]) * f64::from(b[l * width + j])).sum())
                .collect();
            for (found, exact) in product[i * width..][..width].iter().zip(&exact) {
                assert!((f64::from(*found) - exact).abs() < 1e-4);
            }
            let value = |j: usize| exact[j] - f64::from(offsets[j]);
            let best = (0..width).map(value).fold(f64::MIN, f64::max);
            assert!(value(largest[i] as usize) > best - 1e-4);
        }
        let ones = Panels::new(k, width, |_, _| 1.0);
        assert!(ones.largest(Rows::all(&a, k), &vec![0.0; width]).iter().all(|column| *column == 0));
    }
}

/// Whatever the vector width, the bits are those of scalar code.
#[test]
fn every_width_of_vectors_gives_the_same_bits() {
    let (a, b) = (random(30 * 65, 1), random(65 * 77, 2));
    let right = &Panels::new(65, 77, |i, j| b[i * 77 + j]);
    let (left, offsets) = (Rows::all(&a, 65), [[0.25; PANEL]; 3]);
    let results: Vec<(Vec<f32>, Vec<u32>)> = InstructionSet::available()
        .iter()
        .map(|set| {
            let (mut out, mut columns) = (vec![0.0; 30 * 77], vec![0; 30]);
            set.dispatch(Product { left, right, first: 0, out: &mut out });
            set.dispatch(Largest { left, right, offsets: &offsets, first: 0, out: &mut columns });
            (out, columns)
        })
        .collect();
    assert!(results.iter().all(|result| *result == results[0]));
}
