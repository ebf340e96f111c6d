//! The time that a fleet takes.

use std::collections::BinaryHeap;

use slag_encoder::encode::ViewCost;

/// What is to be done.
#[derive(Clone, Debug)]
pub struct Work {
    /// Seconds of a machine, and bytes that go to the bucket, by view, in the order of the photos.
    pub views: Vec<ViewCost>,
    /// Seconds of a machine by cell.
    pub cells_secs: Vec<f64>,
    /// Seconds of the coordinator alone, in which the machines wait.
    pub coordinator_secs: f64,
}

impl Work {
    /// Returns the same work with other models: views take `secs` on average, and differ by the same factors.
    pub fn with_view_secs(mut self, secs: f64) -> Self {
        let sum: f64 = self.views.iter().map(|view| view.secs).sum();
        let factor = secs * self.views.len() as f64 / sum.max(f64::MIN_POSITIVE);
        self.views.iter_mut().for_each(|view| view.secs *= factor);
        self
    }

    /// Returns the work of a scene with this many views: this one, over and over.
    pub fn repeated(&self, n_views: usize) -> Self {
        let times = n_views as f64 / self.views.len() as f64;
        let n_cells = (self.cells_secs.len() as f64 * times).ceil() as usize;
        Self {
            views: self.views.iter().copied().cycle().take(n_views).collect(),
            cells_secs: self.cells_secs.iter().copied().cycle().take(n_cells).collect(),
            coordinator_secs: self.coordinator_secs * times,
        }
    }
}

/// The network.
#[derive(Clone, Copy, Debug)]
pub struct Links {
    /// Bits per second between a machine and the bucket.
    pub worker_bits_per_s: f64,
    /// Bits per second between the coordinator and the bucket.
    pub coordinator_bits_per_s: f64,
    /// Seconds from one piece of work to the next.
    pub dispatch_secs: f64,
}

/// How views are handed out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Handing {
    /// To the machine that is free next, costly ones first.
    Queue,
    /// Batches of equal number, made beforehand.
    Batches,
}

/// A time as a key of a heap; the next one first.
#[derive(PartialEq)]
struct Next(f64);

impl Eq for Next {}

impl PartialOrd for Next {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Next {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        other.0.total_cmp(&self.0)
    }
}

/// Returns the seconds from command to publication with `n` machines.
pub fn wall_secs(work: &Work, links: &Links, n: usize, handing: Handing) -> f64 {
    let secs_of = |bytes: u64, bits_per_s: f64| bytes as f64 * 8.0 / bits_per_s;
    let view = |view: &ViewCost| view.secs + secs_of(view.len_bytes, links.worker_bits_per_s);
    let secs: Vec<f64> = work.views.iter().map(view).collect();
    let ends = match handing {
        Handing::Queue => queue(&secs, links.dispatch_secs, n),
        Handing::Batches => batches(&secs, n),
    };
    // The coordinator brings the views home as they come.
    let mut arrivals: Vec<(f64, u64)> =
        ends.into_iter().zip(work.views.iter().map(|view| view.len_bytes)).collect();
    arrivals.sort_by(|a, b| a.0.total_cmp(&b.0));
    let views_end = arrivals.into_iter().fold(0.0, |home: f64, (end, len_bytes)| {
        home.max(end) + secs_of(len_bytes, links.coordinator_bits_per_s)
    });
    let all_bytes: u64 = work.views.iter().map(|view| view.len_bytes).sum();
    let cell_bytes = all_bytes / (work.cells_secs.len() as u64).max(1);
    let cell = |secs: &f64| secs + secs_of(cell_bytes, links.worker_bits_per_s);
    let cells: Vec<f64> = work.cells_secs.iter().map(cell).collect();
    let cells_end = queue(&cells, links.dispatch_secs, n).into_iter().fold(0.0, f64::max);
    views_end + work.coordinator_secs + cells_end
}

/// Returns the end of each task, where the machine that is free next takes the costliest one left.
fn queue(secs: &[f64], dispatch_secs: f64, n: usize) -> Vec<f64> {
    let mut order: Vec<usize> = (0..secs.len()).collect();
    order.sort_by(|a, b| secs[*b].total_cmp(&secs[*a]));
    let mut free: BinaryHeap<Next> = (0..n).map(|_| Next(0.0)).collect();
    let mut ends = vec![0.0; secs.len()];
    for task in order {
        let Some(Next(start)) = free.pop() else { break };
        ends[task] = start + dispatch_secs + secs[task];
        free.push(Next(ends[task]));
    }
    ends
}

/// Returns the end of each task, where machine i does the i-th of n runs of tasks.
fn batches(secs: &[f64], n: usize) -> Vec<f64> {
    let mut ends = Vec::with_capacity(secs.len());
    for machine in 0..n {
        let range = machine * secs.len() / n..(machine + 1) * secs.len() / n;
        ends.extend(secs[range].iter().scan(0.0, |now, secs| {
            *now += secs;
            Some(*now)
        }));
    }
    ends
}
