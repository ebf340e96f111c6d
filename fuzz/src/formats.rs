//! The fuzz targets, one function per decoder.

use std::cell::RefCell;
use std::path::Path;

use glam::DVec3;
use slag_common::container::{AlignedBytes, Layout, PREAMBLE_BYTES, SECTION_ROW_BYTES};
use slag_common::manifest::{CellIndex, Manifest};
use slag_common::shard::{self, ShardLayout};
use slag_common::splat::{self, ReadOptions};
use slag_common::{Gaussians, Hash32, poses};
use slag_edge::query::relations::{self, Phrase};
use slag_edge::store::EdgeCache;
use slag_encoder::ingest::read_geo_reference;
use slag_encoder::lift::{CellField, ContributionFile, ContributionIndex, RegionTable};
use slag_encoder::masks::Mask;
use slag_encoder::masks::rle::Rle;
use slag_encoder::segment::{GivenMasks, SegmentInput};
use slag_models::TextEncoder;
use slag_models::description::Description;

use super::seeds::{self, MASKED_PX};

/// Separator of inputs with several files.
const SEPARATOR: &[u8] = b"\n====\n";

/// Runs `work` in the thread's own folder, in memory if possible.
fn in_folder(work: impl FnOnce(&Path) -> bool) -> bool {
    thread_local! {
        static FOLDER: RefCell<Option<tempfile::TempDir>> = const { RefCell::new(None) };
    }
    FOLDER.with_borrow_mut(|folder| {
        let folder = folder.get_or_insert_with(|| {
            let memory = Path::new("/dev/shm");
            let made = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
            made.expect("a temporary folder")
        });
        work(folder.path())
    })
}

/// Whether a file was read; an error must name it or its folder.
fn is_read<T>(result: Result<T, impl std::fmt::Display>, path: &Path) -> bool {
    let error = result.map_or_else(|error| error.to_string(), |_| String::new());
    assert!(error.is_empty() || error.contains(&path.display().to_string()), "{error}");
    error.is_empty()
}

fn in_file(name: &str, data: &[u8], work: impl FnOnce(&Path) -> bool) -> bool {
    in_folder(|folder| {
        let path = folder.join(name);
        fs_err::write(&path, data).expect("the file is written");
        work(&path)
    })
}

/// Corrects the checksums of a container's sections and head, as a hostile writer can.
fn with_checksums(data: &[u8]) -> Vec<u8> {
    let mut bytes = data.to_vec();
    let Some(n) = bytes.get(12..16).map(|n| u32::from_le_bytes([n[0], n[1], n[2], n[3]]) as usize) else {
        return bytes;
    };
    let table_end = PREAMBLE_BYTES + n.min(64) * SECTION_ROW_BYTES;
    if bytes.len() < table_end {
        return bytes;
    }
    for row in (PREAMBLE_BYTES..table_end).step_by(SECTION_ROW_BYTES) {
        let number = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"));
        let (offset, len) = (number(row + 8), number(row + 16));
        let section = offset.checked_add(len).and_then(|end| bytes.get(offset as usize..end as usize));
        if let Some(checksum) = section.map(|section| Hash32::of(section).0) {
            bytes[row + 24..row + 32].copy_from_slice(&checksum[..8]);
        }
    }
    let head = [&bytes[..24], &bytes[PREAMBLE_BYTES..table_end]].concat();
    bytes[24..32].copy_from_slice(&Hash32::of(&head).0[..8]);
    bytes
}

pub fn container(data: &[u8]) -> bool {
    let is_accepted = |bytes: &[u8]| match Layout::check(bytes, shard::MAGIC, shard::VERSION) {
        Ok(layout) => {
            std::hint::black_box((0..64).filter_map(|id| layout.find(id)).count());
            true
        }
        Err(_) => false,
    };
    is_accepted(data) | is_accepted(&with_checksums(data))
}

