//! Every Nth frame of a set of views.

use std::num::NonZeroU32;

use super::view_set::ViewSet;

impl ViewSet {
    /// Keeps every `n`th frame by number: the last run of digits in its file name (`frame_00040.jpg` is 40).
    ///
    /// Counting begins at the lowest number of its folder, frames without a pose included, so the choice does not
    /// depend on which poses are known. If any name has no number, all frames are counted by name.
    pub fn every(mut self, n: NonZeroU32) -> Self {
        let n = u64::from(n.get());
        let mut names: Vec<&str> = self
            .views
            .iter()
            .map(|v| v.name.as_str())
            .chain(
                self.without_pose.iter().chain(self.damaged.iter().map(|(name, _)| name)).map(String::as_str),
            )
            .collect();
        names.sort_unstable();
        let numbers: Option<Vec<u64>> = names.iter().map(|name| number(name)).collect();
        let numbers = numbers.unwrap_or_else(|| (0..names.len() as u64).collect());
        let mut kept = Vec::new();
        // Folders are contiguous: names of a folder share everything before the last slash.
        let rows: Vec<(&str, u64, &str)> =
            names.iter().zip(numbers).map(|(name, number)| (folder(name), number, *name)).collect();
        let mut lowest = std::collections::BTreeMap::new();
        for (folder, number, _) in &rows {
            let low = lowest.entry(*folder).or_insert(*number);
            *low = (*low).min(*number);
        }
        for (folder, number, name) in rows {
            let low = lowest.get(folder).copied().unwrap_or_default();
            if (number - low).is_multiple_of(n) {
                kept.push(name.to_owned());
            }
        }
        let is_kept = |name: &String| kept.binary_search(name).is_ok();
        self.views.retain(|view| is_kept(&view.name));
        self.without_pose.retain(is_kept);
        self.damaged.retain(|(name, _)| is_kept(name));
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
