//! An encode that is watched: what it does now, its views and cells, the time spent so far, and pictures of masks. The page of
//! `encode --view` asks for it, and the report of `encode --report` keeps some of it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::DVec3;
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use serde::Serialize;
use slag_common::View;
use slag_common::frames::Aabb;

use crate::progress::{FoundObject, Progress, ViewEvent};

/// Pictures of the last masks that are kept for the page.
const N_LAST: usize = 6;
/// Time between two of them: drawing one takes milliseconds of a thread that has better to do.
const PAUSE: Duration = Duration::from_secs(1);
/// Time after which nobody is taken to look any more.
const LOOKED_AT_FOR: Duration = Duration::from_secs(10);
/// Pictures of masks in a report.
const N_IN_REPORT: usize = 12;
/// JPEG's quality of the pictures.
const QUALITY: u8 = 80;

/// A view of the encode.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WatchedView {
    /// Its name.
    pub name: String,
    /// Where it was taken, world.
    pub position_m: DVec3,
    /// What became of it.
    pub state: ViewState,
    /// Its masks, once they are found.
    pub n_masks: Option<usize>,
    /// Why it is left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// What became of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ViewState {
    /// Nothing yet.
    Waiting,
    /// Its masks are found.
    Segmented,
    /// Its contributions are kept.
    Done,
    /// It is left out.
    LeftOut,
}

/// A part of the run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WatchedPhase {
    /// Its name.
    pub phase: &'static str,
    /// Seconds so far.
    pub secs: f64,
}

/// What is counted now.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counted {
    /// The stage.
    pub stage: String,
    /// What is counted.
    pub unit: String,
    /// How many there are.
    pub total: u64,
    /// How many are done.
    pub done: u64,
}

/// The masks of a photo, drawn.
#[derive(Clone)]
pub struct Picture {
    /// Counts up.
    pub number: usize,
    /// Name of the view.
    pub view: String,
    /// Its masks.
    pub n_masks: usize,
    /// JPEG.
    pub jpeg: Arc<[u8]>,
}

/// The state of an encode.
#[derive(Clone, Debug, Serialize)]
pub struct Work {
    /// How it ended: published, or the error; absent while it is at work.
    pub ended: Option<String>,
    /// Seconds since it began.
    pub secs: f64,
    /// What is counted now.
    pub counted: Counted,
    /// The parts of the run, the present one last.
    pub phases: Vec<WatchedPhase>,
    /// Seconds that views spent in each stage, added over threads.
    pub busy_secs: BTreeMap<&'static str, f64>,
    /// The views, in the order in which they are taken.
    pub views: Vec<WatchedView>,
    /// Boxes around the means of the cells.
    pub cells: Vec<Aabb>,
    /// Numbers, views and masks of the last pictures, the last one first.
    pub pictures: Vec<(usize, String, usize)>,
}

