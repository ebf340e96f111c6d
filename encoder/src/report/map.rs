//! The cells and cameras of an encode from above, as SVG.

use std::fmt::Write as _;

use glam::DVec3;

use super::recorder::{Recorded, RecordedView};
use crate::html::escaped;

const WIDTH: f64 = 640.0;
const MARGIN: f64 = 12.0;

/// Draws the map: x to the right, y up.
pub(super) fn svg(recorded: &Recorded) -> String {
    let corners = recorded.cells.iter().flat_map(|cell| [cell.min, cell.max]);
    let points: Vec<DVec3> =
        corners.chain(recorded.views.iter().map(|view| view.position_in_world)).collect();
    let low = points.iter().copied().reduce(DVec3::min).unwrap_or_default();
    let size = (points.iter().copied().reduce(DVec3::max).unwrap_or_default() - low).max(DVec3::splat(1e-6));
    let scale = (WIDTH - 2.0 * MARGIN) / size.x.max(size.y);
    let height = size.y * scale + 2.0 * MARGIN;
    let place = |point: DVec3| {
        let at = (point - low) * scale;
        [MARGIN + at.x, height - MARGIN - at.y]
    };
    let most = recorded.views.iter().filter_map(|view| view.n_masks).max().unwrap_or(1).max(1) as f64;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height:.1}\" width=\"{WIDTH}\" role=\"img\" aria-label=\"Map\">"
    );
    for cell in &recorded.cells {
        let ([x, bottom], [right, y]) = (place(cell.min), place(cell.max));
        let _ = write!(
            out,
            "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"none\" stroke=\"#99a\"/>",
            right - x,
            bottom - y
        );
    }
    for view in &recorded.views {
        let [x, y] = place(view.position_in_world);
        let (colour, said) = look(view, most);
        let _ = write!(
            out,
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{colour}\"><title>{}</title></circle>",
            escaped(&format!("{}: {said}", view.name))
        );
    }
    out.push_str("</svg>");
    out
}

/// Returns the colour of a view, the darker the more masks it has, and what is said of it.
fn look(view: &RecordedView, most: f64) -> (String, String) {
    match (&view.reason, view.n_masks) {
        (Some(reason), _) => ("#d33".into(), format!("left out, {reason}")),
        (None, None) => ("#999".into(), "done by an earlier run or another machine".into()),
        (None, Some(n)) => {
            let lightness = 75.0 - 50.0 * n as f64 / most;
            (format!("hsl(210 80% {lightness:.0}%)"), format!("{n} masks"))
        }
    }
}
