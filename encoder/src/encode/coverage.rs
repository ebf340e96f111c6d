//! Which views to take first: those that together show the most of the scene, known before any mask is paid for.
//!
//! A raster of low resolution gives the blending weight `a(k, v) = Σ_p alpha T` of each Gaussian `k` over a view `v`
//! without its margin, where the photo's edge cuts things off. It is the visible solid angle: it falls with the square
//! of the distance, with the cosine of the angle, and with occlusion. It is squared, relative to the Gaussian's best
//! view: the lift weighs a view by it, and the view's crops are as much finer. A set of views `S` is worth
//!
//! ```text
//! f(S) = Σ_k g(Σ_{v in S} q(k, v))     q(k, v) = (a(k, v) / max_v a(k, v))^2     g(x) = ln(1 + s x)
//! ```
//!
//! `f` is monotone and submodular, because `g` is increasing and concave: the first `n` views of the greedy order are
//! worth at least `1 - 1/e` of the best `n`, for every `n` (Nemhauser, Wolsey and Fisher 1978). Gains only fall, so
//! most need not be computed again (Minoux 1978). Contributions are integers, so the order does not depend on threads;
//! equal gains go by the views' names.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;
use serde::Serialize;

use crate::masks::{NO_REGION, RegionMap};
use crate::raster::{LoadedScene, RasterError, RasterView};

/// Width of the raster, pixels: a Gaussian smaller than its pixel is smaller than any mask.
const WIDTH_PX: u32 = 192;
/// As a share of the view's width and height.
const MARGIN: f64 = 0.05;
/// Most pairs of a Gaussian and a view, 8 bytes each; larger scenes use every n-th Gaussian.
const MAX_PAIRS: usize = 1 << 26;
const MAX_GAUSSIANS: usize = 1 << 17;
/// Steps of a quality of 1. Less than half a step, a twentieth of the best view, does not show a Gaussian.
const QUALITY_STEPS: f32 = 255.0;
/// Sums of qualities above this, 257 best views, gain nothing more.
const MAX_SUM: usize = u16::MAX as usize;
/// `s` of `g`: how fast the gain of similar views falls.
const STEEPNESS: f64 = 2.0;
/// Steps of `g` = 1; at [`MAX_SUM`] a step of quality is still 2^8 of them.
const GAIN_STEPS: f64 = (1 << 24) as f64;

#[derive(Clone, Debug)]
pub struct Coverage {
    n_gaussians: usize,
    /// By view: its Gaussians, and their qualities in steps.
    views: Vec<(Vec<u32>, Vec<u8>)>,
    /// `g` by the sum of qualities, in steps of both.
    gain_of_sum: Vec<u32>,
}

/// What a choice of views shows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CoverageReport {
    /// Its worth relative to that of all views, 0 to 1.
    pub coverage: f64,
    /// Gaussians that it shows, of those that any view shows, 0 to 1.
    pub seen: f64,
}

impl Coverage {
    /// `None` if cancelled.
    pub fn measure(
        scene: &dyn LoadedScene,
        n_gaussians: usize,
        views: &[RasterView],
        cancel: &AtomicBool,
    ) -> Result<Option<Self>, (usize, RasterError)> {
        let n_counted = MAX_GAUSSIANS.min(MAX_PAIRS / views.len().max(1)).max(1);
        let stride = n_gaussians.div_ceil(n_counted).max(1) as u32;
        let seen = views.par_iter().enumerate().map(|(number, view)| {
            if cancel.load(Ordering::Relaxed) {
                return Ok(None);
            }
            weights(scene, view, stride).map(Some).map_err(|source| (number, source))
        });
        // Of several errors, the first view's, so that the result does not depend on threads.
        let seen: Vec<_> = seen.collect::<Vec<_>>().into_iter().collect::<Result<_, _>>()?;
        let Some(seen) = seen.into_iter().collect::<Option<Vec<_>>>() else { return Ok(None) };
        Ok(Some(Self::new(n_gaussians.div_ceil(stride as usize), seen)))
    }

