//! Mean and spread of each point over the scenes.

use super::figures::Figures;
use super::grid::Point;

/// A point's figures, averaged over scenes.
#[derive(Clone, Debug)]
pub(super) struct Mean<'a> {
    pub(super) point: &'a Point,
    /// Number of scenes.
    pub(super) n_scenes: usize,
    /// Cost.
    pub(super) cost: f64,
    /// Accuracy.
    pub(super) accuracy: f64,
    /// Its standard deviation over scenes; 0 for one scene.
    pub(super) spread: f64,
}

/// Returns the mean of each point that all of these scenes have, in the order of the first scene.
pub(super) fn means<'a>(
    figures: &'a [Figures],
    scenes: &[&str],
    cost: impl Fn(&Figures) -> Option<f64>,
    accuracy: impl Fn(&Figures) -> Option<f64>,
) -> Vec<Mean<'a>> {
    let first = figures.iter().filter(|f| Some(f.scene.as_str()) == scenes.first().copied());
    first
        .filter_map(|of_first| {
            let point = &of_first.point;
            let of_point: Vec<&Figures> =
                figures.iter().filter(|f| f.point == *point && scenes.contains(&f.scene.as_str())).collect();
            let costs: Vec<f64> = of_point.iter().filter_map(|f| cost(f)).collect();
            let accuracies: Vec<f64> = of_point.iter().filter_map(|f| accuracy(f)).collect();
            let n = scenes.len();
            if costs.len() != n || accuracies.len() != n {
                return None;
            }
            let mean = |values: &[f64]| values.iter().sum::<f64>() / n as f64;
            let accuracy = mean(&accuracies);
            let squares = accuracies.iter().map(|a| (a - accuracy).powi(2)).sum::<f64>();
            // Of a sample: divided by one less than their number.
            let spread = (squares / (n.max(2) - 1) as f64).sqrt();
            Some(Mean { point, n_scenes: n, cost: mean(&costs), accuracy, spread })
        })
        .collect()
}
