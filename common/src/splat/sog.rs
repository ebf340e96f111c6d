//! SOG (PlayCanvas): a `meta.json` and lossless WebP images with a pixel per Gaussian, in a folder or a ZIP
//! bundle. Version 2 maps bytes through codebooks; version 1 (without `version`) maps them to ranges.

use std::io::{BufReader, Cursor, Read};
use std::ops::RangeInclusive;
use std::path::{Component, Path, PathBuf};

use glam::DVec3;
use image::ImageDecoder;
use image::codecs::webp::WebPDecoder;
use serde::Deserialize;
use zip::ZipArchive;

use super::columns::{MAX_SH_DEGREE, ReadOptions, columns, plausible_count};
use super::error::SplatError;
use super::values::{sigmoid, unit_rotation, with_largest};
use crate::{Gaussians, files};

/// Meta files take about 15 kB, mostly three codebooks of 256 numbers.
const MAX_META_BYTES: u64 = 1 << 20;
/// Images may exceed the count: their last row is filled up, or they are squares of a power of two.
const SPARE_PIXELS: u64 = 1 << 16;
/// Entries per row of the harmonics' codebook, which has at most 65,536 entries: labels have 16 bits.
const CODEBOOK_COLUMNS: usize = 64;
const MAX_CODEBOOK_ROWS: u64 = 1024;
/// Alpha of a rotation's pixel if the first component is the largest; 253 to 255 for the others.
const ROTATION_TAG: u8 = 252;

#[derive(Deserialize)]
struct Meta {
    version: Option<u64>,
    count: Option<u64>,
    means: Means,
    scales: Quantised,
    quats: Files,
    sh0: Quantised,
    #[serde(rename = "shN")]
    sh_rest: Option<Quantised>,
}

#[derive(Deserialize)]
struct Means {
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
    /// Holds the count in version 1.
    shape: Option<Vec<u64>>,
}

#[derive(Deserialize)]
struct Files {
    files: Vec<String>,
}

/// The map from bytes to numbers: a codebook (version 2), or a range per channel (version 1).
#[derive(Deserialize)]
struct Quantised {
    codebook: Option<Vec<Option<f64>>>,
    mins: Option<OneOrMany>,
    maxs: Option<OneOrMany>,
    files: Vec<String>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum OneOrMany {
    One(f64),
    Many(Vec<f64>),
}

impl OneOrMany {
    fn get(&self, channel: usize) -> Option<f64> {
        match self {
            Self::One(value) => Some(*value),
            Self::Many(values) => values.get(channel).copied(),
        }
    }
}

impl Quantised {
    /// Returns the number of each byte of a channel; NaN, hence unusable Gaussians, beyond a short codebook's end.
    fn table(&self, channel: usize) -> Option<[f64; 256]> {
        if let Some(codebook) = &self.codebook {
            let mut table = [f64::NAN; 256];
            for (value, entry) in table.iter_mut().zip(codebook) {
                *value = entry.unwrap_or(f64::NAN);
            }
            // Some exporters write null as the first entry; PlayCanvas extrapolates so.
            if codebook.first() == Some(&None) {
                table[0] = table[1] + (table[1] - table[255]) / 255.0;
            }
            return Some(table);
        }
        let (min, max) = (self.mins.as_ref()?.get(channel)?, self.maxs.as_ref()?.get(channel)?);
        Some(std::array::from_fn(|byte| min + (max - min) * (byte as f64 / 255.0)))
    }
}

enum Parts {
    Folder(PathBuf),
    Bundle(Box<ZipArchive<BufReader<fs_err::File>>>),
}

struct Sog {
    /// Bundle or meta file, named in errors.
    path: PathBuf,
    parts: Parts,
    len_bytes: u64,
    /// Of the first image with a pixel for each Gaussian.
    width: Option<usize>,
}

struct Pixels {
    width: usize,
    rgba: Vec<u8>,
}

impl Pixels {
    fn get(&self, index: usize) -> [u8; 4] {
        self.rgba.as_chunks().0[index]
    }