    /// Turns each view's weights of Gaussians below `n_gaussians` into qualities.
    fn new(n_gaussians: usize, weights: Vec<Vec<(u32, f32)>>) -> Self {
        let mut best = vec![0.0f32; n_gaussians];
        weights.iter().flatten().for_each(|(k, a)| best[*k as usize] = best[*k as usize].max(*a));
        let quality = |k: u32, a: f32| ((a / best[k as usize]).powi(2) * QUALITY_STEPS).round() as u8;
        let views = weights.into_iter().map(|of_view| {
            let kept = of_view.into_iter().map(|(k, a)| (k, quality(k, a))).filter(|(_, q)| *q > 0);
            kept.unzip()
        });
        let views = views.collect();
        let mut gain_of_sum = vec![0u32];
        let mut step = u32::MAX;
        for sum in 1..=MAX_SUM {
            let exact = GAIN_STEPS * (STEEPNESS * sum as f64 / f64::from(QUALITY_STEPS)).ln_1p();
            // Rounding must not increase a step: the guarantee needs concave g.
            step = step.min(exact.round() as u32 - gain_of_sum[sum - 1]);
            gain_of_sum.push(gain_of_sum[sum - 1] + step);
        }
        Self { n_gaussians, views, gain_of_sum }
    }

    /// Orders all views greedily by gain.
    pub fn order(&self) -> Vec<usize> {
        let mut contributions = vec![0u16; self.n_gaussians];
        let first: Vec<u64> = self.views.par_iter().map(|view| self.gain(&contributions, view)).collect();
        // (gain, earliest name, number of chosen views when the gain was computed)
        let mut heap: BinaryHeap<_> =
            first.into_iter().enumerate().map(|(view, gain)| (gain, Reverse(view), 0)).collect();
        let mut order = Vec::with_capacity(self.views.len());
        while let Some((_, Reverse(view), n_chosen)) = heap.pop() {
            if n_chosen < order.len() {
                heap.push((self.gain(&contributions, &self.views[view]), Reverse(view), order.len()));
                continue;
            }
            order.push(view);
            self.add(&mut contributions, view);
        }
        order
    }

    /// Compares what the chosen views show with what all views show.
    pub fn report(&self, chosen: impl IntoIterator<Item = usize>) -> CoverageReport {
        let worth = |views: &mut dyn Iterator<Item = usize>| {
            let mut contributions = vec![0u16; self.n_gaussians];
            views.for_each(|view| self.add(&mut contributions, view));
            let worth: u64 =
                contributions.iter().map(|sum| u64::from(self.gain_of_sum[usize::from(*sum)])).sum();
            (worth as f64, contributions.iter().filter(|sum| **sum > 0).count() as f64)
        };
        let all = worth(&mut (0..self.views.len()));
        let reached = worth(&mut chosen.into_iter());
        // A scene that no view shows counts as covered.
        let share = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 1.0 };
        CoverageReport { coverage: share(reached.0, all.0), seen: share(reached.1, all.1) }
    }

    fn gain(&self, contributions: &[u16], (gaussians, qualities): &(Vec<u32>, Vec<u8>)) -> u64 {
        let gain = |(k, q): (&u32, &u8)| {
            let sum = usize::from(contributions[*k as usize]);
            let more = (sum + usize::from(*q)).min(MAX_SUM);
            u64::from(self.gain_of_sum[more] - self.gain_of_sum[sum])
        };
        gaussians.iter().zip(qualities).map(gain).sum()
    }

    fn add(&self, contributions: &mut [u16], view: usize) {
        let (gaussians, qualities) = &self.views[view];
        for (k, q) in gaussians.iter().zip(qualities) {
            let sum = &mut contributions[*k as usize];
            *sum = sum.saturating_add(u16::from(*q));
        }
    }
}

/// Weights within the margin of every `stride`-th visible Gaussian, numbered in strides.
fn weights(scene: &dyn LoadedScene, view: &RasterView, stride: u32) -> Result<Vec<(u32, f32)>, RasterError> {
    let intrinsics = view.intrinsics.without_distortion();
    let intrinsics = intrinsics.scaled_to_width(WIDTH_PX.min(intrinsics.width_px));
    let view = RasterView { camera_from_world: view.camera_from_world, intrinsics };
    let inner = inner(intrinsics.width_px, intrinsics.height_px);
    let weights = scene.weights(&view, &inner)?.entries;
    let counted = weights.into_iter().filter(|entry| entry.gaussian.is_multiple_of(stride));
    Ok(counted.map(|entry| (entry.gaussian / stride, entry.weight)).collect())
}

/// A raster with one region: all pixels but the margin.
fn inner(width_px: u32, height_px: u32) -> RegionMap {
    let is_inner = |at: u32, n: u32| {
        let margin = (MARGIN * f64::from(n)) as u32;
        (margin..n - margin).contains(&at)
    };
    let region = |x, y| if is_inner(x, width_px) && is_inner(y, height_px) { 0 } else { NO_REGION };
    let region_of_pixel = (0..height_px).flat_map(|y| (0..width_px).map(move |x| region(x, y))).collect();
    RegionMap { width_px, height_px, n_regions: 1, region_of_pixel }
}

