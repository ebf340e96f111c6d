//! The budget of working memory: named reservations.
//!
//! Each module that allocates what grows with the scene has a function `reserve`, beside the allocation, that names the
//! purpose and an upper bound of the bytes. The encoder calls them before the first view, and again after the views for
//! what depends on masks and contributions.

mod process;

use serde::Serialize;

pub(crate) use process::give_back;
pub use process::peak_bytes;

/// The steps of a run, one after the other, each with memory of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// From the first view to the end.
    Always,
    /// Scene and poses are read and split into cells.
    Read,
    /// What is to do is decided, and what is done is found.
    Plan,
    /// Views are segmented, embedded and rasterised.
    Views,
    /// Free and occupied places are found.
    Occupancy,
    /// Photos are searched for landmarks.
    Landmarks,
    /// The views' contributions are opened.
    Merge,
    /// Masks are weighed and superpoints found.
    Superpoints,
    Objects,
    /// Gaussians share evidence.
    Refine,
    /// Cells become shards.
    Cells,
    Publish,
}

#[derive(Clone, Copy, Debug)]
struct Reservation {
    purpose: &'static str,
    len_bytes: u64,
    phase: Phase,
}

/// What is needed, for what, and what to change.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct MemoryError {
    pub needed_bytes: u64,
    message: String,
}

/// The reservations of a run, within a budget: scene, photos in work with their masks and crops, places, landmarks,
/// cells, codebooks, objects, superpoints, mask vectors and contributions. Models are not covered: ONNX Runtime states
/// no bound.
#[derive(Clone, Debug)]
pub struct MemoryPlan {
    available_bytes: u64,
    is_before_views: bool,
    reservations: Vec<Reservation>,
}

impl MemoryPlan {
    pub fn new(available_bytes: u64) -> Self {
        Self { available_bytes, is_before_views: true, reservations: Vec::new() }
    }

    pub fn reserve(&mut self, phase: Phase, purpose: &'static str, len_bytes: u64) {
        self.reservations.push(Reservation { purpose, len_bytes, phase });
    }

    pub(crate) fn views_are_done(&mut self) {
        self.is_before_views = false;
    }

    /// Free bytes of the budget during a phase; [`Self::rest`] is the minimum over all.
    pub(crate) fn rest_of(&self, phase: Phase) -> u64 {
        self.available_bytes.saturating_sub(self.reserved_bytes(phase))
    }

    fn reserved_bytes(&self, phase: Phase) -> u64 {
        self.of_phase(phase).fold(0u64, |sum, r| sum.saturating_add(r.len_bytes))
    }

    fn of_phase(&self, phase: Phase) -> impl Iterator<Item = Reservation> + '_ {
        self.reservations.iter().filter(move |r| r.phase == phase || r.phase == Phase::Always).copied()
    }

    /// Bytes that the most expensive phase leaves for the contributions read at a time.
    pub fn rest(&self, contributions_bytes: u64) -> Result<u64, MemoryError> {
        let phases = self.reservations.iter().map(|r| r.phase);
        // Once the views are done, what they and what precedes the merge took is free.
        let phases = phases.filter(|phase| self.is_before_views || *phase > Phase::Merge);
        let most = phases.max_by_key(|phase| self.reserved_bytes(*phase)).unwrap_or(Phase::Always);
        let needed_bytes = self.reserved_bytes(most).saturating_add(contributions_bytes);
        if needed_bytes <= self.available_bytes {
            return Ok(self.rest_of(most));
        }
        let contributions = (contributions_bytes, "contributions of a part of a cell");
        let held = self.of_phase(most).map(|r| (r.len_bytes, r.purpose)).chain([contributions]);
        let mut parts: Vec<(u64, &str)> = held.filter(|(len_bytes, _)| *len_bytes > 0).collect();
        parts.sort_by_key(|(len_bytes, _)| std::cmp::Reverse(*len_bytes));
        let parts: Vec<String> = parts.iter().map(|(n, purpose)| format!("{n} for {purpose}")).collect();
        let (when, or_else) = match (self.is_before_views, most) {
            (false, _) => ("for the contributions of all views", ""),
            (true, Phase::Views) => ("at least", " or lower --threads"),
            (true, Phase::Cells) => ("at least", " or lower --cell-gaussians"),
            (true, Phase::Occupancy) => ("at least", " or give --occupancy larger voxels"),
            (true, Phase::Landmarks) => ("at least", " or leave --locate out"),
            (true, _) => ("at least", ""),
        };
        let (available_bytes, parts) = (self.available_bytes, parts.join(", "));
        let message = format!(
            "--memory is {available_bytes} bytes, {needed_bytes} are needed {when}: {parts}; raise --memory{or_else}"
        );
        Err(MemoryError { needed_bytes, message })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(available_bytes: u64) -> MemoryPlan {
        let mut plan = MemoryPlan::new(available_bytes);
        plan.reserve(Phase::Always, "masks", 20);
        plan.reserve(Phase::Views, "photos", 40);
        plan.reserve(Phase::Refine, "superpoints", 30);
        plan.reserve(Phase::Cells, "the largest cell", 50);
        plan
    }

    /// By hand: phases follow one another, so the largest counts, beside what is always held.
    #[test]
    fn the_largest_phase_counts() {
        assert_eq!(plan(100).rest(30), Ok(30));
        assert_eq!(plan(200).rest(30), Ok(130));
        assert_eq!(MemoryPlan::new(7).rest(7), Ok(7));
        let found = [Phase::Views, Phase::Refine, Phase::Cells].map(|phase| plan(100).rest_of(phase));
        assert_eq!(found, [40, 50, 30]);
        assert_eq!(plan(69).rest_of(Phase::Cells), 0);
    }

    /// Photos count until the views are done; fewer threads hold fewer of them.
    #[test]
    fn photos_count_until_the_views_are_done() {
        let mut plan = plan(100);
        plan.reserve(Phase::Views, "more photos", 41);
        let message = plan.rest(0).expect_err("too small").to_string();
        assert_eq!(
            message,
            "--memory is 100 bytes, 101 are needed at least: 41 for more photos, 40 for photos, 20 for masks; \
             raise --memory or lower --threads"
        );
        plan.views_are_done();
        assert_eq!(plan.rest(30), Ok(30));
    }

    #[test]
    fn a_budget_that_is_too_small_is_refused_with_each_part() {
        let message = plan(99).rest(30).expect_err("too small").to_string();
        assert_eq!(
            message,
            "--memory is 99 bytes, 100 are needed at least: 50 for the largest cell, \
             30 for contributions of a part of a cell, 20 for masks; raise --memory or lower --cell-gaussians"
        );
        let mut later = plan(99);
        later.views_are_done();
        let message = later.rest(30).expect_err("too small").to_string();
        assert!(
            message.contains("for the contributions of all views: 50") && message.ends_with("raise --memory"),
            "{message}"
        );
    }
}