    fn iter(&self, count: usize) -> impl Iterator<Item = [u8; 4]> {
        self.rgba.as_chunks().0.iter().copied().take(count)
    }
}

pub(super) fn read_folder(meta_path: &Path, options: ReadOptions) -> Result<Gaussians, SplatError> {
    let folder = meta_path.parent().unwrap_or(Path::new("")).to_path_buf();
    let len_bytes = files::metadata(meta_path)?.len();
    let name = meta_path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut sog = Sog { path: meta_path.into(), parts: Parts::Folder(folder), len_bytes, width: None };
    let meta = sog.meta(&name)?;
    for file in meta.files() {
        sog.len_bytes += files::metadata(&sog.path_in_folder(file)?)?.len();
    }
    sog.decode(&meta, options)
}

pub(super) fn read_bundle(path: &Path, options: ReadOptions) -> Result<Gaussians, SplatError> {
    let file = files::open(path)?;
    let len_bytes = file.metadata()?.len();
    let archive = ZipArchive::new(BufReader::new(file))
        .map_err(|cause| SplatError::undecodable(path, "byte 0", "the ZIP directory", cause))?;
    if archive.index_for_name("meta.json").is_none() {
        let format = "a ZIP file without the meta.json of SOG";
        return Err(SplatError::unsupported(path, format, "unpack it and give the splat inside"));
    }
    let mut sog = Sog { path: path.into(), parts: Parts::Bundle(Box::new(archive)), len_bytes, width: None };
    let meta = sog.meta("meta.json")?;
    sog.decode(&meta, options)
}

impl Meta {
    fn files(&self) -> impl Iterator<Item = &String> {
        let rest = self.sh_rest.iter().flat_map(|sh| &sh.files);
        let all = [&self.means.files[..], &self.scales.files, &self.quats.files, &self.sh0.files];
        all.into_iter().flatten().chain(rest)
    }
}

impl Sog {
    fn malformed(
        &self,
        part: &str,
        expected: impl std::fmt::Display,
        found: impl std::fmt::Display,
    ) -> SplatError {
        SplatError::malformed(&self.path, part, expected, found)
    }

    fn undecodable(&self, part: &str, what: &str, cause: impl std::fmt::Display) -> SplatError {
        SplatError::undecodable(&self.path, part, what, cause)
    }

    /// Returns the path of a part, which must lie directly in the folder.
    fn path_in_folder(&self, part: &str) -> Result<PathBuf, SplatError> {
        let mut components = Path::new(part).components();
        match (&self.parts, components.next(), components.next()) {
            (Parts::Folder(folder), Some(Component::Normal(name)), None) => Ok(folder.join(name)),
            _ => Err(self.malformed("meta.json", "plain file names", format_args!("{part:?}"))),
        }
    }

    fn bytes(&mut self, part: &str, max_bytes: u64) -> Result<Vec<u8>, SplatError> {
        let mut bytes = Vec::new();
        if let Parts::Bundle(archive) = &mut self.parts {
            let read = archive.by_name(part).map_err(std::io::Error::from);
            let read = read.and_then(|entry| entry.take(max_bytes + 1).read_to_end(&mut bytes));
            read.map_err(|cause| self.undecodable(part, "the part", cause))?;
        } else {
            let file = files::open(&self.path_in_folder(part)?)?;
            file.take(max_bytes + 1).read_to_end(&mut bytes)?;
        }
        if bytes.len() as u64 > max_bytes {
            return Err(self.malformed(part, format_args!("at most {max_bytes} bytes"), "more"));
        }
        Ok(bytes)
    }

    fn meta(&mut self, part: &str) -> Result<Meta, SplatError> {
        let bytes = self.bytes(part, MAX_META_BYTES)?;
        let text = files::text_of(&bytes).map_err(|fault| SplatError::at(&self.path, part, fault))?;
        serde_json::from_str(text).map_err(|cause| self.undecodable(part, "the meta data", cause))
    }

    /// Returns an image with a pixel for each Gaussian; all of these have one size.
    fn of_gaussians(
        &mut self,
        files: &[String],
        index: usize,
        n_pixels: RangeInclusive<u64>,
    ) -> Result<Pixels, SplatError> {
        let pixels = self.pixels(files, index, n_pixels)?;
        let width = *self.width.get_or_insert(pixels.width);
        if pixels.width != width {
            let expected = format_args!("{width} pixels a row, as in the other images");
            return Err(self.malformed(&files[index], expected, pixels.width));
        }
        Ok(pixels)
    }

