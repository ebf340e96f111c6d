//! Plots as SVG with a logarithmic horizontal axis.
//!
//! Not the crate `plotters`: ticks and scales are 60 lines here; its axes are of another type for each scale, and
//! the legend beside the plot and the places of labels would still be ours.

use std::fmt::Write;

use slag_encoder::html::escaped;

const SIZE: (f64, f64) = (920.0, 480.0);
/// Right edge of the plot and left edge of the legend.
const RIGHT: f64 = 760.0;
const MARGIN: (f64, f64) = (72.0, 48.0);
const TOP: f64 = 40.0;
const COLOURS: [&str; 12] = [
    "#1b6ca8", "#c8553d", "#588157", "#7b2d8b", "#b08900", "#444444", "#00a0a0", "#e75480", "#8a5a00",
    "#6a9fd8", "#9acd32", "#b0b0b0",
];
/// Colour of steps, which no other series has.
const STEPS: &str = "#e00000";

pub(super) struct Plot {
    pub(super) title: String,
    /// Small print below the title; may be empty.
    pub(super) note: String,
    pub(super) across: &'static str,
    pub(super) up: &'static str,
}

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Style {
    /// Points, and a line through them in their order.
    Line,
    /// Points without a line: they have no order.
    Points,
    /// A staircase in a colour of its own, through points that ascend in both values: what a budget buys. It goes
    /// on to the right edge.
    Steps,
}

/// Named points; all values are positive.
pub(super) struct Series {
    pub(super) name: String,
    pub(super) style: Style,
    pub(super) points: Vec<(f64, f64)>,
    /// Labels of the first points; may be empty.
    pub(super) labels: Vec<String>,
    /// Vertical spread of the first points, drawn to both sides; may be empty.
    pub(super) spreads: Vec<f64>,
}

impl Plot {
    pub(super) fn svg(&self, series: &[Series]) -> String {
        let (w, h) = SIZE;
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {w} {h}\" font-family=\"sans-serif\" font-size=\"12\">\n\
             <rect width=\"{w}\" height=\"{h}\" fill=\"white\"/>\n"
        );
        self.draw(series, &mut out);
        for (number, series) in series.iter().enumerate() {
            let (x, y, colour) = (RIGHT + 16.0, 52.0 + 18.0 * number as f64, colour(number, series.style));
            marker((x, y), series.style, colour, &mut out);
            text((x + 10.0, y + 4.0), "", &series.name, &mut out);
        }
        out.push_str("</svg>\n");
        out
    }

    fn draw(&self, series: &[Series], out: &mut String) {
        let (left, right) = (MARGIN.0, RIGHT);
        let all = || series.iter().flat_map(|s| &s.points).filter(|p| p.0 > 0.0 && p.1 > 0.0);
        let spread = |sign: f64| {
            series
                .iter()
                .flat_map(move |s| s.points.iter().zip(&s.spreads).map(move |(p, by)| p.1 + sign * by))
        };
        let ups = all().map(|p| p.1).chain(spread(-1.0)).chain(spread(1.0)).filter(|up| *up > 0.0);
        let x = Axis::of(all().map(|p| p.0), left, right, Scale::Logarithmic);
        let y = Axis::of(ups, SIZE.1 - MARGIN.1, TOP, Scale::Linear);
        let bottom = y.from;
        text((left, 20.0), " font-size=\"15\"", &self.title, out);
        text((left, 35.0), " font-size=\"10\" fill=\"#555\"", &self.note, out);
        for tick in x.ticks() {
            line((x.at(tick), bottom), (x.at(tick), TOP), "#ddd", 1.0, out);
            text((x.at(tick), bottom + 16.0), " text-anchor=\"middle\"", &tick.to_string(), out);
        }
        for tick in y.ticks() {
            line((left, y.at(tick)), (right, y.at(tick)), "#ddd", 1.0, out);
            text((left - 6.0, y.at(tick) + 4.0), " text-anchor=\"end\"", &tick.to_string(), out);
        }
        text(((left + right) / 2.0, SIZE.1 - 10.0), " text-anchor=\"middle\"", self.across, out);
        let _ = writeln!(
            out,
            "<text transform=\"translate({:.1} {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
            left - 46.0,
            (bottom + TOP) / 2.0,
            escaped(self.up)
        );
        let page = |p: &(f64, f64)| (x.at(p.0), y.at(p.1));
        // Labels are placed for all series at once.
        let (mut at, mut texts, mut colours, mut whiskers) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (number, series) in series.iter().enumerate() {
            let colour = colour(number, series.style);
            let points: Vec<(f64, f64)> = series.points.iter().map(page).collect();
            match series.style {
                Style::Line => polyline(&points, colour, 2.0, out),
                Style::Steps => polyline(&staircase(&points, right), colour, 1.5, out),
                Style::Points => {}
            }
            for (p, by) in series.points.iter().zip(&series.spreads) {
                let (low, high) = (page(&(p.0, p.1 - by)), page(&(p.0, p.1 + by)));
                line(low, high, colour, 1.0, out);
                whiskers.push(Rect { left: low.0 - 1.0, right: low.0 + 1.0, top: high.1, bottom: low.1 });
            }
            if series.style != Style::Steps {
                points.iter().for_each(|p| marker(*p, series.style, colour, out));
            }
            for (number, p) in points.iter().enumerate().filter(|_| series.style != Style::Steps) {
                at.push(*p);
                texts.push(series.labels.get(number).map_or("", String::as_str));
                colours.push(colour);
            }
        }
        let frame = Rect { left, top: TOP, right, bottom };
        // A label without a place beside the whiskers may cross one, but never another label.
        let mut places = place(&at, &texts, &frame, &whiskers);
        if places.contains(&None) {
            places = place(&at, &texts, &frame, &[]);
        }
        for (((p, label), place), colour) in at.iter().zip(texts).zip(places).zip(colours) {
            let Some(rect) = place.filter(|_| !label.is_empty()) else { continue };
            let near = (p.0.clamp(rect.left, rect.right), p.1.clamp(rect.top, rect.bottom));
            if (near.0 - p.0).hypot(near.1 - p.1) > 2.0 * POINT {
                line(*p, near, colour, 0.5, out);
            }
            let attributes = format!(" class=\"label\" font-size=\"10\" fill=\"{colour}\"");
            text((rect.left, rect.top + HEIGHT - 3.0), &attributes, label, out);
        }
    }
}

