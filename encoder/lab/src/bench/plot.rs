//! A line plot as SVG with a logarithmic horizontal axis.
//!
//! Not the crate `plotters`: ticks and scales are 60 lines here; its axes are of another type for each scale, and the
//! legend beside the plot and the labels of points would still be ours.

use std::fmt::Write;

const SIZE: (f64, f64) = (920.0, 480.0);
/// Right edge of the plot and left edge of the legend.
const RIGHT: f64 = 760.0;
const MARGIN: (f64, f64) = (72.0, 48.0);
const COLOURS: [&str; 12] = [
    "#1b6ca8", "#c8553d", "#588157", "#7b2d8b", "#b08900", "#444444", "#00a0a0", "#e75480", "#8a5a00",
    "#6a9fd8", "#9acd32", "#b0b0b0",
];

/// Titles and axes of a plot.
pub struct Plot {
    /// Title above the plot.
    pub title: String,
    /// Small print below the title; may be empty.
    pub note: String,
    /// Title of the horizontal axis.
    pub across: &'static str,
    /// Title of the vertical axis.
    pub up: &'static str,
    /// Scale of the vertical axis.
    pub up_scale: Scale,
}

/// Scale of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Equal factors have equal lengths.
    Logarithmic,
    /// Equal differences have equal lengths.
    Linear,
}

/// Points connected by a line, in its order; all values are positive.
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Horizontal and vertical values.
    pub points: Vec<(f64, f64)>,
    /// Labels of the first points; may be empty.
    pub labels: Vec<String>,
}

impl Plot {
    /// Draws the series.
    pub fn svg(&self, series: &[Series]) -> String {
        let all = || series.iter().flat_map(|s| &s.points).filter(|p| p.0 > 0.0 && p.1 > 0.0);
        let x = Axis::of(all().map(|p| p.0), MARGIN.0, RIGHT, Scale::Logarithmic);
        let y = Axis::of(all().map(|p| p.1), SIZE.1 - MARGIN.1, 40.0, self.up_scale);
        let (w, h) = SIZE;
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {w} {h}\" font-family=\"sans-serif\" font-size=\"12\">\n\
             <rect width=\"{w}\" height=\"{h}\" fill=\"white\"/>\n\
             <text x=\"{}\" y=\"20\" font-size=\"15\">{}</text>\n\
             <text x=\"{}\" y=\"35\" font-size=\"10\" fill=\"#555\">{}</text>\n",
            MARGIN.0,
            escaped(&self.title),
            MARGIN.0,
            escaped(&self.note)
        );
        let (left, right, bottom, top) = (x.from, x.to, y.from, y.to);
        let mut line = |x1: f64, y1: f64, x2: f64, y2: f64| {
            writeln!(
                out,
                "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"#ddd\"/>"
            )
        };
        for tick in x.ticks() {
            let _ = line(x.at(tick), bottom, x.at(tick), top);
        }
        for tick in y.ticks() {
            let _ = line(left, y.at(tick), right, y.at(tick));
        }
        for tick in x.ticks() {
            let at = x.at(tick);
            let _ = writeln!(
                out,
                "<text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{tick}</text>",
                bottom + 16.0
            );
        }
        for tick in y.ticks() {
            let at = y.at(tick) + 4.0;
            let _ = writeln!(
                out,
                "<text x=\"{:.1}\" y=\"{at:.1}\" text-anchor=\"end\">{tick}</text>",
                left - 6.0
            );
        }
        let _ = writeln!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\n\
             <text transform=\"translate(16 {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
            (left + right) / 2.0,
            h - 10.0,
            escaped(self.across),
            (bottom + top) / 2.0,
            escaped(self.up)
        );
        for (number, series) in series.iter().enumerate() {
            let colour = COLOURS[number % COLOURS.len()];
            let points: Vec<String> =
                series.points.iter().map(|p| format!("{:.1},{:.1}", x.at(p.0), y.at(p.1))).collect();
            let _ = writeln!(
                out,
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"/>",
                points.join(" ")
            );
            for p in &series.points {
                let _ = writeln!(
                    out,
                    "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3.5\" fill=\"{colour}\"/>",
                    x.at(p.0),
                    y.at(p.1)
                );
            }
            for (p, label) in series.points.iter().zip(&series.labels) {
                let _ = writeln!(
                    out,
                    "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"11\" fill=\"{colour}\">{}</text>",
                    x.at(p.0) + 6.0,
                    y.at(p.1) - 5.0,
                    escaped(label)
                );
            }
            let at = 52.0 + 18.0 * number as f64;
            let _ = writeln!(
                out,
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"4\" fill=\"{colour}\"/><text x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                right + 16.0,
                at,
                right + 26.0,
                at + 4.0,
                escaped(&series.name)
            );
        }
        out.push_str("</svg>\n");
        out
    }
}

/// Returns a text as it is written between tags.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

struct Axis {
    scale: Scale,
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Axis {
    fn of(values: impl Iterator<Item = f64>, from: f64, to: f64, scale: Scale) -> Self {
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

    fn at(&self, value: f64) -> f64 {
        let share = match self.scale {
            Scale::Logarithmic => (value / self.low).ln() / (self.high / self.low).ln(),
            Scale::Linear => (value - self.low) / (self.high - self.low),
        };
        self.from + (self.to - self.from) * share
    }

    /// Returns 1, 2 and 5 times powers of ten; on a linear axis, four to ten multiples of one of these.
    fn ticks(&self) -> Vec<f64> {
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
    fn names_are_text_not_markup() {
        let (title, note) = ("a < b & c".to_owned(), String::new());
        let plot = Plot { title, note, across: "s", up: "<i>", up_scale: Scale::Linear };
        let series = Series { name: "R&D".into(), points: vec![(1.0, 2.0)], labels: vec!["</svg>".into()] };
        let svg = plot.svg(&[series]);
        for expected in [">a &lt; b &amp; c<", ">&lt;i&gt;<", ">R&amp;D<", ">&lt;/svg&gt;<"] {
            assert!(svg.contains(expected), "{expected}: {svg}");
        }
        assert_eq!(svg.matches("</svg>").count(), 1);
    }

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
