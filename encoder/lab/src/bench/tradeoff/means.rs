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
    /// Multi-class mIoU.
    pub(super) miou: f64,
    /// Its standard deviation over scenes; 0 for one scene.
    pub(super) miou_spread: f64,
}

/// Returns the mean of each point that all of these scenes have, in the order of the first scene.
pub(super) fn means<'a>(
    figures: &'a [Figures],
    scenes: &[&str],
    cost: impl Fn(&Figures) -> Option<f64>,
) -> Vec<Mean<'a>> {
    let first = figures.iter().filter(|f| Some(f.scene.as_str()) == scenes.first().copied());
    first
        .filter_map(|of_first| {
            let point = &of_first.point;
            let of_point: Vec<&Figures> =
                figures.iter().filter(|f| f.point == *point && scenes.contains(&f.scene.as_str())).collect();
            let costs: Vec<f64> = of_point.iter().filter_map(|f| cost(f)).collect();
            let n = scenes.len();
            if costs.len() != n {
                return None;
            }
            let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / n as f64;
            let miou = mean(&mut of_point.iter().map(|f| f.miou));
            let squares = of_point.iter().map(|f| (f.miou - miou).powi(2)).sum::<f64>();
            // Of a sample: divided by one less than their number.
            let miou_spread = (squares / (n.max(2) - 1) as f64).sqrt();
            Some(Mean { point, n_scenes: n, cost: mean(&mut costs.into_iter()), miou, miou_spread })
        })
        .collect()
}