/// Numbers below `n`, ordered so that every prefix is about evenly spread: by reversed bits (van der Corput 1935).
pub(crate) fn spread_order(n: usize) -> Vec<usize> {
    let n_bits = n.next_power_of_two().trailing_zeros();
    let reversed = |i: usize| i.reverse_bits().checked_shr(usize::BITS - n_bits).unwrap_or(0);
    (0..n.next_power_of_two()).map(reversed).filter(|i| *i < n).collect()
}

#[cfg(test)]
mod tests {
    use slag_common::Gaussians;
    use slag_math::random::Random;

    use super::*;
    use crate::raster::{CpuRasterizer, Rasterizer, pinhole};

    fn small(random: &mut Random, n_views: usize, n_gaussians: usize) -> Vec<Vec<(u32, f32)>> {
        let mut view = || {
            let seen = (0..n_gaussians as u32).filter(|_| random.unit() < 0.4).collect::<Vec<_>>();
            seen.into_iter().map(|k| (k, (0.05 + random.unit()) as f32)).collect()
        };
        (0..n_views).map(|_| view()).collect()
    }

    fn worth(weights: &[Vec<(u32, f32)>], n_gaussians: usize, chosen: &[usize]) -> f64 {
        let mut best = vec![0.0f64; n_gaussians];
        weights.iter().flatten().for_each(|(k, a)| best[*k as usize] = best[*k as usize].max((*a).into()));
        let mut contributions = vec![0.0; n_gaussians];
        for (k, a) in chosen.iter().flat_map(|view| &weights[*view]) {
            contributions[*k as usize] += (f64::from(*a) / best[*k as usize]).powi(2);
        }
        contributions.iter().map(|sum: &f64| (STEEPNESS * sum).ln_1p()).sum()
    }

