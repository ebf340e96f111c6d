//! SPZ files (nianticlabs/spz): columns of quantised values, in one gzip stream (versions 2 and 3) or in a
//! Zstandard stream per column (version 4).
//!
//! Stored axes are right, up, back; the PLY's are right, down, front, so y and z change sign.

use std::collections::VecDeque;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use flate2::bufread::GzDecoder;
use glam::DVec3;
use ruzstd::decoding::{FrameDecoder, StreamingDecoder};

use super::columns::{ReadOptions, columns, plausible_count};
use super::error::SplatError;
use super::input::Input;
use super::values::{unit_rotation, with_largest};
use crate::Gaussians;

const MAGIC: &[u8; 4] = b"NGSP";
/// Scale of stored colours, instead of [`crate::gaussians::SH_C0`], so that they reach beyond 0..=1.
const COLOUR_SCALE: f64 = 0.15;
const FLAG_EXTENSIONS: u8 = 2;
/// The extension that names the axes, and its value for right, up, back.
const EXTENSION_COORDINATE_SYSTEM: u32 = 0xADBE_0003;
const RIGHT_UP_BACK: u32 = 4;
/// Window size that every Zstandard decoder should accept (RFC 8878, 3.1.1.1.2).
const MIN_WINDOW_BYTES: u64 = 8 << 20;
const ROWS_AT_ONCE: usize = 4096;

/// Signs of the coefficients above degree 0 when y and z change sign: -1 where the powers of y and z in the basis
/// function have an odd sum. Order: y z x, xy yz zz xz xx-yy, then degree 3.
const SH_SIGNS: [f32; 15] =
    [-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];

#[derive(Clone, Copy)]
struct Header {
    version: u32,
    count: u64,
    sh_degree: u8,
    fractional_bits: u8,
    flags: u8,
}

impl Header {
    /// The fixed part of all versions.
    const BYTES: usize = 16;

    /// Parses and checks the header; `place` turns its offsets into places.
    fn parse(path: &Path, raw: &[u8; Self::BYTES], place: fn(u64) -> String) -> Result<Self, SplatError> {
        let word = |i: usize| u32::from_le_bytes([raw[i], raw[i + 1], raw[i + 2], raw[i + 3]]);
        let malformed = |offset, expected: &str, found: String| {
            Err(SplatError::malformed(path, place(offset), expected, found))
        };
        let header = Self {
            version: word(4),
            count: word(8).into(),
            sh_degree: raw[12],
            fractional_bits: raw[13],
            flags: raw[14],
        };
        if raw.starts_with(b"ply") {
            return Err(SplatError::unsupported(path, "a PLY in gzip", "unpack it with `gunzip`"));
        }
        if !raw.starts_with(MAGIC) {
            return malformed(0, "the magic \"NGSP\" of SPZ", format!("{:02x?}", &raw[..4]));
        }
        if !(2..=4).contains(&header.version) {
            let format = format_args!("SPZ version {}", header.version);
            return Err(SplatError::unsupported(path, format, "export it as SPZ 2, 3 or 4, or as PLY"));
        }
        if header.sh_degree > 4 {
            return malformed(12, "a degree of spherical harmonics of 0 to 4", header.sh_degree.to_string());
        }
        if header.fractional_bits > 24 {
            return malformed(13, "0 to 24 fractional bits", header.fractional_bits.to_string());
        }
        Ok(header)
    }

    /// Bytes per Gaussian of each column: position, opacity, colour, scale, rotation and, from degree 1, harmonics.
    fn row_bytes(&self) -> VecDeque<usize> {
        let rotation = if self.version == 2 { 3 } else { 4 };
        let sh = 3 * Gaussians::sh_rest_per_channel(self.sh_degree);
        [9, 1, 3, 3, rotation, sh].into_iter().filter(|bytes| *bytes > 0).collect()
    }
}

/// The columns still to be read, in the order of the file.
struct Columns {
    path: PathBuf,
    count: usize,
    row_bytes: VecDeque<usize>,
    payload: Payload,
}

