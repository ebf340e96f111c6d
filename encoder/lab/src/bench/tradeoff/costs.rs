//! The costs of a setting by the size of a scene.

use super::figures::Figures;

/// What a setting costs by the size of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FrontCosts {
    /// Seconds of the views, per photo of the scene.
    pub(super) seconds_per_view: f64,
    /// All other seconds, per million Gaussians.
    pub(super) seconds_per_million_gaussians: f64,
    /// Bytes per Gaussian.
    pub(super) bytes_per_gaussian: f64,
}

impl FrontCosts {
    /// Returns the costs of a measured point.
    pub(super) fn of(f: &Figures) -> Self {
        let of_views = f.views_seconds + f.coverage_seconds;
        Self {
            seconds_per_view: of_views / f.n_photos.max(1) as f64,
            seconds_per_million_gaussians: (f.seconds - of_views).max(0.0)
                / (f.n_gaussians.max(1) as f64 / 1e6),
            bytes_per_gaussian: f.bytes_per_gaussian,
        }
    }

    /// Returns the mean; `None` without any.
    pub(super) fn mean(all: &[Self]) -> Option<Self> {
        let mean = |of: fn(&Self) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
        (!all.is_empty()).then(|| Self {
            seconds_per_view: mean(|c| c.seconds_per_view),
            seconds_per_million_gaussians: mean(|c| c.seconds_per_million_gaussians),
            bytes_per_gaussian: mean(|c| c.bytes_per_gaussian),
        })
    }

    /// Returns the seconds of a scene of this size.
    pub(super) fn seconds(&self, n_photos: u64, n_gaussians: u64) -> f64 {
        self.seconds_per_view * n_photos as f64
            + self.seconds_per_million_gaussians * n_gaussians as f64 / 1e6
    }
}
