//! The summary of an encode, as lines for people.

use slag_common::ByteSize;

use crate::encode::coverage::CoverageReport;
use crate::encode::front::Expectation;
use crate::encode::{EncodeSettings, EncodeSummary, GpuReport, StageReport};

/// Returns the lines. `expected`: what a front expected of the target that was asked for.
pub(super) fn lines(
    settings: &EncodeSettings,
    summary: &EncodeSummary,
    expected: Option<&Expectation>,
) -> String {
    let busy =
        summary.busy_secs.iter().map(|(stage, s)| format!("{stage} {s:.1}")).collect::<Vec<_>>().join(", ");
    let of_views: String = (summary.view_stages.iter())
        .map(|stage| {
            let StageReport { stage, n_slots, busy_secs, busy_share, gpus } = stage;
            let line = |name: &str, n: usize, secs: f64, share: f64| {
                format!("  {name:<9}{n:>8}{secs:>10.1}{:>7.0} %\n", 100.0 * share)
            };
            let of_gpu =
                |g: &GpuReport| line(&format!("  GPU {}", g.gpu), g.n_lanes, g.busy_secs, g.busy_share);
            line(stage, *n_slots, *busy_secs, *busy_share) + &gpus.iter().map(of_gpu).collect::<String>()
        })
        .collect();
    let sizes = summary
        .shard_bytes
        .iter()
        .map(|(p, b)| format!("{p} {}", ByteSize(*b)))
        .collect::<Vec<_>>()
        .join(", ");
    let drawn = match summary.n_views_drawn {
        0 => String::new(),
        n => format!(
            "drawn      {n} views are drawings of the splat, not photos; docs/inputs.md says what they miss\n"
        ),
    };
    let skipped = match summary.skipped_views.len() {
        0 => String::new(),
        n => format!("left out   {n} views, the first: {}\n", summary.skipped_views[0].reason),
    };
    let without_masks = match summary.n_views_without_masks {
        0 => String::new(),
        n => format!(", {n} of {} photos have none", summary.n_views),
    };
    let coverage = summary.coverage.map_or(String::new(), |CoverageReport { coverage, seen }| {
        let (coverage, seen, secs) = (100.0 * coverage, 100.0 * seen, summary.coverage_secs);
        format!("coverage   {coverage:.1} % of all views, {seen:.1} % of the Gaussians seen; found in {secs:.1} s\n")
    });
    let objects = summary.objects.as_ref().map_or(String::new(), |found| {
        let (n, of_masks) = (found.n_objects, found.n_masks_of_objects);
        let n_others = found.n_masks - of_masks;
        format!(
            "objects    {n} of {of_masks} masks, {} Gaussians, up to {:.1} m; {n_others} other masks\n",
            found.n_gaussians, found.largest_m
        )
    });
    let occupancy = summary.occupancy.as_ref().map_or(String::new(), |found| {
        let (free, occupied, bytes) = (found.n_free, found.n_occupied, ByteSize(found.len_bytes));
        let (voxel_m, secs) = (found.voxel_m, found.secs);
        format!("places     {free} voxels of {voxel_m} m free, {occupied} occupied; {bytes} in {secs:.1} s\n")
    });
    let lost =
        summary.lost_views.as_ref().map_or(String::new(), |lost| format!("kept       {}\n", lost.reason));
    let encoder = summary.encoder_before.as_ref().map_or(String::new(), |before| {
        format!("encoder    {} in place of {before}: robots need its text model\n", summary.encoder)
    });
    let images_on = summary.images_on.as_ref().map_or(String::new(), |on| format!("images on  {on}\n"));
    let of_target = expected.map_or(String::new(), |e| {
        let profile = e.setting.profile.name();
        let bytes = summary.shard_bytes.get(profile).map_or("none made".into(), |b| ByteSize(*b).to_string());
        format!(
            "target     {} ({}): {:.1} s and {} of {profile} shards expected; {:.1} s and {bytes} used\n",
            e.setting.name,
            e.setting.flags,
            e.seconds,
            ByteSize(e.bytes as u64),
            summary.wall_secs
        )
    });
    format!(
        "{of_target}published  generation {} in {}\n\
         Gaussians  {} ({} without evidence, {} unusable)\n\
         views      {} of {} ({} resumed)\n{drawn}{lost}{coverage}{skipped}{encoder}{images_on}\
         masks      {} in {} regions, {} contributions; {:.1} a photo{}\n\
         cells      {} with {} centroids\n\
         {objects}{occupancy}shards     {sizes}\n\
         seconds    {:.1}; by stage, all threads: {busy}\n\
         views took {:.1} s\n  stage    at once   seconds    busy\n{of_views}",
        summary.generation,
        settings.output.store.display(),
        summary.n_gaussians,
        summary.n_without_evidence,
        summary.n_rejected,
        summary.n_views,
        summary.n_views_with_photo,
        summary.n_views_resumed,
        summary.n_masks,
        summary.n_regions,
        summary.n_entries,
        summary.n_masks as f64 / summary.n_views.max(1) as f64,
        without_masks,
        summary.n_cells,
        summary.n_centroids,
        summary.wall_secs,
        summary.views_secs,
    )
}
