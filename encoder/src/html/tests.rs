use serde_json::json;

use super::*;

#[test]
fn foreign_text_stays_text() {
    let mut page = Page::new("<b>");
    page.heading("a < b");
    page.table(&["x & y"], &[vec!["<script>alert(1)</script>".into()], vec!["\" onload=\"".into()]]);
    page.picture(b"foo", "\"><img src=x>");
    let html = page.finish();
    assert_eq!(
        html.matches("<script").count() + html.matches("<b>").count() + html.matches("<img src").count(),
        0
    );
    let holds = html.contains("a &lt; b") && html.contains("x &amp; y") && html.contains("base64,Zm9v\"");
    assert!(holds, "{html}");
}

#[test]
fn results_become_tables() {
    let mut page = Page::new("t");
    page.value(&json!({
        "n_views": 3, "share": 0.123456, "names": ["a", "b"],
        "cells": [{ "id": 1, "bytes": 20 }, { "id": 2, "error": 1.5e-5 }],
        "views": { "view": ["p", "q"], "secs": [1.25, 2000.5] },
    }));
    let html = page.finish();
    for expected in [
        "<td>n views</td><td class=\"n\">3</td>",
        "<td>share</td><td class=\"n\">0.123</td>",
        "<td>names</td><td>a, b</td>",
        "<tr><td class=\"n\">20</td><td class=\"n\">1</td><td></td></tr>",
        "<tr><td></td><td class=\"n\">2</td><td class=\"n\">1.500e-5</td></tr>",
        "<tr><td class=\"n\">1.250</td><td>p</td></tr>",
        "<tr><td class=\"n\">2000</td><td>q</td></tr>",
    ] {
        assert!(html.contains(expected), "{expected}: {html}");
    }
}
