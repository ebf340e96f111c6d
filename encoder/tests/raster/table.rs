//! Rows of the table in NUMERICS.md: a range of inputs, and the error that is claimed for it.

use std::collections::{BTreeMap, BTreeSet};

use slag_common::Gaussians;
use slag_encoder::raster::{RasterView, ViewWeights, WeightKind};
use slag_encoder::segment::RegionMap;

use crate::backends::backends;
use crate::oracle::{self, Sums};

/// What is summed.
pub const KINDS: [WeightKind; 2] = [WeightKind::Blend, WeightKind::Falloff];

/// A view of a scene.
pub struct Case {
    pub scene: Gaussians,
    pub view: RasterView,
    pub regions: RegionMap,
    /// The same seen in a frame where float64 is exact, for the oracle.
    pub exact: Option<(Gaussians, RasterView)>,
    /// Gaussians that must be counted as unusable.
    pub n_unusable: usize,
}

impl Case {
    pub fn new(scene: Gaussians, view: RasterView, regions: RegionMap) -> Self {
        Self { scene, view, regions, exact: None, n_unusable: 0 }
    }
}

/// A row of the table.
pub struct Row {
    pub name: &'static str,
    pub range: &'static str,
    /// Largest error of a sum over its sensitivity, so of every alpha; see [`oracle::Truth`].
    pub claimed: f64,
    /// Sums of less sensitivity are measured in this unit.
    pub unit_px: f64,
}

impl Row {
    /// Compares every sum of every case with the oracle, on every backend, and prints the row.
    pub fn check(&self, cases: &[Case]) {
        let mut n_sums = 0;
        for backend in backends() {
            let (mut measured, mut ambiguous_px, mut whole_px) = (0.0_f64, 0.0, 0.0);
            let claimed = self.claimed * backend.bound_factor;
            for (number, case) in cases.iter().enumerate() {
                let (scene, view) = case.exact.as_ref().map_or((&case.scene, &case.view), |(s, v)| (s, v));
                for kind in KINDS {
                    let expected = oracle::weights(scene, view, &case.regions, kind, backend.cut_tolerance);
                    let found =
                        backend.rasterizer.weights(&case.scene, &case.view, &case.regions, kind).unwrap();
                    assert_eq!(found.counters.unusable, case.n_unusable, "{} case {number}", self.name);
                    let (error, key) = largest_error(&found, &expected, self.unit_px);
                    let place =
                        || format!("{} on {}, case {number}, {kind:?}, {key:?}", self.name, backend.name);
                    assert!(error <= claimed, "{}: {error:.1e}, {claimed:.1e} claimed", place());
                    measured = measured.max(error);
                    ambiguous_px += expected.values().map(|t| t.high - t.low).sum::<f64>();
                    whole_px += expected.values().map(|t| t.value).sum::<f64>();
                    n_sums += expected.len();
                }
            }
            println!(
                "| {} | {} | {} | measured {measured:.1e} | claimed {claimed:.1e} | on a cut {:.1e} |",
                self.name,
                self.range,
                backend.name,
                ambiguous_px / whole_px
            );
            assert!(ambiguous_px < 0.01 * whole_px, "{}: too much lies on a cut", self.name);
        }
        assert!(n_sums >= 20, "{}: {n_sums} sums are no test", self.name);
    }
}

/// Returns the largest error over the pairs of both, and where it is; see [`Row::claimed`].
pub fn largest_error(found: &ViewWeights, expected: &Sums, unit_px: f64) -> (f64, (u32, u32)) {
    let pairs = found.entries.iter().map(|e| (e.gaussian, e.region));
    assert!(pairs.is_sorted_by(|a, b| a < b), "ordered, each pair once");
    let found: BTreeMap<_, _> =
        found.entries.iter().map(|e| ((e.gaussian, e.region), f64::from(e.weight))).collect();
    let keys: BTreeSet<_> = found.keys().chain(expected.keys()).collect();
    let error = |key: &(u32, u32)| {
        let (found, truth) =
            (found.get(key).copied().unwrap_or(0.0), expected.get(key).copied().unwrap_or_default());
        assert!(found.is_finite());
        truth.distance(found) / truth.sensitivity.max(unit_px)
    };
    keys.into_iter().map(|key| (error(key), *key)).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_default()
}
