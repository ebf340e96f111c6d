//! The report of an encode: one page with its views, masks, objects, cells, errors by profile, and what was left
//! out and why.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::{Mutex, MutexGuard, PoisonError};

use glam::DVec3;
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use serde_json::Value;
use slag_common::View;
use slag_common::frames::Aabb;

use crate::encode::EncodeSummary;
use crate::html::{Page, escaped};
use crate::progress::{FoundObject, Progress};

pub(crate) fn of_encode(
    scene: &str,
    summary: &EncodeSummary,
    recorder: &Recorder<'_>,
) -> serde_json::Result<String> {
    let recorded = recorder.recorded();
    let mut rest = serde_json::to_value(summary)?;
    let mut take = |name: &str| rest.as_object_mut().and_then(|members| members.remove(name));
    let lists = ["skipped_views", "views", "cells", "phases", "view_stages"].map(&mut take);
    let [skipped, views, cells, phases, stages] = lists.map(Option::unwrap_or_default);
    let [found_objects, occupancy, bytes, busy] =
        ["objects", "occupancy", "shard_bytes", "busy_secs"].map(&mut take).map(Option::unwrap_or_default);
    let mut page = Page::new(&format!("{scene}, generation {}", summary.generation));
    opening(&mut page, summary);
    left_out(&mut page, summary, &skipped);
    if let Some(lost) = &summary.lost_views {
        page.heading("Kept views");
        page.paragraph(&lost.reason);
    }
    page.heading("Map");
    page.drawing(&map_svg(&recorded), "Seen from above: cells, and the cameras by their number of masks");
    masks(&mut page, &recorded);
    objects(&mut page, summary, &recorded, &found_objects);
    if !occupancy.is_null() {
        page.heading("Free and occupied places");
        page.value(&occupancy);
    }
    page.heading("Profiles");
    page.paragraph(
        "Bytes of the shards, and the error of their scores relative to the spread of scores: mean over the cells by Gaussians, \
         and that of the worst cell.",
    );
    page.table(&["profile", "bytes", "mean error", "worst cell"], &profiles(summary, &bytes));
    page.heading("Time");
    page.records(&phases);
    page.paragraph("Stages of the views:");
    page.records(&stages);
    page.paragraph("Seconds by stage, added over threads:");
    page.value(&busy);
    page.heading("Cells");
    page.records(&cells);
    page.heading("Views");
    page.records(&views);
    page.heading("All else");
    page.value(&rest);
    Ok(page.finish())
}

fn opening(page: &mut Page, summary: &EncodeSummary) {
    page.paragraph(&format!(
        "{} Gaussians in {} cells, from {} masks of {} photos, in {:.1} s with {}.",
        summary.n_gaussians,
        summary.n_cells,
        summary.n_masks,
        summary.n_views,
        summary.wall_secs,
        summary.encoder
    ));
    if summary.n_views_drawn > 0 {
        page.paragraph(&format!(
            "{} of the views are drawings of the splat, no photos.",
            summary.n_views_drawn
        ));
    }
}

fn left_out(page: &mut Page, summary: &EncodeSummary, skipped: &Value) {
    page.heading("Left out");
    match summary.skipped_views.len() {
        0 => page.paragraph("No view was left out."),
        n => {
            page.paragraph(&format!("{n} views were left out."));
            page.records(skipped);
        }
    }
    page.paragraph(&format!(
        "{} views have no mask; {} Gaussians are seen by no mask and have no embedding; {} are unusable.",
        summary.n_views_without_masks, summary.n_without_evidence, summary.n_rejected
    ));
}

fn masks(page: &mut Page, recorded: &Recorded) {
    let mut drawn: Vec<_> = recorded.views.iter().filter(|view| view.picture.is_some()).collect();
    drawn.sort_by(|a, b| a.name.cmp(&b.name));
    if !drawn.is_empty() {
        page.heading("Masks");
    }
    for RecordedView { name, picture, n_masks, .. } in drawn {
        let n_masks = n_masks.unwrap_or_default();
        page.picture(picture.as_deref().unwrap_or_default(), &format!("{name}: {n_masks} masks"));
    }
}

/// `found`: the objects in the summary's JSON.
fn objects(page: &mut Page, summary: &EncodeSummary, recorded: &Recorded, found: &Value) {
    page.heading("Objects");
    match summary.objects.as_ref().map(|found| found.n_objects) {
        None => page.paragraph("Objects were not looked for."),
        Some(0) => page.paragraph("No object was found: no mask is shared by several views."),
        Some(_) => {
            let columns = ["id", "x, y, z", "size", "Gaussians", "masks", "best photo"];
            page.table(&columns, &recorded.objects.iter().map(row_of).collect::<Vec<_>>());
        }
    }
    if !found.is_null() {
        page.value(found);
    }
}

fn row_of(object: &FoundObject) -> Vec<String> {
    let numbers = |of: DVec3| of.to_array().map(|axis| format!("{axis:.2}")).join(", ");
    let FoundObject { id, position_m, bounds, n_gaussians, n_masks, photo } = object;
    let size = bounds.max - bounds.min;
    let [n_gaussians, n_masks] = [n_gaussians, n_masks].map(u32::to_string);
    vec![id.clone(), numbers(*position_m), numbers(size), n_gaussians, n_masks, photo.clone()]
}

