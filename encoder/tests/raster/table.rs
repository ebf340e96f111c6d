//! Rows of the table in docs/numerics.md: a range of inputs and its claimed error.

use super::*;

use super::backends::backends;

/// Rows with Gaussians at equal depths or on a cut, where the last bit of f32 decides.
const ROWS_OF_TIES: [&str; 3] = ["pile", "on the cuts", "rotations"];

pub struct Case {
    pub scene: Gaussians,
    pub view: RasterView,
    pub regions: RegionMap,
    /// The same view in a frame where float64 is exact, for the oracle.
    pub exact: Option<(Gaussians, RasterView)>,
    pub n_unusable: usize,
}

impl Case {
    pub fn new(scene: Gaussians, view: RasterView, regions: RegionMap) -> Self {
        Self { scene, view, regions, exact: None, n_unusable: 0 }
    }
}

pub struct Row {
    pub name: &'static str,
    pub range: &'static str,
    /// Largest error of a contribution over its sensitivity; see [`oracle::Truth`].
    pub claimed: f64,
    /// Least sensitivity by which errors are divided.
    pub unit_px: f64,
}

impl Row {
    /// Checks every contribution on every backend against the oracle; prints the row, with distances from the first.
    pub fn check(&self, cases: &[Case]) {
        let mut of_first: Vec<Weights> = Vec::new();
        for (b, backend) in backends().iter().enumerate() {
            if !backend.keeps_order && ROWS_OF_TIES.contains(&self.name) {
                println!("| {} | {} | {} | not claimed |", self.name, self.range, backend.name);
                continue;
            }
            let (mut worst, mut place) = (0.0, String::new());
            let (mut apart, mut on_a_cut_px, mut whole_px, mut n_sums) = (0.0_f64, 0.0, 0.0, 0);
            for (i, case) in cases.iter().enumerate().step_by(backend.case_step(cases.len())) {
                let (scene, view) = case.exact.as_ref().map_or((&case.scene, &case.view), |(s, v)| (s, v));
                let expected = oracle::weights(scene, view, &case.regions, backend.cut_tolerance);
                let found = backend.rasterizer.weights(&case.scene, &case.view, &case.regions).unwrap();
                assert_eq!(found.counters.unusable, case.n_unusable, "{} case {i}", self.name);
                let found = by_pair(&found);
                if b == 0 {
                    of_first.push(found.clone());
                }
                let first = &of_first[i];
                for key in found.keys().chain(first.keys()).chain(expected.keys()) {
                    let truth = expected.get(key).copied().unwrap_or_default();
                    let unit_px = truth.sensitivity.max(self.unit_px);
                    let value = weight(&found, key);
                    let error = truth.distance(value) / unit_px;
                    if error > worst {
                        (worst, place) = (error, format!("case {i}, {key:?}"));
                    }
                    let difference = (value - weight(first, key)).abs() - (truth.high - truth.low);
                    apart = apart.max(difference / unit_px);
                }
                on_a_cut_px += expected.values().map(|t| t.high - t.low).sum::<f64>();
                whole_px += expected.values().map(|t| t.value).sum::<f64>();
                n_sums += expected.len();
            }
            let Backend { name, bound_factor, .. } = backend;
            let (claimed, on_a_cut) = (self.claimed * bound_factor, on_a_cut_px / whole_px);
            println!(
                "| {} | {} | {name} | measured {worst:.1e} | claimed {claimed:.1e} | from {} {apart:.1e} | \
                 on a cut {on_a_cut:.1e} |",
                self.name,
                self.range,
                backends()[0].name,
            );
            assert!(worst <= claimed, "{} on {name}, {place}: {worst:.1e}, {claimed:.1e} claimed", self.name);
            assert!(on_a_cut < 0.02, "{} on {name}: {on_a_cut} lies on a cut", self.name);
            assert!(n_sums >= 20, "{}: {n_sums} sums are no test", self.name);
        }
    }
}

/// Weights by (Gaussian, region).
pub type Weights = BTreeMap<(u32, u32), f64>;

pub fn by_pair(weights: &ViewWeights) -> Weights {
    let pairs = weights.entries.iter().map(|e| (e.gaussian, e.region));
    assert!(pairs.is_sorted_by(|a, b| a < b), "ordered, each pair once");
    assert!(weights.entries.iter().all(|e| e.weight.is_finite()));
    weights.entries.iter().map(|e| ((e.gaussian, e.region), e.weight.into())).collect()
}

fn weight(found: &Weights, key: &(u32, u32)) -> f64 {
    found.get(key).copied().unwrap_or(0.0)
}