pub fn shard(data: &[u8]) -> bool {
    let bytes = AlignedBytes::copy_of(&with_checksums(data));
    let Ok(layout) = ShardLayout::check(&bytes) else { return false };
    let view = layout.view(&bytes);
    for centroid in 0..view.header.n_centroids as usize {
        assert!(view.members(centroid).end <= view.n_with_evidence());
    }
    for index in 0..view.header.n_gaussians as usize {
        std::hint::black_box(view.position_in_world(index));
    }
    std::hint::black_box(view.scores(&vec![1.0; view.header.dim as usize]));
    std::hint::black_box((view.bounds(), view.encoder_id()));
    let additions = layout.additions(&bytes);
    if let Some(appearance) = additions.appearance {
        let columns = [appearance.colours.len(), appearance.sizes.len(), appearance.rotations.len()];
        assert_eq!(columns, [view.header.n_gaussians as usize; 3]);
    }
    for (pose, name) in additions.photo_poses.iter().flat_map(|photos| photos.iter()) {
        assert!(pose.offset.iter().all(|c| c.is_finite()) && pose.focal_px > 0.0 && name.len() <= 1024);
    }
    for landmark in additions.landmarks.iter().flat_map(|landmarks| landmarks.iter()) {
        assert!(landmark.position_in_world.is_finite());
    }
    if let Some(occupancy) = additions.occupancy {
        let n_blocks: u32 = occupancy.header.n_blocks.iter().product();
        let mut end = 0;
        for run in occupancy.runs() {
            assert!(
                end <= run.blocks.start && run.blocks.start < run.blocks.end && run.blocks.end <= n_blocks
            );
            end = run.blocks.end;
            for block in [run.blocks.start, run.blocks.end - 1] {
                let [occupied, free] = run.masks_of(block);
                assert_eq!(occupied & free, 0, "block {block}");
            }
        }
    }
    if let Some(objects) = additions.objects {
        let n: u32 = objects.runs().map(|(run, object)| object.map_or(0, |_| run.len() as u32)).sum();
        assert_eq!(n, objects.records.iter().map(|record| record.n_gaussians_here).sum::<u32>());
        assert!(
            objects.records.iter().all(|record| objects.photo(record).len() == record.photo_bytes as usize)
        );
        std::hint::black_box(view.object_scores(&objects, &vec![1.0; view.header.dim as usize]));
    }
    true
}

pub fn manifest(data: &[u8]) -> bool {
    let Ok(manifest) = Manifest::parse(data) else { return false };
    let again = Manifest::parse(&manifest.to_bytes()).expect("a written manifest is read");
    assert_eq!(again, manifest);
    CellIndex::new(&manifest.cells).within(DVec3::ZERO, 1e9);
    let wanted = slag_edge::fetch::Wanted {
        profile: shard::Profile::Compact,
        centre_in_world: DVec3::ZERO,
        radius: 1e9,
        max_bytes: None,
    };
    let _ = slag_edge::fetch::Plan::new(&manifest, &wanted, &Default::default());
    let at: Result<slag_edge::fetch::Position, _> = "46.8,-91.9".parse();
    let _ = at.expect("a position").in_world(&manifest);
    true
}

pub fn current(data: &[u8]) -> bool {
    in_folder(|folder| {
        let cache = EdgeCache::open(folder);
        fs_err::write(cache.current_path(), data).expect("the file is written");
        cache.current().is_ok()
    })
}

fn read_splat(name: &str, data: &[u8]) -> bool {
    in_file(name, data, |path| read_splat_at(path, path))
}

/// `named`: path that an error must contain.
fn read_splat_at(path: &Path, named: &Path) -> bool {
    let read = splat::read(path, &ReadOptions { with_sh_rest: true });
    if let Ok(gaussians) = &read {
        let n = gaussians.len();
        let lengths = [gaussians.rotations_wxyz.len(), gaussians.scales.len(), gaussians.opacities.len()];
        assert_eq!((lengths, gaussians.sh_dc.len()), ([n; 3], n));
        let n_rest = 3 * Gaussians::sh_rest_per_channel(gaussians.sh_degree);
        assert_eq!(gaussians.sh_rest.len(), n * n_rest);
    }
    is_read(read, named)
}

pub fn ply(data: &[u8]) -> bool {
    read_splat("x.ply", data)
}

pub fn splat(data: &[u8]) -> bool {
    read_splat("x.splat", data)
}

/// Raw, and gzip-compressed like versions 1 to 3.
pub fn spz(data: &[u8]) -> bool {
    use std::io::Write;
    let is_accepted = read_splat("x.spz", data);
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packed.write_all(data).expect("writes to memory");
    read_splat("x.spz", &packed.finish().expect("writes to memory")) | is_accepted
}

