//! Plots as SVG with a logarithmic horizontal axis.
//!
//! Not the crate `plotters`: ticks and scales are 60 lines here; its axes are of another type for each scale, and the
//! legend beside the plot and the places of labels would still be ours.

mod axis;
mod labels;
#[cfg(test)]
mod tests;

use std::fmt::Write;

use axis::Axis;
pub use axis::Scale;
use labels::{HEIGHT, POINT, Rect};

const SIZE: (f64, f64) = (920.0, 480.0);
/// Width of the plot beside the first.
const BESIDE: f64 = 340.0;
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

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Style {
    /// Points, and a line through them in their order.
    Line,
    /// Points without a line: they have no order.
    Points,
    /// Crosses without a line: points that somebody else measured.
    Crosses,
    /// A staircase in a colour of its own, through points that ascend in both values: what a budget buys. It goes on to
    /// the right edge.
    Steps,
}

/// Named points; all values are positive.
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// How it is drawn.
    pub style: Style,
    /// Horizontal and vertical values.
    pub points: Vec<(f64, f64)>,
    /// Labels of the first points; may be empty.
    pub labels: Vec<String>,
    /// Vertical spread of the first points, drawn to both sides; may be empty.
    pub spreads: Vec<f64>,
}

impl Plot {
    /// Draws the series.
    pub fn svg(&self, series: &[Series]) -> String {
        self.svg_beside(series, None)
    }

    /// Draws the series, with a second plot, on axes of its own, to the right.
    pub fn svg_beside(&self, series: &[Series], beside: Option<(&Plot, &[Series])>) -> String {
        let (w, h) = (SIZE.0 + beside.map_or(0.0, |_| BESIDE), SIZE.1);
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {w} {h}\" font-family=\"sans-serif\" font-size=\"12\">\n\
             <rect width=\"{w}\" height=\"{h}\" fill=\"white\"/>\n"
        );
        self.draw(series, MARGIN.0, RIGHT, &mut out);
        for (number, series) in series.iter().enumerate() {
            let (x, y, colour) = (RIGHT + 16.0, 52.0 + 18.0 * number as f64, colour(number, series.style));
            marker((x, y), series.style, colour, &mut out);
            text((x + 10.0, y + 4.0), "", &series.name, &mut out);
        }
        if let Some((plot, series)) = beside {
            plot.draw(series, SIZE.0 + 52.0, w - 16.0, &mut out);
        }
        out.push_str("</svg>\n");
        out
    }

    /// Draws one plot between two places of the page.
    fn draw(&self, series: &[Series], left: f64, right: f64, out: &mut String) {
        let all = || series.iter().flat_map(|s| &s.points).filter(|p| p.0 > 0.0 && p.1 > 0.0);
        let spread = |sign: f64| {
            series
                .iter()
                .flat_map(move |s| s.points.iter().zip(&s.spreads).map(move |(p, by)| p.1 + sign * by))
        };
        let ups = all().map(|p| p.1).chain(spread(-1.0)).chain(spread(1.0)).filter(|up| *up > 0.0);
        let x = Axis::of(all().map(|p| p.0), left, right, Scale::Logarithmic);
        let y = Axis::of(ups, SIZE.1 - MARGIN.1, TOP, self.up_scale);
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
                Style::Points | Style::Crosses => {}
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
        let mut places = labels::place(&at, &texts, &frame, &whiskers);
        if places.contains(&None) {
            places = labels::place(&at, &texts, &frame, &[]);
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
        Style::Crosses => {
            let _ = writeln!(
                out,
                "<path d=\"M{:.1} {:.1}l8 8m0 -8l-8 8\" stroke=\"{colour}\" stroke-width=\"2\"/>",
                x - 4.0,
                y - 4.0
            );
        }
        Style::Steps => line((x - 6.0, y), (x + 6.0, y), colour, 2.0, out),
    }
}

fn text(at: (f64, f64), attributes: &str, text: &str, out: &mut String) {
    let _ = writeln!(out, "<text x=\"{:.1}\" y=\"{:.1}\"{attributes}>{}</text>", at.0, at.1, escaped(text));
}

/// Returns a text as it is written between tags.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}