fn colour(number: usize, style: Style) -> &'static str {
    if style == Style::Steps { STEPS } else { COLOURS[number % COLOURS.len()] }
}

/// Returns the corners of a staircase through points: right, then up, and at the end to the edge.
fn staircase(points: &[(f64, f64)], right: f64) -> Vec<(f64, f64)> {
    let mut corners: Vec<(f64, f64)> = Vec::new();
    for p in points {
        corners.extend(corners.last().map(|last| (p.0, last.1)));
        corners.push(*p);
    }
    corners.extend(corners.last().map(|last| (right, last.1)));
    corners
}

fn polyline(points: &[(f64, f64)], colour: &str, width: f64, out: &mut String) {
    let points: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", p.0, p.1)).collect();
    let _ = writeln!(
        out,
        "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\"/>",
        points.join(" ")
    );
}

fn line(from: (f64, f64), to: (f64, f64), colour: &str, width: f64, out: &mut String) {
    let _ = writeln!(
        out,
        "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"{colour}\" stroke-width=\"{width}\"/>",
        from.0, from.1, to.0, to.1
    );
}

fn marker(at: (f64, f64), style: Style, colour: &str, out: &mut String) {
    let (x, y) = at;
    match style {
        Style::Line | Style::Points => {
            let _ = writeln!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3.5\" fill=\"{colour}\"/>");
        }
        Style::Steps => line((x - 6.0, y), (x + 6.0, y), colour, 2.0, out),
    }
}

fn text(at: (f64, f64), attributes: &str, text: &str, out: &mut String) {
    let _ = writeln!(out, "<text x=\"{:.1}\" y=\"{:.1}\"{attributes}>{}</text>", at.0, at.1, escaped(text));
}

/// Scale of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scale {
    /// Equal factors have equal lengths.
    Logarithmic,
    /// Equal differences have equal lengths.
    Linear,
}

/// An axis between two values and two places on the page.
struct Axis {
    scale: Scale,
    low: f64,
    high: f64,
    /// Where the axis begins on the page, pixels.
    from: f64,
    /// Where it ends.
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

/// A rectangle on the page, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Rect {
    left: f64,
    top: f64,
    right: f64,
    bottom: f64,
}

impl Rect {
    fn meets(&self, other: &Self) -> bool {
        self.left < other.right
            && other.left < self.right
            && self.top < other.bottom
            && other.top < self.bottom
    }

    fn is_inside(&self, outer: &Self) -> bool {
        self.left >= outer.left
            && self.right <= outer.right
            && self.top >= outer.top
            && self.bottom <= outer.bottom
    }
}

/// Height of a label, pixels.
const HEIGHT: f64 = 12.0;
/// Width of a character, pixels: an upper bound on the mean of sans-serif fonts at 10 pixels.
const CHAR_WIDTH: f64 = 6.0;
/// Half the width of a point with its rim, pixels.
const POINT: f64 = 5.0;
/// Distances of a label from its point, in steps.
const RINGS: usize = 24;
const RING_STEP: f64 = 7.0;
const DIRECTIONS: usize = 16;

