//! Every Nth frame of a set of views.

use std::num::NonZeroU32;

use super::view_set::ViewSet;

impl ViewSet {
    /// Keeps every `n`th frame, by its number.
    ///
    /// A frame's number is the last run of digits in its file name (`frame_00040.jpg` is 40). Counting begins at the
    /// lowest number of its folder, frames without a pose included, so that the choice does not depend on which poses
    /// are known. If any name has no number, all frames are counted in the order of their names instead.
    pub fn every(mut self, n: NonZeroU32) -> Self {
        let n = u64::from(n.get());
        let mut names: Vec<&str> = self
            .views
            .iter()
            .map(|v| v.name.as_str())
            .chain(self.without_pose.iter().map(String::as_str))
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
        self
    }
}

/// Returns the part of a name before its last slash.
fn folder(name: &str) -> &str {
    name.rsplit_once('/').map_or("", |(folder, _)| folder)
}

/// Returns the last run of digits of a file name without its extension; `None` if there is none, or it exceeds 64 bits.
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
mod tests {
    use std::path::PathBuf;

    use glam::DAffine3;

    use super::*;
    use crate::camera::{Distortion, Intrinsics, View};
    use crate::poses::PoseSource;

    fn set(names: &[&str], without_pose: &[&str]) -> ViewSet {
        let view = |name: &&str| View {
            name: (*name).to_owned(),
            image_path: PathBuf::from(name),
            intrinsics: Intrinsics {
                width_px: 8,
                height_px: 6,
                focal_x_px: 8.0,
                focal_y_px: 8.0,
                centre_x_px: 4.0,
                centre_y_px: 3.0,
                distortion: Distortion::None,
            },
            camera_from_world: DAffine3::IDENTITY,
        };
        ViewSet {
            views: names.iter().map(view).collect(),
            source: PoseSource::Scannet,
            without_pose: without_pose.iter().map(|name| (*name).to_owned()).collect(),
            applied: None,
        }
    }

    fn every(names: &[&str], without_pose: &[&str], n: u32) -> (Vec<String>, Vec<String>) {
        let kept = set(names, without_pose).every(NonZeroU32::new(n).unwrap());
        (kept.views.into_iter().map(|view| view.name).collect(), kept.without_pose)
    }

    #[test]
    fn frames_are_counted_by_number_not_by_place() {
        // Frame 0 has no pose, yet counting begins there; 41 to 59 are not in the set.
        let names = ["1.jpg", "20.jpg", "21.jpg", "40.jpg", "60.jpg", "61.jpg"];
        let (kept, without_pose) = every(&names, &["0.jpg", "10.jpg"], 20);
        assert_eq!(kept, ["20.jpg", "40.jpg", "60.jpg"]);
        assert_eq!(without_pose, ["0.jpg"]);
        assert_eq!(every(&names, &[], 1).0, names);
    }

    #[test]
    fn each_folder_counts_from_its_own_first_frame() {
        let names = ["left/f_0003.v2.jpg", "left/f_0004.v2.jpg", "right/10é.png", "right/12é.png"];
        assert_eq!(number("right/10é.png"), Some(10));
        assert_eq!(number("left/f_0003.v2.jpg"), Some(2), "the last digits count");
        assert_eq!(every(&names[2..], &[], 2).0, ["right/10é.png", "right/12é.png"]);
        let (kept, _) = every(&["a/5.png", "a/6.png", "b/6.png", "b/7.png"], &[], 2);
        assert_eq!(kept, ["a/5.png", "b/6.png"]);
    }

    #[test]
    fn names_without_numbers_count_by_place() {
        assert_eq!(every(&["a.png", "b.png", "c7.png"], &[], 2).0, ["a.png", "c7.png"]);
        assert_eq!(number("99999999999999999999999.png"), None);
    }
}