enum Payload {
    /// One stream; bytes read so far.
    Whole { stream: Box<dyn Read>, offset_bytes: u64 },
    /// A stream per column; compressed sizes of those to come.
    Streams { input: Input, compressed_bytes: VecDeque<u64> },
}

impl Columns {
    /// Passes the rows of the next column on in fields of `N` bytes.
    fn each<const N: usize>(&mut self, mut row: impl FnMut([u8; N])) -> Result<(), SplatError> {
        let row_bytes = self.row_bytes.pop_front().unwrap_or(0);
        let total = row_bytes as u64 * self.count as u64;
        let mut fields = |bytes: &[u8]| bytes.as_chunks::<N>().0.iter().for_each(|field| row(*field));
        match &mut self.payload {
            Payload::Whole { stream, offset_bytes } => {
                read_rows(stream, total, row_bytes, &mut fields).map_err(|cause| {
                    SplatError::undecodable(&self.path, decompressed(*offset_bytes), "a column", cause)
                })?;
                *offset_bytes += total;
                Ok(())
            }
            Payload::Streams { input, compressed_bytes } => {
                let place = input.place();
                let compressed = compressed_bytes.pop_front().unwrap_or(0);
                let mut stream = input.take(compressed);
                read_frame(&mut stream, total, row_bytes, &mut fields)
                    .map_err(|source| SplatError::undecodable(&self.path, place, "a column", source))?;
                let left = stream.limit();
                input.skip(left, "a column")
            }
        }
    }
}

fn byte(offset: u64) -> String {
    format!("byte {offset}")
}

fn decompressed(offset: u64) -> String {
    format!("byte {offset} of the decompressed data")
}

/// Reads `total` bytes in chunks of whole rows.
fn read_rows(
    stream: &mut impl Read,
    total: u64,
    row_bytes: usize,
    each: &mut impl FnMut(&[u8]),
) -> io::Result<()> {
    let mut buffer = vec![0; row_bytes * ROWS_AT_ONCE];
    let mut left = total;
    while left > 0 {
        let n = left.min(buffer.len() as u64);
        let part = &mut buffer[..n as usize];
        stream.read_exact(part)?;
        each(part);
        left -= n;
    }
    Ok(())
}

/// Reads a Zstandard frame that holds exactly `total` bytes.
fn read_frame(
    stream: &mut impl Read,
    total: u64,
    row_bytes: usize,
    each: &mut impl FnMut(&[u8]),
) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let mut frame = FrameDecoder::new();
    frame.set_max_window_size(total.max(MIN_WINDOW_BYTES));
    let mut decoder = StreamingDecoder::new_with_decoder(stream, frame)?;
    read_rows(&mut decoder, total, row_bytes, each)?;
    if decoder.read(&mut [0])? > 0 {
        return Err(format!("more than the {total} bytes of the table of contents").into());
    }
    let frame = decoder.into_frame_decoder();
    match frame.get_checksum_from_data() {
        Some(stored) if Some(stored) != frame.get_calculated_checksum() => Err("wrong checksum".into()),
        _ => Ok(()),
    }
}

/// Reads an SPZ file; spherical harmonics of degree 4 are dropped.
pub(super) fn read(mut input: Input, options: ReadOptions) -> Result<Gaussians, SplatError> {
    let path = input.path().to_path_buf();
    let len_bytes = input.len_bytes();
    let is_gzip = input.peek(4)? != MAGIC;
    let mut raw = [0; Header::BYTES];
    if is_gzip {
        let mut stream = GzDecoder::new(input);
        stream
            .read_exact(&mut raw)
            .map_err(|cause| SplatError::undecodable(&path, "byte 0", "the gzip stream", cause))?;
        let header = Header::parse(&path, &raw, decompressed)?;
        return read_whole(path, header, Box::new(stream), len_bytes, options);
    }
    input.fill(&mut raw, "the SPZ header")?;
    let header = Header::parse(&path, &raw, byte)?;
    if header.version < 4 {
        return read_whole(path, header, Box::new(input), len_bytes, options);
    }

    let row_bytes = header.row_bytes();
    let compressed_bytes = read_contents(&mut input, &raw, &header, &row_bytes)?;
    let degree = options.kept_degree(header.sh_degree);
    let count = plausible_count(&path, "byte 8", header.count, degree, len_bytes)?;
    let payload = Payload::Streams { input, compressed_bytes };
    decode(&header, &mut Columns { path, count, row_bytes, payload }, columns(count, degree))
}