    /// Returns the image at `index` of `files`; its number of pixels must lie in `n_pixels`.
    fn pixels(
        &mut self,
        files: &[String],
        index: usize,
        n_pixels: RangeInclusive<u64>,
    ) -> Result<Pixels, SplatError> {
        let Some(part) = files.get(index) else {
            return Err(self.malformed("meta.json", format_args!("{} files", index + 1), files.len()));
        };
        // Lossless WebP takes four bytes per pixel if nothing compresses.
        let bytes = self.bytes(part, n_pixels.end() * 5 + SPARE_PIXELS)?;
        if !is_lossless_webp(&bytes) {
            return Err(self.malformed(part, "a lossless WebP image", "another image"));
        }
        let undecodable = |cause| self.undecodable(part, "the image", cause);
        let decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(undecodable)?;
        let (width, height) = decoder.dimensions();
        if !n_pixels.contains(&(u64::from(width) * u64::from(height))) {
            let expected = format_args!("{} to {} pixels", n_pixels.start(), n_pixels.end());
            return Err(self.malformed(part, expected, format_args!("{width} x {height}")));
        }
        let channels = usize::from(decoder.color_type().channel_count());
        let mut image = vec![0; decoder.total_bytes() as usize];
        decoder.read_image(&mut image).map_err(undecodable)?;
        let rgba = match channels {
            4 => image,
            _ => image.as_chunks().0.iter().flat_map(|[r, g, b]| [*r, *g, *b, 255]).collect(),
        };
        Ok(Pixels { width: width as usize, rgba })
    }

    fn tables<const N: usize>(
        &self,
        name: &str,
        quantised: &Quantised,
    ) -> Result<[[f64; 256]; N], SplatError> {
        let mut tables = [[0.0; 256]; N];
        for (channel, table) in tables.iter_mut().enumerate() {
            let expected = format_args!("`codebook`, or `mins` and `maxs`, in {name:?}");
            let missing = || self.malformed("meta.json", expected, "neither");
            *table = quantised.table(channel).ok_or_else(missing)?;
        }
        Ok(tables)
    }

    fn count(&self, meta: &Meta) -> Result<u64, SplatError> {
        let stated = match meta.version {
            None => meta.means.shape.as_ref().and_then(|shape| shape.first()).copied(),
            Some(2) => meta.count,
            Some(version) => {
                let format = format_args!("SOG version {version}");
                let advice = "export it as SOG version 2, or as PLY";
                return Err(SplatError::unsupported(&self.path, format, advice));
            }
        };
        stated.ok_or_else(|| self.malformed("meta.json", "the number of Gaussians (`count`)", "none"))
    }

    fn decode(&mut self, meta: &Meta, options: ReadOptions) -> Result<Gaussians, SplatError> {
        let is_v1 = meta.version.is_none();
        let count = self.count(meta)?;
        let degree = if options.with_sh_rest && meta.sh_rest.is_some() { MAX_SH_DEGREE } else { 0 };
        let n = plausible_count(&self.path, "meta.json", count, degree, self.len_bytes)?;
        let n_pixels = count..=count.saturating_mul(2) + SPARE_PIXELS;
        let mut out = columns(n, 0);

        self.decode_means(meta, n_pixels.clone(), &mut out, n)?;
        self.decode_rotations(meta, n_pixels.clone(), &mut out, n)?;

        let tables: [_; 3] = self.tables("scales", &meta.scales)?;
        let scales = self.of_gaussians(&meta.scales.files, 0, n_pixels.clone())?;
        out.scales.extend(
            scales
                .iter(n)
                .map(|codes| std::array::from_fn(|axis| tables[axis][usize::from(codes[axis])].exp() as f32)),
        );
        drop(scales);

        let tables: [_; 3] = self.tables("sh0", &meta.sh0)?;
        let sh0 = self.of_gaussians(&meta.sh0.files, 0, n_pixels.clone())?;
        out.sh_dc.extend(sh0.iter(n).map(|codes| -> [f32; 3] {
            std::array::from_fn(|channel| tables[channel][usize::from(codes[channel])] as f32)
        }));
        if is_v1 {
            let [.., logits]: [_; 4] = self.tables("sh0", &meta.sh0)?;
            out.opacities.extend(sh0.iter(n).map(|codes| sigmoid(logits[usize::from(codes[3])])));
        } else {
            out.opacities.extend(sh0.iter(n).map(|codes| (f64::from(codes[3]) / 255.0) as f32));
        }
        drop(sh0);

        if let Some(sh_rest) = meta.sh_rest.as_ref().filter(|_| options.with_sh_rest) {
            self.decode_sh_rest(sh_rest, n, n_pixels, &mut out)?;
        }
        Ok(out)
    }

