//! Roots of polynomials.

/// Returns the ascending points of `low..high` at which a polynomial (coefficients from the constant term up)
/// changes sign; there is at most one between two roots of its derivative.
pub fn roots_between(coefficients: &[f64], low: f64, high: f64) -> Vec<f64> {
    if coefficients.len() < 2 {
        return Vec::new();
    }
    let value = |x: f64| coefficients.iter().rev().fold(0.0, |sum, c| sum * x + c);
    let derivative: Vec<f64> =
        coefficients.iter().enumerate().skip(1).map(|(power, c)| power as f64 * c).collect();
    let mut turns = vec![low];
    turns.extend(roots_between(&derivative, low, high));
    turns.push(high);
    let mut roots = Vec::new();
    for pair in turns.windows(2) {
        let (mut a, mut b) = (pair[0], pair[1]);
        if (value(a) > 0.0) == (value(b) > 0.0) {
            continue;
        }
        let positive_at_a = value(a) > 0.0;
        // 100 halvings exhaust the 53 bits of the mantissa for any interval used here.
        for _ in 0..100 {
            let middle = 0.5 * (a + b);
            if (value(middle) > 0.0) == positive_at_a { a = middle } else { b = middle }
        }
        roots.push(a);
    }
    roots
}