/// Reads the rest of versions 2 and 3 after the header.
fn read_whole(
    path: PathBuf,
    header: Header,
    stream: Box<dyn Read>,
    len_bytes: u64,
    options: ReadOptions,
) -> Result<Gaussians, SplatError> {
    if header.version > 3 {
        return Err(SplatError::malformed(&path, decompressed(4), "SPZ version 2 or 3 in gzip", 4));
    }
    let degree = options.kept_degree(header.sh_degree);
    let count = plausible_count(&path, decompressed(8), header.count, degree, len_bytes)?;
    let payload = Payload::Whole { stream, offset_bytes: Header::BYTES as u64 };
    let mut stored = Columns { path, count, row_bytes: header.row_bytes(), payload };
    let out = decode(&header, &mut stored, columns(count, degree))?;
    while !stored.row_bytes.is_empty() {
        stored.each(|[_]: [u8; 1]| {})?;
    }
    let Columns { path, payload: Payload::Whole { mut stream, offset_bytes }, .. } = stored else {
        unreachable!("built as a whole stream above");
    };
    let place = decompressed(offset_bytes);
    if header.flags & FLAG_EXTENSIONS != 0 {
        check_extensions(&path, &place, &mut stream)?;
    }
    // Read to the end, where gzip's checksum is.
    match io::copy(&mut stream, &mut io::sink()) {
        Ok(0) => Ok(out),
        // A wrong count in the header moves the columns.
        Ok(n) => {
            Err(SplatError::malformed(&path, place, "the end of the stream", format_args!("{n} more bytes")))
        }
        Err(source) => Err(SplatError::undecodable(&path, place, "the end of the stream", source)),
    }
}

/// Reads and checks what precedes the streams of version 4: rest of the header, extensions, table of contents.
/// Returns the compressed size of each stream.
fn read_contents(
    input: &mut Input,
    raw: &[u8; Header::BYTES],
    header: &Header,
    row_bytes: &VecDeque<usize>,
) -> Result<VecDeque<u64>, SplatError> {
    let path = input.path().to_path_buf();
    let n_streams = usize::from(raw[15]);
    if n_streams != row_bytes.len() {
        let expected = format_args!("{} streams at degree {}", row_bytes.len(), header.sh_degree);
        return Err(SplatError::malformed(&path, "byte 15", expected, n_streams));
    }
    let mut rest = [0; 16];
    input.fill(&mut rest, "the SPZ header")?;
    let toc_offset = u32::from_le_bytes([rest[0], rest[1], rest[2], rest[3]]);
    let Some(extension_bytes) = toc_offset.checked_sub(32) else {
        let expected = "a table of contents from byte 32 on";
        return Err(SplatError::malformed(&path, "byte 16", expected, toc_offset));
    };
    input.require(extension_bytes.into(), "extensions")?;
    let mut extensions = input.take(extension_bytes.into());
    if header.flags & FLAG_EXTENSIONS != 0 {
        check_extensions(&path, "byte 32", &mut extensions)?;
    }
    let left = extensions.limit();
    input.skip(left, "extensions")?;

    let mut compressed_bytes = VecDeque::new();
    for bytes in row_bytes {
        let place = input.place();
        let mut sizes = [0; 16];
        input.fill(&mut sizes, "the table of contents")?;
        let [compressed, decompressed] =
            [0, 8].map(|at| u64::from_le_bytes(std::array::from_fn(|i| sizes[at + i])));
        let expected = *bytes as u64 * header.count;
        if decompressed != expected {
            let expected = format_args!("a stream of {expected} bytes");
            return Err(SplatError::malformed(&path, place, expected, decompressed));
        }
        compressed_bytes.push_back(compressed);
    }
    let total = compressed_bytes.iter().fold(0_u64, |sum, bytes| sum.saturating_add(*bytes));
    input.require(total, "streams")?;
    Ok(compressed_bytes)
}

