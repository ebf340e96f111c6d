//! Every Nth frame of a set of views.

use std::collections::{BTreeSet, HashSet};
use std::num::NonZeroU32;

use super::view_set::ViewSet;

impl ViewSet {
    /// Keeps every `n`th frame by number: the last run of digits in its file name (`frame_00040.jpg` is 40).
    ///
    /// Counting begins at the lowest number of its folder, frames without a pose included, so the choice does not
    /// depend on which poses are known. Where names of a folder share a number (`a_1_v2.jpg`) or have none, its frames
    /// are counted by name.
    pub fn every(mut self, n: NonZeroU32) -> Self {
        let damaged = self.damaged.iter().map(|(name, _)| name);
        let posed = self.views.iter().map(|view| &view.name);
        let names: BTreeSet<&str> =
            posed.chain(&self.without_pose).chain(damaged).map(String::as_str).collect();
        let names: Vec<&str> = names.into_iter().collect();
        let mut kept = HashSet::new();
        // Names of a folder are neighbours: they share everything before the last slash.
        for frames in names.chunk_by(|a, b| folder(a) == folder(b)) {
            let numbers: Option<Vec<u64>> = frames.iter().map(|name| number(name)).collect();
            let are_distinct = |all: &Vec<u64>| all.iter().collect::<HashSet<_>>().len() == all.len();
            let by_name = || (0..frames.len() as u64).collect();
            let counted: Vec<u64> = numbers.filter(are_distinct).unwrap_or_else(by_name);
            let lowest = counted.iter().copied().min().unwrap_or_default();
            let is_chosen = |counted: u64| (counted - lowest).is_multiple_of(n.get().into());
            let chosen = counted.into_iter().zip(frames).filter(|(counted, _)| is_chosen(*counted));
            kept.extend(chosen.map(|(_, name)| (*name).to_owned()));
        }
        if n.get() > 1 && names.len() > 1 && kept.len() == names.len() {
            self.notes.push(format!(
                "every {n}th frame is every frame: the numbers in the names are multiples of {n} apart; take a multiple of that"
            ));
        }
        self.views.retain(|view| kept.contains(&view.name));
        self.without_pose.retain(|name| kept.contains(name));
        self.damaged.retain(|(name, _)| kept.contains(name));
        self
    }
}

fn folder(name: &str) -> &str {
    name.rsplit_once('/').map_or("", |(folder, _)| folder)
}

/// Returns the last run of digits of a file name without its extension; `None` without one or beyond 64 bits.
fn number(name: &str) -> Option<u64> {
    let file = name.rsplit('/').next().unwrap_or(name);
    let stem = file.rsplit_once('.').map_or(file, |(stem, _)| stem);
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end].rfind(|c: char| !c.is_ascii_digit()).map_or(0, |at| {
        // The next character's start; digits are one byte each.
        at + stem[at..].chars().next().map_or(1, char::len_utf8)
    });
    stem[start..end].parse().ok()
}

#[cfg(test)]
mod tests;