    fn decode_means(
        &mut self,
        meta: &Meta,
        n_pixels: RangeInclusive<u64>,
        out: &mut Gaussians,
        n: usize,
    ) -> Result<(), SplatError> {
        let low = self.of_gaussians(&meta.means.files, 0, n_pixels.clone())?;
        let high = self.of_gaussians(&meta.means.files, 1, n_pixels)?;
        out.means_in_world.extend(low.iter(n).zip(high.iter(n)).map(|(low, high)| {
            DVec3::from_array(std::array::from_fn(|axis| {
                let unit = f64::from(u16::from_le_bytes([low[axis], high[axis]])) / 65535.0;
                let (min, max) = (meta.means.mins[axis], meta.means.maxs[axis]);
                // The stored value is sign(x) ln(|x| + 1).
                let log = min + (max - min) * unit;
                log.abs().exp_m1().copysign(log)
            }))
        }));
        Ok(())
    }

    fn decode_rotations(
        &mut self,
        meta: &Meta,
        n_pixels: RangeInclusive<u64>,
        out: &mut Gaussians,
        n: usize,
    ) -> Result<(), SplatError> {
        let quats = self.of_gaussians(&meta.quats.files, 0, n_pixels)?;
        let behind = quats.rgba.as_chunks::<4>().0.get(n..).unwrap_or_default();
        // Padding pixels are all equal.
        if behind.iter().any(|pixel| *pixel != behind[0] && pixel[3] >= ROTATION_TAG) {
            let expected = "a number of Gaussians (`count`) that takes in all those of the images";
            return Err(self.malformed("meta.json", expected, format_args!("{n}, and more behind them")));
        }
        out.rotations_wxyz.extend(quats.iter(n).map(|[a, b, c, tag]| match tag.checked_sub(ROTATION_TAG) {
            Some(largest) => {
                let others =
                    [a, b, c].map(|q| (f64::from(q) / 127.5 - 1.0) * std::f64::consts::FRAC_1_SQRT_2);
                unit_rotation(with_largest(largest.into(), others))
            }
            None => [0.0; 4],
        }));
        Ok(())
    }

    /// Decodes the harmonics: each Gaussian has a label, a run of pixels in the codebook.
    fn decode_sh_rest(
        &mut self,
        sh_rest: &Quantised,
        count: usize,
        n_pixels: RangeInclusive<u64>,
        out: &mut Gaussians,
    ) -> Result<(), SplatError> {
        let [table]: [_; 1] = self.tables("shN", sh_rest)?;
        let widest = CODEBOOK_COLUMNS * Gaussians::sh_rest_per_channel(MAX_SH_DEGREE);
        let codebook = self.pixels(&sh_rest.files, 0, 1..=widest as u64 * MAX_CODEBOOK_ROWS)?;
        let Some(degree) = (1..=MAX_SH_DEGREE)
            .find(|degree| codebook.width == CODEBOOK_COLUMNS * Gaussians::sh_rest_per_channel(*degree))
        else {
            return Err(self.malformed("shN", "a codebook 192, 512 or 960 pixels wide", codebook.width));
        };
        let per_channel = Gaussians::sh_rest_per_channel(degree);
        let n_entries = codebook.rgba.len() / 4 / per_channel;
        let labels = self.of_gaussians(&sh_rest.files, 1, n_pixels)?;
        out.sh_degree = degree;
        out.sh_rest.reserve_exact(count * 3 * per_channel);
        for [low, high, ..] in labels.iter(count) {
            let label = usize::from(u16::from_le_bytes([low, high]));
            if label >= n_entries {
                return Err(self.malformed("shN", format_args!("labels below {n_entries}"), label));
            }
            for pixel in label * per_channel..(label + 1) * per_channel {
                let [r, g, b, _] = codebook.get(pixel);
                out.sh_rest.extend([r, g, b].map(|code| table[usize::from(code)] as f32));
            }
        }
        Ok(())
    }
}

/// Returns whether a WebP file holds a lossless image and nothing lossy or animated.
fn is_lossless_webp(bytes: &[u8]) -> bool {
    let Some((b"RIFF", mut chunks)) = bytes
        .split_at_checked(4)
        .and_then(|(riff, rest)| Some((<&[u8; 4]>::try_from(riff).ok()?, rest.get(8..)?)))
    else {
        return false;
    };
    let mut is_lossless = false;
    while let Some(([a, b, c, d, l0, l1, l2, l3], rest)) = chunks.split_first_chunk::<8>() {
        match &[*a, *b, *c, *d] {
            b"VP8L" => is_lossless = true,
            b"VP8 " | b"ANMF" => return false,
            _ => {}
        }
        let len = u32::from_le_bytes([*l0, *l1, *l2, *l3]) as usize;
        chunks = rest.get(len.saturating_add(len % 2)..).unwrap_or_default();
    }
    is_lossless
}
