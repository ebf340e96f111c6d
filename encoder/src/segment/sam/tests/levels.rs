//! Which of the three masks of each prompt are used.

use super::super::SamLevels;
use super::*;

/// Levels are filtered separately: a part that equals its whole stays if both levels are asked for.
#[test]
fn levels_do_not_suppress_each_other() {
    // Only boxes decide, so that many of the repeated objects are duplicates.
    let with = |levels: &SamLevels| {
        kept_levels(SamSettings {
            levels: *levels,
            predicted_iou: 0.0,
            stability: 0.0,
            ..SamSettings::default()
        })
    };
    let of = |levels: &[SamLevels]| levels.iter().map(with).collect::<Vec<_>>();
    let [merged, w, p, s, all] =
        of(&[SamLevels::Merged, SamLevels::Whole, SamLevels::Part, SamLevels::Subpart, SamLevels::All])
            .try_into()
            .expect("five");
    assert_eq!(all, [w.clone(), p.clone(), s.clone()].concat());
    assert!(merged.len() < all.len(), "{} {}", merged.len(), all.len());
    for (level, found) in [w, p, s].iter().enumerate() {
        assert!(!found.is_empty() && found.iter().all(|(of, _)| usize::from(*of) == level));
    }
}

/// Levels and areas of the masks that the filters keep of synthetic answers.
fn kept_levels(settings: SamSettings) -> Vec<(u8, u32)> {
    let image_px = [230, 170];
    let filters = Filters { settings: &settings, image_px };
    let crop = BoxPx { x0: 0, y0: 0, x1: image_px[0], y1: image_px[1] };
    let letterbox = Letterbox::new(SIZE_PX, image_px);
    let all = blobs(24, 7, letterbox.resized_px.map(f64::from));
    let decoded = decoded(&all);
    let upsampler = Upsampler::new(&letterbox, decoded.logits_px);
    let lists = filters.lists(filters.candidates(&decoded, &upsampler, crop));
    let kept = lists.into_iter().flat_map(|list| filters.unique_in_image(filters.unique_in_crop(list), 1));
    kept.map(|candidate| (candidate.level, candidate.mask.area_px)).collect()
}