#[derive(Default)]
struct State {
    ended: Option<(String, Instant)>,
    counted: Counted,
    phases: Vec<(&'static str, Instant)>,
    busy_secs: BTreeMap<&'static str, f64>,
    views: Vec<WatchedView>,
    /// Places in `views`, by name.
    at: BTreeMap<String, usize>,
    cells: Vec<Aabb>,
    pictures: Vec<Picture>,
    n_pictures: usize,
    /// When the last picture was drawn, and when the last one was asked for.
    drawn: Option<Instant>,
    asked: Option<Instant>,
    of_report: Vec<Picture>,
    objects: Vec<FoundObject>,
}

/// Receives the progress of an encode, beside the terminal.
pub struct Watch {
    start: Instant,
    for_report: bool,
    state: Mutex<State>,
}

impl Watch {
    /// Begins to watch. `for_report`: keeps pictures of masks evenly spread over the views, whether or not a page looks.
    pub fn new(for_report: bool) -> Self {
        Self { start: Instant::now(), for_report, state: Mutex::default() }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns a receiver that tells this one and another.
    pub fn beside<'a>(&'a self, other: &'a dyn Progress) -> impl Progress + 'a {
        Both(self, other)
    }

    /// Tells how the encode ended.
    pub fn end_with(&self, how: String) {
        self.state().ended = Some((how, Instant::now()));
    }

    /// Returns the state of the encode, for a page that goes on looking.
    pub fn look(&self) -> Work {
        let now = Instant::now();
        let mut state = self.state();
        state.asked = Some(now);
        let end = state.ended.as_ref().map_or(now, |(_, at)| *at);
        let ends = state.phases.iter().skip(1).map(|(_, began)| *began).chain([end]);
        let phases = state.phases.iter().zip(ends).map(|((phase, began), ended)| WatchedPhase {
            phase,
            secs: ended.duration_since(*began).as_secs_f64(),
        });
        Work {
            ended: state.ended.as_ref().map(|(how, _)| how.clone()),
            secs: end.duration_since(self.start).as_secs_f64(),
            counted: state.counted.clone(),
            phases: phases.collect(),
            busy_secs: state.busy_secs.clone(),
            views: state.views.clone(),
            cells: state.cells.clone(),
            pictures: state.pictures.iter().rev().map(|p| (p.number, p.view.clone(), p.n_masks)).collect(),
        }
    }

    /// Returns one of the last pictures, JPEG.
    pub fn picture(&self, number: usize) -> Option<Arc<[u8]>> {
        self.state().pictures.iter().find(|picture| picture.number == number).map(|p| Arc::clone(&p.jpeg))
    }

    /// Returns the things that were found, the largest first; only for a report.
    pub fn found_objects(&self) -> Vec<FoundObject> {
        let mut objects = self.state().objects.clone();
        objects.sort_by(|a, b| b.n_gaussians.cmp(&a.n_gaussians).then_with(|| a.id.cmp(&b.id)));
        objects
    }

    /// Returns the pictures for the report, in the order of their views' names.
    pub fn pictures_of_report(&self) -> Vec<Picture> {
        let mut pictures = self.state().of_report.clone();
        pictures.sort_by(|a, b| a.view.cmp(&b.view));
        pictures
    }
}

/// Returns whether view `at` of `n` is one of those with a picture in the report.
fn is_in_report(at: usize, n: usize) -> bool {
    at.is_multiple_of(n.div_ceil(N_IN_REPORT).max(1))
}

fn jpeg(picture: &RgbImage) -> Option<Arc<[u8]>> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, QUALITY).encode_image(picture).ok()?;
    Some(bytes.into())
}

impl Progress for Watch {
    fn begin(&self, stage: &str, unit: &str, total: u64, done: u64) {
        self.state().counted = Counted { stage: stage.into(), unit: unit.into(), total, done };
    }

    fn advance(&self, n: u64) {
        self.state().counted.done += n;
    }

    fn end(&self) {}

    fn plan(&self, views: &[(&View, bool)], cells: &[Aabb]) {
        let watched = |(view, is_done): &(&View, bool)| WatchedView {
            name: view.name.clone(),
            position_m: view.position_in_world(),
            state: if *is_done { ViewState::Done } else { ViewState::Waiting },
            n_masks: None,
            reason: None,
        };
        let mut state = self.state();
        state.views = views.iter().map(watched).collect();
        state.at = state.views.iter().enumerate().map(|(at, view)| (view.name.clone(), at)).collect();
        state.cells = cells.to_vec();
    }

    fn begin_phase(&self, name: &'static str) {
        self.state().phases.push((name, Instant::now()));
    }

    fn spend(&self, stage: &'static str, secs: f64) {
        *self.state().busy_secs.entry(stage).or_default() += secs;
    }

    fn objects(&self, objects: &mut dyn Iterator<Item = FoundObject>) {
        if self.for_report {
            self.state().objects = objects.collect();
        }
    }

    fn view(&self, name: &str, event: ViewEvent<'_>) {
        let mut state = self.state();
        let Some(at) = state.at.get(name).copied() else { return };
        let n_views = state.views.len();
        let view = &mut state.views[at];
        let (n_masks, draw) = match event {
            ViewEvent::Done => return view.state = ViewState::Done,
            ViewEvent::LeftOut { reason } => {
                view.state = ViewState::LeftOut;
                view.reason = Some(reason);
                return;
            }
            ViewEvent::Segmented { n_masks, draw } => (n_masks, draw),
        };
        view.state = ViewState::Segmented;
        view.n_masks = Some(n_masks);
        let is_looked_at = state.asked.is_some_and(|at| at.elapsed() < LOOKED_AT_FOR);
        let for_page = is_looked_at && state.drawn.is_none_or(|at| at.elapsed() >= PAUSE);
        let for_report = self.for_report && is_in_report(at, n_views);
        if !for_page && !for_report {
            return;
        }
        state.drawn = if for_page { Some(Instant::now()) } else { state.drawn };
        // Others go on while this thread draws.
        drop(state);
        let Some(jpeg) = jpeg(&draw()) else { return };
        let mut state = self.state();
        state.n_pictures += 1;
        let picture = Picture { number: state.n_pictures, view: name.to_owned(), n_masks, jpeg };
        if for_report {
            state.of_report.push(picture.clone());
        }
        if for_page {
            state.pictures.push(picture);
            let n_old = state.pictures.len().saturating_sub(N_LAST);
            state.pictures.drain(..n_old);
        }
    }
}