    /// Oracle: every set of n views, and the definition in f64. The bound of Nemhauser, Wolsey and Fisher holds for
    /// every n, and each step is the best one but for the tables' steps.
    #[test]
    fn the_order_keeps_the_guarantee() {
        let mut random = Random::new(1);
        let bound = 1.0 - (-1.0f64).exp();
        let mut least = f64::MAX;
        for _ in 0..40 {
            let (n_views, n_gaussians) = (9, 30);
            let weights = small(&mut random, n_views, n_gaussians);
            let order = Coverage::new(n_gaussians, weights.clone()).order();
            let mut sorted = order.clone();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..n_views).collect::<Vec<_>>());
            for n in 1..=n_views {
                let sets = (0u32..1 << n_views).filter(|set| set.count_ones() as usize == n);
                let of_set = |set: u32| (0..n_views).filter(|v| set >> v & 1 == 1).collect::<Vec<_>>();
                let best = sets.map(|set| worth(&weights, n_gaussians, &of_set(set))).fold(0.0, f64::max);
                let reached = worth(&weights, n_gaussians, &order[..n]);
                least = least.min(reached / best);
                assert!(reached >= bound * best, "{n}: {reached} of {best}");
                let before = &order[..n - 1];
                let with = |view| worth(&weights, n_gaussians, &[before, &[view]].concat());
                let steepest = order[n - 1..].iter().map(|view| with(*view)).fold(0.0, f64::max);
                let holds = reached >= steepest - (n * n_gaussians) as f64 / f64::from(QUALITY_STEPS);
                assert!(holds, "{n}: not greedy");
            }
        }
        // Greedy is far above the bound; a random order is not.
        assert!(least > 0.9, "{least}");
    }

    /// Lazy evaluation gives the order of computing every gain anew, ties included.
    #[test]
    fn lazy_is_plain_greedy() {
        let mut random = Random::new(2);
        for _ in 0..30 {
            let mut weights = small(&mut random, 24, 60);
            // Ties: views that see the same.
            weights[20] = weights[3].clone();
            weights[7] = weights[3].clone();
            let coverage = Coverage::new(60, weights);
            let (mut contributions, mut left, mut plain) =
                (vec![0u16; 60], (0..24).collect::<Vec<_>>(), Vec::new());
            while !left.is_empty() {
                let gains: Vec<u64> =
                    left.iter().map(|view| coverage.gain(&contributions, &coverage.views[*view])).collect();
                let most = gains.iter().max().expect("some are left");
                let view = left.remove(gains.iter().position(|gain| gain == most).expect("it is there"));
                coverage.add(&mut contributions, view);
                plain.push(view);
            }
            assert_eq!(coverage.order(), plain);
        }
    }

    /// The guarantee needs this of the table.
    #[test]
    fn gains_grow_and_never_faster() {
        let coverage = Coverage::new(0, Vec::new());
        let steps: Vec<u32> = coverage.gain_of_sum.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(steps.is_sorted_by(|a, b| a >= b));
        let at =
            |x: f64| f64::from(coverage.gain_of_sum[(x * f64::from(QUALITY_STEPS)) as usize]) / GAIN_STEPS;
        for x in [0.2, 1.0, 2.0, 40.0, 257.0] {
            assert!((at(x) - (STEEPNESS * x).ln_1p()).abs() < 1e-3, "{x}: {}", at(x));
        }
    }

    /// A wall in front of another: views of the front wall near, far and aslant, and one from behind. Only that one
    /// shows the hidden wall, so it is second; near comes before far and aslant.
    #[test]
    fn occlusion_distance_and_angle_count() {
        let place = |i: i32| {
            [f64::from(i % 20) * 0.1 - 0.95, f64::from(i / 20 % 20) * 0.1 - 0.95, f64::from(i / 400)]
        };
        let mut scene = Gaussians::balls((0..800).map(|i| place(i).into()).collect(), 0.06);
        scene.scales.fill([0.06, 0.06, 0.002]);
        scene.opacities.fill(0.99);
        let intrinsics = pinhole([640, 480], 500.0);
        let at = |eye: [f64; 3]| RasterView {
            camera_from_world: glam::DAffine3::from_mat4(glam::DMat4::look_at_rh(
                eye.into(),
                glam::DVec3::new(0.0, 0.0, 0.5),
                glam::DVec3::Y,
            )),
            intrinsics,
        };
        // OpenGL looks along -z with y up; OpenCV along z with y down.
        let flip = glam::DAffine3::from_scale(glam::DVec3::new(1.0, -1.0, -1.0));
        let at = |eye| RasterView { camera_from_world: flip * at(eye).camera_from_world, ..at(eye) };
        let views = [at([0.0, 0.0, -8.0]), at([5.0, 0.0, -2.0]), at([0.0, 0.0, -3.0]), at([0.0, 0.0, 4.2])];
        let loaded = CpuRasterizer.load(&scene).expect("loads");
        let cancel = AtomicBool::new(false);
        let coverage = Coverage::measure(loaded.as_ref(), scene.len(), &views, &cancel)
            .expect("rasterises")
            .expect("not cancelled");
        let order = coverage.order();
        assert_eq!(order[..2], [2, 3], "{order:?}: near, then from behind");
        assert_eq!(coverage.report([2, 3, 0, 1]), CoverageReport { coverage: 1.0, seen: 1.0 });
        let half = coverage.report([2]);
        assert!(half.seen > 0.4 && half.seen < 0.75 && half.coverage < 0.7, "{half:?}");
        cancel.store(true, Ordering::Relaxed);
        let cancelled = Coverage::measure(loaded.as_ref(), scene.len(), &views, &cancel);
        assert!(cancelled.expect("no error").is_none());
    }

    /// By hand: a twentieth of 100 and of 40 pixels on either side.
    #[test]
    fn the_margin_is_left_out() {
        let map = inner(100, 40);
        let is_inner = |x: usize, y: usize| map.region_of_pixel[y * 100 + x] == 0;
        assert_eq!(map.region_of_pixel.iter().filter(|region| **region == 0).count(), 90 * 36);
        assert!(is_inner(5, 2) && is_inner(94, 37));
        assert!(!is_inner(4, 20) && !is_inner(95, 20) && !is_inner(50, 1) && !is_inner(50, 38));
        assert!(inner(1, 1).region_of_pixel == [0]);
    }

    #[test]
    fn spread_orders_are_spread() {
        assert_eq!(spread_order(0), [0; 0]);
        assert_eq!(spread_order(1), [0]);
        assert_eq!(spread_order(8), [0, 4, 2, 6, 1, 5, 3, 7]);
        for n in [2usize, 5, 7, 96, 100] {
            let order = spread_order(n);
            let mut sorted = order.clone();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..n).collect::<Vec<_>>());
            for taken in 1..=n {
                let mut taken = order[..taken].to_vec();
                taken.sort_unstable();
                let widest = taken.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap_or(0);
                assert!(widest * taken.len() <= 4 * n, "{n}: {taken:?}");
            }
        }
    }
}