/// Returns a label's place for each point, nearest places first; `None` where none is free.
fn place(points: &[(f64, f64)], texts: &[&str], plot: &Rect, taken: &[Rect]) -> Vec<Option<Rect>> {
    let of_point =
        |(x, y): &(f64, f64)| Rect { left: x - POINT, top: y - POINT, right: x + POINT, bottom: y + POINT };
    let mut taken: Vec<Rect> = taken.iter().copied().chain(points.iter().map(of_point)).collect();
    let mut places = Vec::new();
    for (point, text) in points.iter().zip(texts) {
        let width = CHAR_WIDTH * text.chars().count() as f64;
        let candidates = (0..RINGS).flat_map(|ring| {
            (0..DIRECTIONS).map(move |direction| {
                // The first one is to the upper right.
                let angle = std::f64::consts::TAU * (direction as f64 - 1.5) / DIRECTIONS as f64;
                let away = POINT + 1.0 + RING_STEP * ring as f64;
                let (dx, dy) = (angle.cos(), angle.sin());
                let (x, y) = (point.0 + dx * (away + 0.5 * width), point.1 + dy * (away + 0.5 * HEIGHT));
                Rect {
                    left: x - 0.5 * width,
                    top: y - 0.5 * HEIGHT,
                    right: x + 0.5 * width,
                    bottom: y + 0.5 * HEIGHT,
                }
            })
        });
        let free = |rect: &Rect| rect.is_inside(plot) && !taken.iter().any(|other| rect.meets(other));
        let found = candidates.into_iter().find(free);
        taken.extend(found);
        places.push(found);
    }
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(name: &str, style: Style, points: &[(f64, f64)], labels: &[&str]) -> Series {
        let labels = labels.iter().map(|label| (*label).to_owned()).collect();
        Series { name: name.into(), style, points: points.to_vec(), labels, spreads: Vec::new() }
    }

    fn plot(title: &str) -> Plot {
        Plot { title: title.into(), note: String::new(), across: "s", up: "<i>" }
    }

    #[test]
    fn names_are_text_not_markup() {
        let svg = plot("a < b & c").svg(&[series("R&D", Style::Line, &[(1.0, 2.0)], &["</svg>"])]);
        for expected in [">a &lt; b &amp; c<", ">&lt;i&gt;<", ">R&amp;D<", ">&lt;/svg&gt;<"] {
            assert!(svg.contains(expected), "{expected}: {svg}");
        }
        assert_eq!(svg.matches("</svg>").count(), 1);
    }

    /// Only series with an order have a line; the front has a colour of its own and right angles.
    #[test]
    fn lines_are_for_what_has_an_order() {
        let points = [(1.0, 0.1), (3.0, 0.3), (9.0, 0.4)];
        let all = [
            series("choice", Style::Points, &points, &["a", "b", "c"]),
            series("amount", Style::Line, &points[..2], &[]),
            series("front", Style::Steps, &points, &[]),
        ];
        let svg = plot("t").svg(&all);
        let lines: Vec<&str> = svg.lines().filter(|line| line.starts_with("<polyline")).collect();
        assert_eq!(lines.len(), 2, "{svg}");
        assert!(lines[0].contains(COLOURS[1]) && lines[1].contains(STEPS), "{lines:?}");
        assert!(!COLOURS.contains(&STEPS));
        let corners: Vec<Vec<f64>> = lines[1]
            .split('"')
            .nth(1)
            .expect("points")
            .split(' ')
            .map(|corner| corner.split(',').map(|v| v.parse().expect("a number")).collect())
            .collect();
        assert_eq!(corners.len(), 6);
        assert!(corners.windows(2).all(|w| w[0][0] == w[1][0] || w[0][1] == w[1][1]), "{corners:?}");
        assert_eq!(corners[5][0], RIGHT, "the best point holds for every larger budget");
        assert_eq!(svg.matches("class=\"label\"").count(), 3);
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

    #[test]
    fn labels_lie_on_nothing() {
        let plot = Rect { left: 0.0, top: 0.0, right: 400.0, bottom: 300.0 };
        // Many points in one place, and in the corners.
        let mut points: Vec<(f64, f64)> =
            (0..20).map(|n| (200.0 + f64::from(n % 3), 150.0 + 2.0 * f64::from(n))).collect();
        points.extend([(1.0, 1.0), (399.0, 299.0), (399.0, 1.0)]);
        let texts = vec!["views 12.5%"; points.len()];
        let places = place(&points, &texts, &plot, &[]);
        for (a, place) in places.iter().enumerate() {
            let place = place.expect("there is room for all");
            assert!(place.left >= 0.0 && place.top >= 0.0 && place.right <= 400.0 && place.bottom <= 300.0);
            for other in places[..a].iter().flatten() {
                assert!(
                    place.right <= other.left
                        || other.right <= place.left
                        || place.bottom <= other.top
                        || other.bottom <= place.top,
                    "{place:?} lies on {other:?}"
                );
            }
            for (x, y) in &points {
                let inside = (place.left..place.right).contains(x) && (place.top..place.bottom).contains(y);
                assert!(!inside, "{place:?} lies on a point");
            }
        }
        let full = Rect { left: 0.0, top: 0.0, right: 20.0, bottom: 10.0 };
        assert_eq!(place(&[(10.0, 5.0)], &["long label"], &full, &[]), [None]);
    }
}