/// A row per profile: name, bytes, mean and largest relative error.
fn profiles(summary: &EncodeSummary, bytes: &Value) -> Vec<Vec<String>> {
    let row = |(profile, bytes): (&String, &Value)| {
        let errors = || summary.cells.iter().filter_map(|cell| Some((cell, *cell.score_error.get(profile)?)));
        let n: f64 = errors().map(|(cell, _)| f64::from(cell.n_gaussians)).sum();
        let sum: f64 = errors().map(|(cell, error)| f64::from(cell.n_gaussians) * f64::from(error)).sum();
        let worst = errors().map(|(_, error)| error).fold(0.0, f32::max);
        let figure = |of: f64| if n > 0.0 { format!("{of:.4}") } else { "not known".into() };
        vec![profile.clone(), bytes.to_string(), figure(sum / n), figure(worst.into())]
    };
    bytes.as_object().into_iter().flatten().map(row).collect()
}

const WIDTH: f64 = 640.0;
const MARGIN: f64 = 12.0;

/// The map: x to the right, y up.
fn map_svg(recorded: &Recorded) -> String {
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

/// Colour of a view, darker with more masks, and its tooltip.
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

/// Pictures of masks, evenly spread over the views.
const N_PICTURES: usize = 12;
const JPEG_QUALITY: u8 = 80;

pub(super) struct RecordedView {
    pub(super) name: String,
    pub(super) position_in_world: DVec3,
    /// Once found.
    pub(super) n_masks: Option<usize>,
    pub(super) reason: Option<String>,
    /// Masks drawn over the photo, JPEG.
    pub(super) picture: Option<Vec<u8>>,
}

#[derive(Default)]
pub(super) struct Recorded {
    /// In the order of work.
    pub(super) views: Vec<RecordedView>,
    /// Index in `views`, by name.
    place_of_view: BTreeMap<String, usize>,
    pub(super) cells: Vec<Aabb>,
    pub(super) objects: Vec<FoundObject>,
}

impl Recorded {
    fn view(&mut self, name: &str) -> Option<&mut RecordedView> {
        self.views.get_mut(*self.place_of_view.get(name)?)
    }
}

pub(crate) struct Recorder<'a> {
    shown: &'a dyn Progress,
    recorded: Mutex<Recorded>,
}

impl<'a> Recorder<'a> {
    /// `shown`: the other receiver of the progress.
    pub(crate) fn new(shown: &'a dyn Progress) -> Self {
        Self { shown, recorded: Mutex::default() }
    }

    pub(super) fn recorded(&self) -> MutexGuard<'_, Recorded> {
        self.recorded.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn has_picture(at: usize, n: usize) -> bool {
    at.is_multiple_of(n.div_ceil(N_PICTURES).max(1))
}

fn jpeg(picture: &RgbImage) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY).encode_image(picture).ok()?;
    Some(bytes)
}

impl Progress for Recorder<'_> {
    fn begin(&self, stage: &str, unit: &str, total: u64, done: u64) {
        self.shown.begin(stage, unit, total, done);
    }

    fn advance(&self, n: u64) {
        self.shown.advance(n);
    }

    fn end(&self) {
        self.shown.end();
    }

    fn plan(&self, views: &[&View], cells: &[Aabb]) {
        let view = |view: &&View| RecordedView {
            name: view.name.clone(),
            position_in_world: view.position_in_world(),
            n_masks: None,
            reason: None,
            picture: None,
        };
        let mut recorded = self.recorded();
        recorded.views = views.iter().map(view).collect();
        recorded.place_of_view = views.iter().map(|view| view.name.clone()).zip(0..).collect();
        recorded.cells = cells.to_vec();
    }

    fn segmented(&self, view: &str, n_masks: usize, draw: &dyn Fn() -> RgbImage) {
        let mut recorded = self.recorded();
        let n_views = recorded.views.len();
        let at = recorded.place_of_view.get(view).copied();
        let Some(found) = recorded.view(view) else { return };
        found.n_masks = Some(n_masks);
        if at.is_some_and(|at| has_picture(at, n_views)) {
            // Others go on while this thread draws.
            drop(recorded);
            let picture = jpeg(&draw());
            if let Some(found) = self.recorded().view(view) {
                found.picture = picture;
            }
        }
    }

    fn left_out(&self, view: &str, reason: &str) {
        if let Some(found) = self.recorded().view(view) {
            found.reason = Some(reason.to_owned());
        }
    }

    /// Keeps the largest objects first.
    fn objects(&self, objects: &mut dyn Iterator<Item = FoundObject>) {
        let mut objects: Vec<FoundObject> = objects.collect();
        objects.sort_by(|a, b| b.n_gaussians.cmp(&a.n_gaussians).then_with(|| a.id.cmp(&b.id)));
        self.recorded().objects = objects;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: every third of 30 views has a picture, and all of 5.
    #[test]
    fn pictures_are_spread_over_the_views() {
        let of = |n: usize| (0..n).filter(|at| has_picture(*at, n)).collect::<Vec<_>>();
        assert_eq!(of(30), [0, 3, 6, 9, 12, 15, 18, 21, 24, 27]);
        assert_eq!(of(5), [0, 1, 2, 3, 4]);
        assert!(of(0).is_empty());
    }
}
