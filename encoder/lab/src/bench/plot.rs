//! The Pareto plot of a cost (logarithmic, across) and an accuracy (up), as SVG.
//!
//! Not the crate `plotters`: what its axes and series would replace is shorter than their set-up.

use std::fmt::Write;

use slag_encoder::html::escaped;

const SIZE: [f64; 2] = [920.0, 480.0];
const LEFT: f64 = 72.0;
const RIGHT: f64 = 896.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 432.0;
const FRONT: &str = "#c02020";
const BEATEN: &str = "#8a8a8a";

/// A measured setting; both values are positive.
pub(super) struct PlotPoint {
    pub(super) name: String,
    pub(super) cost: f64,
    pub(super) accuracy: f64,
    /// Whether no other point is as cheap and as accurate.
    pub(super) is_on_front: bool,
}

/// Draws points, of which there is at least one, and their front as a staircase: what a budget buys. Points on the
/// front have their names beside them, all have them as tooltips.
pub(super) fn svg(title: &str, [across, up]: [&str; 2], points: &[PlotPoint]) -> String {
    let x = Axis::of(points.iter().map(|p| p.cost.log10()), LEFT, RIGHT);
    let y = Axis::of(points.iter().map(|p| p.accuracy), BOTTOM, TOP);
    let mut out = Svg(String::new());
    for tick in round_numbers() {
        if (x.low..=x.high).contains(&tick.log10()) {
            let at = x.at(tick.log10());
            out.line(&[[at, BOTTOM], [at, TOP]], "#ddd", 1.0);
            out.text([at, BOTTOM + 16.0], "text-anchor=\"middle\"", &tick.to_string());
        }
    }
    for tick in y.ticks() {
        out.line(&[[LEFT, y.at(tick)], [RIGHT, y.at(tick)]], "#ddd", 1.0);
        out.text([LEFT - 6.0, y.at(tick) + 4.0], "text-anchor=\"end\"", &tick.to_string());
    }
    out.text([LEFT, 20.0], "font-size=\"15\"", title);
    out.text([LEFT, 35.0], "fill=\"#555\"", up);
    out.text([0.5 * (LEFT + RIGHT), SIZE[1] - 10.0], "text-anchor=\"middle\"", across);
    let place = |point: &PlotPoint| [x.at(point.cost.log10()), y.at(point.accuracy)];
    let mut front: Vec<[f64; 2]> = points.iter().filter(|p| p.is_on_front).map(place).collect();
    front.sort_by(|a, b| a[0].total_cmp(&b[0]));
    out.line(&staircase(&front), FRONT, 1.5);
    for point in points {
        let [x, y] = place(point);
        let colour = if point.is_on_front { FRONT } else { BEATEN };
        let name = escaped(&point.name);
        out.add(format_args!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{colour}\"><title>{name}</title></circle>"
        ));
        if point.is_on_front {
            out.text([x, y - 8.0], "text-anchor=\"end\" font-size=\"10\"", &point.name);
        }
    }
    let ([w, h], body) = (SIZE, out.0);
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {w} {h}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"{w}\" height=\"{h}\" fill=\"white\"/>\n{body}</svg>\n"
    )
}

/// Returns the corners of a staircase through points: right, then up, and at the end to the right edge.
fn staircase(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mut corners: Vec<[f64; 2]> = Vec::new();
    for point in points.iter().copied().chain(points.last().map(|last| [RIGHT, last[1]])) {
        corners.extend(corners.last().map(|last| [point[0], last[1]]));
        corners.push(point);
    }
    corners
}

/// The elements of a drawing.
struct Svg(String);

impl Svg {
    fn add(&mut self, element: std::fmt::Arguments<'_>) {
        // Writing to a string does not fail.
        writeln!(self.0, "{element}").unwrap_or_default();
    }

    fn line(&mut self, points: &[[f64; 2]], colour: &str, width: f64) {
        let points: Vec<String> = points.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
        let points = points.join(" ");
        self.add(format_args!(
            "<polyline points=\"{points}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\"/>"
        ));
    }

    fn text(&mut self, [x, y]: [f64; 2], attributes: &str, text: &str) {
        self.add(format_args!("<text x=\"{x:.1}\" y=\"{y:.1}\" {attributes}>{}</text>", escaped(text)));
    }
}

/// An axis between two values and two places on the page.
struct Axis {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Axis {
    fn of(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        let margin = (0.08 * (high - low)).max(0.01);
        Self { low: low - margin, high: high + margin, from, to }
    }

    fn at(&self, value: f64) -> f64 {
        self.from + (self.to - self.from) * (value - self.low) / (self.high - self.low)
    }

    /// Returns four to ten multiples of a round number.
    fn ticks(&self) -> Vec<f64> {
        let step = round_numbers().find(|step| (self.high - self.low) / step <= 10.0).unwrap_or(1.0);
        let multiples = (self.low / step).ceil() as i64..=(self.high / step).floor() as i64;
        // Removes digits beyond the step's, which come from rounding the product.
        let digits = (-step.log10().floor()).max(0.0) as usize;
        multiples.map(|n| format!("{:.digits$}", n as f64 * step).parse().unwrap_or(0.0)).collect()
    }
}

/// Returns 1, 2 and 5 times powers of ten, ascending.
fn round_numbers() -> impl Iterator<Item = f64> {
    let factors = |e: i32| [1.0, 2.0, 5.0].map(|m| format!("{m}e{e}").parse::<f64>().unwrap_or(1.0));
    (-9..9).flat_map(factors)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_text_and_the_front_is_a_staircase() {
        let point = |name: &str, cost, accuracy, is_on_front| PlotPoint {
            name: name.into(),
            cost,
            accuracy,
            is_on_front,
        };
        let points =
            [point("R&D", 9.0, 0.4, true), point("</svg>", 3.0, 0.2, false), point("quick", 1.0, 0.1, true)];
        let svg = svg("a < b", ["s", "<i>"], &points);
        for expected in [">a &lt; b<", ">&lt;i&gt;<", "<title>&lt;/svg&gt;</title>"] {
            assert!(svg.contains(expected), "{expected}: {svg}");
        }
        assert_eq!(svg.matches("</svg>").count(), 1);
        assert_eq!((svg.matches(">R&amp;D</text>").count(), svg.matches("&lt;/svg&gt;").count()), (1, 1));
        let front = svg.lines().find(|line| line.starts_with("<polyline") && line.contains(FRONT));
        let corners: Vec<Vec<f64>> = front
            .and_then(|line| line.split('"').nth(1))
            .expect("a front")
            .split(' ')
            .map(|corner| corner.split(',').map(|v| v.parse().expect("a number")).collect())
            .collect();
        // From the quickest to the right and up, and on to the edge: the best holds for every larger budget.
        assert_eq!(corners.len(), 5, "{corners:?}");
        assert!(corners.windows(2).all(|w| w[0][0] == w[1][0] || w[0][1] == w[1][1]), "{corners:?}");
        assert!(corners[4][0] == RIGHT && corners[4][1] < corners[0][1], "{corners:?}");
    }

    #[test]
    fn ticks_are_round_and_inside() {
        let axis = Axis::of([0.163, 0.219].into_iter(), 100.0, 0.0);
        assert_eq!(axis.ticks(), [0.16, 0.17, 0.18, 0.19, 0.2, 0.21, 0.22]);
        assert!((axis.at(0.191) - 50.0).abs() < 1e-9 && axis.at(0.2) < axis.at(0.19));
        // A single value gives an axis too.
        assert!(Axis::of([0.5].into_iter(), 0.0, 1.0).at(0.5).is_finite());
    }
}