pub fn sog(data: &[u8]) -> bool {
    read_splat("x.sog", data)
}

/// A folder's meta file, and an image for each of its images.
pub fn sog_folder(data: &[u8]) -> bool {
    let (meta, image) = two_parts(data);
    in_folder(|folder| {
        fs_err::write(folder.join("x.webp"), image).expect("the file is written");
        fs_err::write(folder.join("meta.json"), meta).expect("the file is written");
        read_splat_at(&folder.join("meta.json"), folder)
    })
}

fn two_parts(data: &[u8]) -> (&[u8], &[u8]) {
    let at = data.windows(SEPARATOR.len()).position(|window| window == SEPARATOR);
    at.map_or((data, &[]), |at| (&data[..at], &data[at + SEPARATOR.len()..]))
}

fn read_poses(path: &Path, images: Option<&Path>) -> bool {
    let read = poses::read(path, images);
    for view in read.iter().flat_map(|set| &set.views) {
        assert!(view.camera_from_world.is_finite() && !view.name.is_empty());
        assert!(view.intrinsics.focal_x_px > 0.0);
    }
    is_read(read, path.parent().expect("it lies in a folder"))
}

fn colmap(data: &[u8], extension: &str) -> bool {
    let (cameras, images) = two_parts(data);
    in_folder(|folder| {
        let path = |stem: &str| folder.join(stem).with_extension(extension);
        fs_err::write(path("cameras"), cameras).expect("the file is written");
        fs_err::write(path("images"), images).expect("the file is written");
        read_poses(&path("cameras"), Some(folder))
    })
}

pub fn colmap_text(data: &[u8]) -> bool {
    colmap(data, "txt")
}

pub fn colmap_bin(data: &[u8]) -> bool {
    colmap(data, "bin")
}

pub fn transforms(data: &[u8]) -> bool {
    in_file("transforms.json", data, |path| read_poses(path, None))
}

/// Camera matrix and pose of a ScanNet scene with one intact photo.
pub fn scannet(data: &[u8]) -> bool {
    let (camera, pose) = two_parts(data);
    in_folder(|folder| {
        let scene = folder.join("scannet");
        for name in ["intrinsic", "pose", "color"] {
            fs_err::create_dir_all(scene.join(name)).expect("the folder is made");
        }
        let photo = scene.join("color/0.png");
        if !photo.is_file() {
            image::RgbImage::new(64, 48).save(&photo).expect("the photo is written");
        }
        fs_err::write(scene.join("intrinsic/intrinsic_color.txt"), camera).expect("the file is written");
        fs_err::write(scene.join("pose/0.txt"), pose).expect("the file is written");
        read_poses(&scene, None)
    })
}

pub fn splat_frame(data: &[u8]) -> bool {
    in_file(poses::FRAME_FILE, data, |path| {
        let read = poses::SplatFrame::read(path);
        read.is_ok_and(|frame| {
            frame.splat_from_poses(poses::PoseSource::Scannet, None).similarity.scale > 0.0
        })
    })
}

/// Width and height in two bytes each, then run lengths.
pub fn rle(data: &[u8]) -> bool {
    let Some((size, text)) = data.split_at_checked(4) else { return false };
    let side = |at: usize| u32::from(u16::from_le_bytes([size[at], size[at + 1]]));
    let is_accepted = Rle::from_text(side(0), side(2), &String::from_utf8_lossy(text)).is_ok();
    let counts = text.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
    Rle::from_counts(side(0), side(2), counts).is_ok() | is_accepted
}

pub fn coco(data: &[u8]) -> bool {
    in_file("masks.json", data, read_masks)
}

pub fn id_image(data: &[u8]) -> bool {
    in_folder(|folder| {
        let ids = folder.join("ids");
        fs_err::create_dir_all(&ids).expect("the folder is made");
        fs_err::write(ids.join("a.png"), data).expect("the file is written");
        read_masks(&ids)
    })
}

fn read_masks(path: &Path) -> bool {
    let view = seeds::photo("a.jpg", MASKED_PX);
    let image = image::RgbImage::new(MASKED_PX[0], MASKED_PX[1]);
    let input =
        SegmentInput { view: &view, image: &image, valid: None, undistorter: None, depth: None, pool: None };
    let read = GivenMasks::open(path, Vec::new()).and_then(|masks| masks.load(&input));
    read.iter().flatten().flatten().for_each(check_mask);
    is_read(read, path)
}

