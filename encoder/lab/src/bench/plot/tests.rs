use super::*;

fn series(name: &str, style: Style, points: &[(f64, f64)], labels: &[&str]) -> Series {
    let labels = labels.iter().map(|label| (*label).to_owned()).collect();
    Series { name: name.into(), style, points: points.to_vec(), labels, spreads: Vec::new() }
}

fn plot(title: &str) -> Plot {
    Plot { title: title.into(), note: String::new(), across: "s", up: "<i>", up_scale: Scale::Linear }
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
        series("others", Style::Crosses, &[(20.0, 0.2)], &["16/20"]),
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
    // Crosses of the point and of the legend.
    assert_eq!(svg.matches("<path").count(), 2);
    assert_eq!(svg.matches("class=\"label\"").count(), 4);
}

#[test]
fn a_second_plot_has_its_own_axes_and_spreads_are_drawn() {
    let mut ours = series("ours", Style::Points, &[(1.0, 0.8)], &["x"]);
    ours.spreads = vec![0.05];
    let theirs = [series("theirs", Style::Crosses, &[(129.0, 28.67)], &["16/20"])];
    let svg = plot("ours").svg_beside(&[ours], Some((&plot("theirs"), &theirs)));
    assert!(svg.contains("viewBox=\"0 0 1260 480\""), "{svg}");
    assert!(svg.contains(&format!("stroke=\"{}\" stroke-width=\"1\"", COLOURS[0])), "a whisker: {svg}");
    // The vertical axis of the first ends near its own point.
    assert!(svg.contains(">0.8<") && svg.contains(">28.6<") && svg.contains(">16/20<"), "{svg}");
}
