//! Scales and ticks.

/// Scale of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Equal factors have equal lengths.
    Logarithmic,
    /// Equal differences have equal lengths.
    Linear,
}

/// An axis between two values and two places on the page.
pub(super) struct Axis {
    scale: Scale,
    low: f64,
    high: f64,
    /// Where the axis begins on the page, pixels.
    pub(super) from: f64,
    /// Where it ends.
    pub(super) to: f64,
}

impl Axis {
    pub(super) fn of(values: impl Iterator<Item = f64>, from: f64, to: f64, scale: Scale) -> Self {
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        let (low, high) = if low > high { (1.0, 10.0) } else { (low, high) };
        let (low, high) = match scale {
            Scale::Logarithmic => (low / 1.15, high * 1.15),
            Scale::Linear => {
                let margin = (0.08 * (high - low)).max(0.01 * high.abs());
                (low - margin, high + margin)
            }
        };
        Self { scale, low, high, from, to }
    }

    pub(super) fn at(&self, value: f64) -> f64 {
        let share = match self.scale {
            Scale::Logarithmic => (value / self.low).ln() / (self.high / self.low).ln(),
            Scale::Linear => (value - self.low) / (self.high - self.low),
        };
        self.from + (self.to - self.from) * share
    }

    /// Returns 1, 2 and 5 times powers of ten; on a linear axis, four to ten multiples of one of these.
    pub(super) fn ticks(&self) -> Vec<f64> {
        let round = || {
            let factors = |e: i32| [1.0, 2.0, 5.0].map(|m| format!("{m}e{e}").parse::<f64>().unwrap_or(1.0));
            (-9..9).flat_map(factors)
        };
        let inside = |v: &f64| (self.low..=self.high).contains(v);
        match self.scale {
            Scale::Logarithmic => round().filter(inside).collect(),
            Scale::Linear => {
                let step = round().find(|step| (self.high - self.low) / step <= 10.0).unwrap_or(1.0);
                let multiples = (self.low / step).ceil() as i64..=(self.high / step).floor() as i64;
                // Removes digits beyond the step's, which come from rounding the product.
                let digits = (-step.log10().floor()).max(0.0) as usize;
                multiples.map(|n| format!("{:.digits$}", n as f64 * step).parse().unwrap_or(0.0)).collect()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let of = |values: [f64; 2], scale| Axis::of(values.into_iter(), 0.0, 1.0, scale).ticks();
        assert_eq!(of([0.9, 60.0], Scale::Logarithmic), [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]);
        assert_eq!(of([0.163, 0.219], Scale::Linear), [0.16, 0.17, 0.18, 0.19, 0.2, 0.21, 0.22]);
        let axis = Axis::of([2.0, 4.0].into_iter(), 100.0, 0.0, Scale::Linear);
        assert!((axis.at(3.0) - 50.0).abs() < 1e-9 && axis.at(4.0) < axis.at(2.0));
        // A single value gives an axis too.
        assert!(Axis::of([0.5].into_iter(), 0.0, 1.0, Scale::Linear).at(0.5).is_finite());
    }
}
