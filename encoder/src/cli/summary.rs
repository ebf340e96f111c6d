//! The summary of an encode, as lines for people.

use slag_common::ByteSize;

use crate::encode::coverage::CoverageReport;
use crate::encode::front::Expectation;
use crate::encode::{EncodeSettings, EncodeSummary, GpuReport, StageReport};

/// Label and figures.
type Line = (&'static str, String);

/// `expected`: what a front expects of the requested target.
pub(super) fn lines(
    settings: &EncodeSettings,
    summary: &EncodeSummary,
    expected: Option<&Expectation>,
) -> String {
    let EncodeSummary { n_gaussians, n_without_evidence, n_rejected, .. } = summary;
    let mut lines = Vec::new();
    lines.extend(expected.map(|expected| ("target", of_target(expected, summary))));
    lines.extend([
        ("published", format!("generation {} in {}", summary.generation, settings.output.store.display())),
        (
            "Gaussians",
            format!("{n_gaussians} ({n_without_evidence} without evidence, {n_rejected} unusable)"),
        ),
    ]);
    lines.extend(of_views(summary));
    lines.extend(summary.encoder_before.as_ref().map(|before| {
        ("encoder", format!("{} in place of {before}: robots need its text model", summary.encoder))
    }));
    lines.extend(summary.images_on.as_ref().map(|on| ("images on", on.clone())));
    lines.extend(of_cells(summary));
    let busy: Vec<String> =
        summary.busy_secs.iter().map(|(stage, secs)| format!("{stage} {secs:.1}")).collect();
    let busy = busy.join(", ");
    lines.extend([
        ("seconds", format!("{:.1}; by stage, all threads: {busy}", summary.wall_secs)),
        ("views took", format!("{:.1} s", summary.views_secs)),
    ]);
    let lines: String = lines.into_iter().map(|(name, text)| format!("{name:<11}{text}\n")).collect();
    lines + "  stage    at once   seconds    busy\n" + &of_stages(&summary.view_stages)
}

fn of_target(expected: &Expectation, summary: &EncodeSummary) -> String {
    let profile = expected.setting.profile.name();
    let bytes = summary.shard_bytes.get(profile).map_or("none made".into(), |b| ByteSize(*b).to_string());
    format!(
        "{} ({}): {:.1} s and {} of {profile} shards expected; {:.1} s and {bytes} used",
        expected.setting.name,
        expected.setting.flags,
        expected.seconds,
        ByteSize(expected.bytes as u64),
        summary.wall_secs
    )
}

fn of_views(summary: &EncodeSummary) -> Vec<Line> {
    let EncodeSummary { n_views, n_views_with_photo, n_views_resumed, n_views_drawn, .. } = summary;
    let mut lines = vec![("views", format!("{n_views} of {n_views_with_photo} ({n_views_resumed} resumed)"))];
    if *n_views_drawn > 0 {
        let what = "views are drawings of the splat, not photos; docs/inputs.md says what they miss";
        lines.push(("drawn", format!("{n_views_drawn} {what}")));
    }
    lines.extend(summary.lost_views.as_ref().map(|lost| ("kept", lost.reason.clone())));
    lines.extend(summary.coverage.map(|CoverageReport { coverage, seen }| {
        let (coverage, seen, secs) = (100.0 * coverage, 100.0 * seen, summary.coverage_secs);
        let seen = format!("{seen:.1} % of the Gaussians seen");
        ("coverage", format!("{coverage:.1} % of all views, {seen}; found in {secs:.1} s"))
    }));
    lines.extend(summary.skipped_views.first().map(|first| {
        ("left out", format!("{} views, the first: {}", summary.skipped_views.len(), first.reason))
    }));
    lines
}

fn of_cells(summary: &EncodeSummary) -> Vec<Line> {
    let EncodeSummary { n_views, n_masks, n_regions, n_entries, .. } = summary;
    let a_photo = *n_masks as f64 / (*n_views).max(1) as f64;
    let without_masks = match summary.n_views_without_masks {
        0 => String::new(),
        n => format!(", {n} of {n_views} photos have none"),
    };
    let masks = format!("{n_masks} in {n_regions} regions, {n_entries} contributions");
    let mut lines = vec![
        ("masks", format!("{masks}; {a_photo:.1} a photo{without_masks}")),
        ("cells", format!("{} with {} centroids", summary.n_cells, summary.n_centroids)),
    ];
    lines.extend(summary.objects.as_ref().map(|found| {
        let (n, of_masks) = (found.n_objects, found.n_masks_of_objects);
        let (n_others, n_gaussians, largest_m) =
            (found.n_masks - of_masks, found.n_gaussians, found.largest_m);
        let objects = format!(
            "{n} of {of_masks} masks, {n_gaussians} Gaussians, up to {largest_m:.1} {}",
            summary.unit
        );
        ("objects", format!("{objects}; {n_others} other masks"))
    }));
    lines.extend(summary.occupancy.as_ref().map(|found| {
        let (free, occupied, bytes) = (found.n_free, found.n_occupied, ByteSize(found.len_bytes));
        let (voxel_m, secs) = (found.voxel_m, found.secs);
        ("places", format!("{free} voxels of {voxel_m} m free, {occupied} occupied; {bytes} in {secs:.1} s"))
    }));
    let sizes: Vec<String> = summary
        .shard_bytes
        .iter()
        .map(|(profile, bytes)| format!("{profile} {}", ByteSize(*bytes)))
        .collect();
    lines.push(("shards", sizes.join(", ")));
    lines
}

fn of_stages(stages: &[StageReport]) -> String {
    let line = |name: &str, n: usize, secs: f64, share: f64| {
        format!("  {name:<9}{n:>8}{secs:>10.1}{:>7.0} %\n", 100.0 * share)
    };
    let of_gpu = |GpuReport { load, busy_share }: &GpuReport| {
        line(&format!("  GPU {}", load.gpu), load.n_lanes, load.busy_secs, *busy_share)
    };
    let of_stage = |stage: &StageReport| {
        line(&stage.stage, stage.n_slots, stage.busy_secs, stage.busy_share)
            + &stage.gpus.iter().map(of_gpu).collect::<String>()
    };
    stages.iter().map(of_stage).collect()
}
