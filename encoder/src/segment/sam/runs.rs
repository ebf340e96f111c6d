//! Masks as runs of pixels, which keeps thousands of candidates small.

use slag_math::union_find::{Numbering, UnionFind};

use crate::masks::{Bits, BoxPx, Mask};

/// Pixels `x0 <= x < x1` of row `y`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Run {
    pub(super) y: u32,
    pub(super) x0: u32,
    pub(super) x1: u32,
}

/// A set of pixels: disjoint runs in row-major order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct RunMask {
    runs: Vec<Run>,
    pub(super) box_px: BoxPx,
    pub(super) area_px: u32,
}

impl RunMask {
    /// `None` without runs.
    pub(super) fn new(runs: Vec<Run>) -> Option<Self> {
        let (first, last) = (runs.first()?, runs.last()?);
        let x0 = runs.iter().map(|run| run.x0).min()?;
        let x1 = runs.iter().map(|run| run.x1).max()?;
        let box_px = BoxPx { x0, y0: first.y, x1, y1: last.y + 1 };
        let area_px = runs.iter().map(|run| run.x1 - run.x0).sum();
        Some(Self { runs, box_px, area_px })
    }

    pub(super) fn len_bytes(&self) -> u64 {
        size_of_val(&self.runs[..]) as u64
    }

    pub(super) fn to_mask(&self, level: u8) -> Mask {
        let mut inside = Bits::of(false, self.box_px.area_px() as usize);
        for run in &self.runs {
            (run.x0..run.x1).for_each(|x| inside.set(self.box_px.place_of(x, run.y), true));
        }
        Mask { box_px: self.box_px, inside, area_px: self.area_px, level }
    }

    pub(super) fn iou(&self, other: &Self) -> f64 {
        let both_px = self.intersection_px(other);
        let areas_px = u64::from(self.area_px) + u64::from(other.area_px);
        both_px as f64 / (areas_px - both_px) as f64
    }

    pub(super) fn intersection_px(&self, other: &Self) -> u64 {
        let (mut a, mut b) = (self.runs.iter().peekable(), other.runs.iter().peekable());
        let mut both_px = 0_u64;
        while let (Some(p), Some(q)) = (a.peek(), b.peek()) {
            if p.y == q.y {
                both_px += u64::from(p.x1.min(q.x1).saturating_sub(p.x0.max(q.x0)));
            }
            if (p.y, p.x1) <= (q.y, q.x1) {
                a.next()
            } else {
                b.next()
            };
        }
        both_px
    }

    /// Fills holes, then removes islands, of fewer than `min_px` pixels, but keeps the largest island. Pixels that
    /// touch at a corner are connected. `None` if no hole or island is small.
    pub(super) fn without_small_regions(&self, width_px: u32, height_px: u32, min_px: u32) -> Option<Self> {
        let is_small = |size_px: &u64| *size_px < u64::from(min_px);
        let outside = complement(&self.runs, width_px, height_px);
        let hole_of = components(&outside);
        let left = outside.iter().zip(&hole_of.of_run);
        let left = left.filter(|(_, component)| !is_small(&hole_of.sizes_px[**component as usize]));
        let left: Vec<Run> = left.map(|(run, _)| *run).collect();
        let filled = complement(&left, width_px, height_px);

        let island_of = components(&filled);
        if !hole_of.sizes_px.iter().any(is_small) && !island_of.sizes_px.iter().any(is_small) {
            return None;
        }
        // If all islands are small, the first of the largest ones.
        let most_px = island_of.sizes_px.iter().copied().max().filter(is_small);
        let spared = island_of.sizes_px.iter().position(|size_px| Some(*size_px) == most_px);
        let stays = |component: usize| Some(component) == spared || !is_small(&island_of.sizes_px[component]);
        let kept = filled.iter().zip(&island_of.of_run).filter(|(_, component)| stays(**component as usize));
        Self::new(kept.map(|(run, _)| *run).collect())
    }
}

fn complement(runs: &[Run], width_px: u32, height_px: u32) -> Vec<Run> {
    let mut gaps = Vec::new();
    let mut runs = runs.iter().peekable();
    for y in 0..height_px {
        let mut x0 = 0;
        while let Some(run) = runs.next_if(|run| run.y == y) {
            if x0 < run.x0 {
                gaps.push(Run { y, x0, x1: run.x0 });
            }
            x0 = run.x1;
        }
        if x0 < width_px {
            gaps.push(Run { y, x0, x1: width_px });
        }
    }
    gaps
}

struct Components {
    /// By run, numbered in the order of a row-major scan.
    of_run: Vec<u32>,
    sizes_px: Vec<u64>,
}

/// Connected components of runs in row-major order; runs in neighbouring rows are connected if they overlap or touch at
/// a corner.
fn components(runs: &[Run]) -> Components {
    let mut sets = UnionFind::new(runs.len());
    let mut above = 0;
    for (at, run) in runs.iter().enumerate() {
        while (runs[above].y + 1 < run.y) || (runs[above].y + 1 == run.y && runs[above].x1 < run.x0) {
            above += 1;
        }
        let touching = runs[above..at].iter().enumerate();
        for (k, _) in touching.take_while(|(_, other)| other.y + 1 == run.y && other.x0 <= run.x1) {
            let (a, b) = (sets.root((above + k) as u32), sets.root(at as u32));
            sets.attach(a.max(b), a.min(b));
        }
    }
    let Numbering { of_item: of_run, sizes } = sets.number(0..runs.len() as u32);
    let mut sizes_px = vec![0; sizes.len()];
    runs.iter().zip(&of_run).for_each(|(run, n)| sizes_px[*n as usize] += u64::from(run.x1 - run.x0));
    Components { of_run, sizes_px }
}