/// Reads extension records (type, length, content) to the end; refuses coordinate systems other than right, up, back.
fn check_extensions(path: &Path, place: &str, stream: &mut impl Read) -> Result<(), SplatError> {
    let failed = |cause| SplatError::undecodable(path, place, "the extensions", cause);
    loop {
        let mut head = Vec::new();
        stream.take(8).read_to_end(&mut head).map_err(failed)?;
        let Ok([a, b, c, d, len @ ..]) = <[u8; 8]>::try_from(head) else { return Ok(()) };
        let mut content = stream.take(u32::from_le_bytes(len).into());
        if u32::from_le_bytes([a, b, c, d]) == EXTENSION_COORDINATE_SYSTEM {
            let mut system = [0; 4];
            content.read_exact(&mut system).map_err(failed)?;
            let system = u32::from_le_bytes(system);
            if system != 0 && system != RIGHT_UP_BACK {
                let format = format_args!("SPZ coordinate system {system}");
                let advice = "export it with the axes right, up, back (RUB), or as PLY";
                return Err(SplatError::unsupported(path, format, advice));
            }
        }
        io::copy(&mut content, &mut io::sink()).map_err(failed)?;
    }
}

/// Decodes the columns into `out`, whose degree limits the harmonics that are kept.
fn decode(header: &Header, columns: &mut Columns, mut out: Gaussians) -> Result<Gaussians, SplatError> {
    let step = (-f64::from(header.fractional_bits)).exp2();
    columns.each(|[x0, x1, x2, y0, y1, y2, z0, z1, z2]| {
        // The shift brings the sign of 24 bits to the top and back.
        let fixed = |bytes| f64::from(i32::from_le_bytes(bytes) >> 8) * step;
        out.means_in_world.push(DVec3::new(
            fixed([0, x0, x1, x2]),
            -fixed([0, y0, y1, y2]),
            -fixed([0, z0, z1, z2]),
        ));
    })?;
    columns.each(|[alpha]| out.opacities.push((f64::from(alpha) / 255.0) as f32))?;
    columns.each(|rgb: [u8; 3]| {
        out.sh_dc.push(rgb.map(|c| ((f64::from(c) / 255.0 - 0.5) / COLOUR_SCALE) as f32));
    })?;
    columns.each(|log: [u8; 3]| out.scales.push(log.map(|s| (f64::from(s) / 16.0 - 10.0).exp() as f32)))?;
    let mut push_rotation = |[w, x, y, z]: [f64; 4]| out.rotations_wxyz.push(unit_rotation([w, x, -y, -z]));
    if header.version == 2 {
        columns
            .each(|xyz: [u8; 3]| push_rotation(with_largest(0, xyz.map(|q| f64::from(q) / 127.5 - 1.0))))?;
    } else {
        columns.each(|bytes| push_rotation(smallest_three(u32::from_le_bytes(bytes))))?;
    }
    if out.sh_degree > 0 {
        let stored = Gaussians::sh_rest_per_channel(header.sh_degree);
        let kept = Gaussians::sh_rest_per_channel(out.sh_degree);
        let mut coefficient = 0;
        columns.each(|rgb: [u8; 3]| {
            if coefficient < kept {
                let sign = SH_SIGNS[coefficient] / 128.0;
                out.sh_rest.extend(rgb.map(|c| (f32::from(c) - 128.0) * sign));
            }
            coefficient = (coefficient + 1) % stored;
        })?;
    }
    Ok(out)
}

/// Unpacks a rotation `wxyz`: the index of its largest component (of x y z w) in two bits, and a sign and nine
/// bits of magnitude, 0..=1/sqrt(2), for each of the others.
fn smallest_three(word: u32) -> [f64; 4] {
    let others = [20, 10, 0].map(|shift| {
        let magnitude = f64::from((word >> shift) & 0x1ff) / 511.0 * std::f64::consts::FRAC_1_SQRT_2;
        if (word >> shift) & 0x200 != 0 { -magnitude } else { magnitude }
    });
    let [x, y, z, w] = with_largest((word >> 30) as usize, others);
    [w, x, y, z]
}