fn check_mask(mask: &Mask) {
    let (at, [width, height]) = (&mask.box_px, MASKED_PX);
    assert!(at.x0 < at.x1 && at.x1 <= width && at.y0 < at.y1 && at.y1 <= height);
    assert_eq!(mask.inside.n_px(), (at.width_px() * at.height_px()) as usize);
    assert_eq!(mask.inside.count(), mask.area_px as usize);
}

pub fn model_toml(data: &[u8]) -> bool {
    in_file("model.toml", data, |path| Description::read(path).is_ok())
}

pub fn tensors(data: &[u8]) -> bool {
    in_file("x.safetensors", data, |path| {
        let read = |n_centroids| is_read(slag_models::tensors::read(path, "vectors", n_centroids, 3), path);
        read(Some(2)) | read(None)
    })
}

pub fn phrases(data: &[u8]) -> bool {
    let (phrases, vectors) = two_parts(data);
    in_folder(|folder| {
        let (text, tensors) = (folder.join("phrases.txt"), folder.join("x.safetensors"));
        fs_err::write(&text, phrases).expect("the file is written");
        fs_err::write(&tensors, vectors).expect("the file is written");
        let opened = slag_models::phrases::PhraseEncoder::open(3, &text, (&tensors, "vectors"), None);
        opened.is_ok_and(|mut encoder| {
            let vector = encoder.encode("chair").unwrap_or_default();
            assert!(vector.iter().all(|v| v.is_finite()));
            true
        })
    })
}

pub fn contributions(data: &[u8]) -> bool {
    // The entries follow the container.
    let stated = data.get(16..24).map(|b| u64::from_le_bytes(b.try_into().expect("eight bytes")));
    let at = stated.map_or(data.len(), |at| (at as usize).min(data.len()));
    let bytes = [with_checksums(&data[..at]).as_slice(), &data[at..]].concat();
    in_file("x.contributions", &bytes, |path| {
        let opened = ContributionFile::open(path);
        if let Ok((file, regions)) = &opened {
            std::hint::black_box(regions.masks_of_region().map(<[u32]>::len).sum::<usize>());
            for run in 0..file.runs.len() {
                std::hint::black_box(file.entries_of_run(run));
            }
        }
        // As an encode reads it.
        let transposed = ContributionIndex::open(&[path.to_owned()], 2, &[4]).and_then(|(index, table)| {
            let entries = index.read(0..index.parts.len())?;
            index.transpose(&entries, &table)
        });
        is_read(opened, path) & is_read(transposed, path)
    })
}

pub fn region_table(data: &[u8]) -> bool {
    RegionTable::from_bytes(&AlignedBytes::copy_of(&with_checksums(data))).is_ok()
}

pub fn cell_field(data: &[u8]) -> bool {
    CellField::from_bytes(&AlignedBytes::copy_of(&with_checksums(data)), 4).is_ok()
}

pub fn geo(data: &[u8]) -> bool {
    in_file("geo.json", data, |path| {
        let read = read_geo_reference(path);
        assert!(
            read.iter().all(|geo| geo.origin.latitude_deg.abs() <= 90.0 && geo.origin.height_m.is_finite())
        );
        is_read(read, path)
    })
}

pub fn query(data: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(data) else { return false };
    slag_edge::http::parse_query(text).is_ok()
}

/// A text that may name relations, and a phrase as JSON, on a thread with the service's stack size.
pub fn grammar(data: &[u8]) -> bool {
    let text = String::from_utf8_lossy(data).into_owned();
    let read = std::thread::Builder::new().stack_size(2 << 20).spawn(move || {
        let phrases =
            [relations::understand(&text).ok().flatten(), serde_json::from_str::<Phrase>(&text).ok()];
        let phrases = phrases.into_iter().flatten().filter(|phrase| phrase.check().is_ok());
        phrases.inspect(|phrase| assert!(phrase.things().len() <= relations::MAX_THINGS)).count() > 0
    });
    read.expect("a thread").join().expect("no panic")
}

pub fn position(data: &[u8]) -> bool {
    let mut n_accepted = 0;
    let read = slag_edge::fetch::follow::read_positions(data, |_, position| {
        n_accepted += u32::from(position.is_ok());
    });
    read.expect("memory can be read");
    n_accepted > 0
}