/// Two receivers.
struct Both<'a>(&'a Watch, &'a dyn Progress);

impl Progress for Both<'_> {
    fn begin(&self, stage: &str, unit: &str, total: u64, done: u64) {
        self.0.begin(stage, unit, total, done);
        self.1.begin(stage, unit, total, done);
    }

    fn advance(&self, n: u64) {
        self.0.advance(n);
        self.1.advance(n);
    }

    fn end(&self) {
        self.0.end();
        self.1.end();
    }

    fn plan(&self, views: &[(&View, bool)], cells: &[Aabb]) {
        self.0.plan(views, cells);
    }

    fn begin_phase(&self, name: &'static str) {
        self.0.begin_phase(name);
    }

    fn spend(&self, stage: &'static str, secs: f64) {
        self.0.spend(stage, secs);
    }

    fn view(&self, name: &str, event: ViewEvent<'_>) {
        self.0.view(name, event);
    }

    fn objects(&self, objects: &mut dyn Iterator<Item = FoundObject>) {
        self.0.objects(objects);
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use glam::DAffine3;
    use slag_common::{Distortion, Intrinsics};

    use super::*;
    use crate::progress::Silent;

    fn views(n: usize) -> Vec<View> {
        let intrinsics = Intrinsics {
            width_px: 8,
            height_px: 8,
            focal_x_px: 8.0,
            focal_y_px: 8.0,
            centre_x_px: 4.0,
            centre_y_px: 4.0,
            distortion: Distortion::None,
        };
        let view = |at: usize| View {
            name: format!("{at:03}"),
            image_path: format!("{at}").into(),
            intrinsics,
            camera_from_world: DAffine3::from_translation(DVec3::new(-(at as f64), 0.0, 0.0)),
        };
        (0..n).map(view).collect()
    }

    #[test]
    fn pictures_are_drawn_for_those_who_look() {
        let n_drawn = Cell::new(0);
        let all = views(30);
        let segment_all = |watch: &Watch| {
            let planned: Vec<(&View, bool)> = all.iter().map(|view| (view, view.name == "029")).collect();
            let both = watch.beside(&Silent);
            both.begin_phase("views");
            both.plan(&planned, &[]);
            for view in &all[..29] {
                let draw = || {
                    n_drawn.set(n_drawn.get() + 1);
                    RgbImage::new(4, 4)
                };
                both.view(&view.name, ViewEvent::Segmented { n_masks: 7, draw: &draw });
            }
            both.view("000", ViewEvent::Done);
            both.view("001", ViewEvent::LeftOut { reason: "dark".into() });
            both.spend("decode", 0.25);
            both.spend("decode", 0.5);
        };
        let unseen = Watch::new(false);
        segment_all(&unseen);
        assert_eq!(n_drawn.replace(0), 0, "nobody looks");
        let work = unseen.look();
        assert_eq!((work.busy_secs["decode"], work.phases[0].phase, work.ended), (0.75, "views", None));
        let state = |at: usize| (work.views[at].state, work.views[at].n_masks);
        assert_eq!(state(0), (ViewState::Done, Some(7)));
        assert_eq!(state(1), (ViewState::LeftOut, Some(7)));
        assert_eq!(work.views[1].reason.as_deref(), Some("dark"));
        assert_eq!((state(2), state(29)), ((ViewState::Segmented, Some(7)), (ViewState::Done, None)));
        assert_eq!(work.views[3].position_m, DVec3::new(3.0, 0.0, 0.0));
        // One a second at most, and only now that the page has looked.
        segment_all(&unseen);
        assert_eq!((n_drawn.replace(0), unseen.look().pictures.len()), (1, 1));
        let number = unseen.look().pictures[0].0;
        assert!(unseen.picture(number).is_some_and(|jpeg| jpeg.starts_with(&[0xff, 0xd8])));
        assert!(unseen.picture(number + 1).is_none());
        // Of 30 views every third.
        let reported = Watch::new(true);
        segment_all(&reported);
        let names: Vec<String> = reported.pictures_of_report().into_iter().map(|p| p.view).collect();
        assert_eq!(names, ["000", "003", "006", "009", "012", "015", "018", "021", "024", "027"]);
    }
}
