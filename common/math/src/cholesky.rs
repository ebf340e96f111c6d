//! The Cholesky factor of a symmetric matrix.

/// Treatment of pivots that are too small, from rounding or from rows that depend on earlier ones.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SmallPivots {
    /// The square of a pivot is raised to this value, above 0, so every pivot is positive.
    Raise(f64),
    /// A pivot and its column are 0 (a dependent row) unless its square exceeds this share of the diagonal element.
    Drop(f64),
}

/// Returns the lower triangle L with L L' = `matrix`, zeros above, row by row (Golub and Van Loan, Matrix
/// Computations, 4.2). Of the matrix `[n][n]` only the lower triangle is read.
pub fn cholesky(mut matrix: Vec<f64>, n: usize, small: SmallPivots) -> Vec<f64> {
    for i in 0..n {
        for j in 0..i {
            let (before, row) = matrix.split_at_mut(i * n);
            let pivot_row = &before[j * n..][..=j];
            let known: f64 = row[..j].iter().zip(pivot_row).map(|(a, b)| a * b).sum();
            row[j] = if pivot_row[j] > 0.0 { (row[j] - known) / pivot_row[j] } else { 0.0 };
        }
        let row = &mut matrix[i * n..][..n];
        let known: f64 = row[..i].iter().map(|v| v * v).sum();
        let rest = row[i] - known;
        row[i] = match small {
            SmallPivots::Raise(least) => rest.max(least).sqrt(),
            SmallPivots::Drop(share) if rest > share * row[i] => rest.sqrt(),
            SmallPivots::Drop(_) => 0.0,
        };
        row[i + 1..].fill(0.0);
    }
    matrix
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the factor computed by hand. Elements above the diagonal are not read.
    #[test]
    fn the_factor_is_the_lower_triangle() {
        let matrix = [4.0, f64::NAN, f64::NAN, 12.0, 37.0, f64::NAN, -16.0, -43.0, 98.0];
        let expected = [2.0, 0.0, 0.0, 6.0, 1.0, 0.0, -8.0, 5.0, 3.0];
        for small in [SmallPivots::Raise(0.25), SmallPivots::Drop(1e-9)] {
            assert_eq!(cholesky(matrix.to_vec(), 3, small), expected);
        }
        assert!(cholesky(Vec::new(), 0, SmallPivots::Drop(0.0)).is_empty());
    }

    /// By hand: the second of three rows is twice the first, so its pivot is 0.
    #[test]
    fn small_pivots_are_raised_or_dropped() {
        let matrix = vec![4.0, 0.0, 0.0, 8.0, 16.0, 0.0, 2.0, 5.0, 10.0];
        // 2; 4, 0; 1, -, sqrt(10 - 1).
        let dropped = cholesky(matrix.clone(), 3, SmallPivots::Drop(1e-9));
        assert_eq!(dropped, [2.0, 0.0, 0.0, 4.0, 0.0, 0.0, 1.0, 0.0, 3.0]);
        // 2; 4, sqrt(0.25); 1, (5 - 4) / 0.5, sqrt(10 - 1 - 4).
        let raised = cholesky(matrix, 3, SmallPivots::Raise(0.25));
        assert_eq!(raised, [2.0, 0.0, 0.0, 4.0, 0.5, 0.0, 1.0, 2.0, 5.0f64.sqrt()]);
    }

    #[test]
    fn the_share_itself_is_dropped() {
        let pivot = |share| cholesky(vec![1.0, 0.0, 1.0, 2.0], 2, SmallPivots::Drop(share))[3];
        assert_eq!([pivot(0.5), pivot(0.49)], [0.0, 1.0]);
    }
}
