use std::io::Cursor;

use image::Rgb;

use super::*;
use slag_test_support::assert_error;

fn written(format: ImageFormat) -> Vec<u8> {
    let mut random = slag_math::random::Random::new(1);
    let noise = RgbImage::from_fn(96, 64, |_, _| Rgb([random.bits() as u8; 3]));
    let mut bytes = Cursor::new(Vec::new());
    noise.write_to(&mut bytes, format).expect("written");
    bytes.into_inner()
}

fn opened(bytes: &[u8]) -> Result<[u32; 2], PhotoError> {
    open(Cursor::new(bytes)).map(|decoder| decoder.dimensions().into())
}

#[test]
fn what_is_no_whole_photo_is_named() {
    for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::WebP] {
        assert_eq!(opened(&written(format)).expect("whole"), [96, 64], "{format:?}");
    }
    let [jpeg, webp] = [ImageFormat::Jpeg, ImageFormat::WebP].map(written);
    let middle = jpeg.len() / 2;
    let zeros = [&jpeg[..middle], &[0; 300], &jpeg[middle + 300..]].concat();
    let cases: [(&[u8], &str); 8] = [
        (&jpeg[..middle], "ends before"),
        (&webp[..webp.len() / 2], "ends before"),
        (&zeros, "zeros"),
        (b"\0\0\0\x24ftypheic\0\0\0\0mif1heic", "heif-convert"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n", "git lfs pull"),
        (b"<!DOCTYPE html><html></html>", "a web page"),
        (b"hello", "JPEG, PNG or WebP"),
        (b"", "JPEG, PNG or WebP"),
    ];
    for (bytes, expected) in cases {
        assert_error(opened(bytes), &[expected]);
    }
}

/// A colour profile of 65 kB that inflates to 64 MiB, and one that inflates to 2 MiB.
#[test]
fn what_inflates_before_the_pixels_is_bounded() {
    let png = written(ImageFormat::Png);
    let with_profile = |n_bytes: usize| {
        let content = [b"iCCPp\0\0".as_slice(), &deflated_zeros(n_bytes)].concat();
        let len = (content.len() - 4) as u32;
        let checksum = crc32(&content).to_be_bytes();
        // After the signature and the IHDR chunk.
        [&png[..33], &len.to_be_bytes(), &content, &checksum, &png[33..]].concat()
    };
    let bomb = with_profile(64 << 20);
    assert!(bomb.len() < 100_000, "{}", bomb.len());
    let mut decoder = open(Cursor::new(&bomb)).expect("a photo without its profile");
    assert_eq!(decoder.icc_profile().expect("read"), None);
    let mut decoder = open(Cursor::new(with_profile(2 << 20))).expect("a large profile");
    let profile = decoder.icc_profile().expect("read").expect("there");
    assert!((2 << 20..(2 << 20) + 258).contains(&profile.len()), "{}", profile.len());
}

/// Returns zlib data (RFC 1950, 1951) of at least `n_bytes` zeros: one, then copies of 258 zeros in two bits each.
fn deflated_zeros(n_bytes: usize) -> Vec<u8> {
    let n_copies = n_bytes.div_ceil(258);
    let mut bits: Vec<u8> = Vec::new();
    let mut push = |value: u32, n_bits: u32| bits.extend((0..n_bits).map(|at| (value >> at & 1) as u8));
    // The last block, with dynamic codes: 286 for literals and lengths, two for distances, 18 for code lengths.
    [(1, 1), (2, 2), (29, 5), (1, 5), (14, 4)].iter().for_each(|(value, n)| push(*value, *n));
    // Code lengths: 18, a run of zeros, has the code 0, 1 the code 10, and 2 the code 11.
    [0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0, 2].iter().for_each(|length| push(*length, 3));
    // Two bits for the byte 0 and for the end (256); one for the length 258 (285) and for the distances.
    push(0b11, 2);
    [138, 117].iter().for_each(|run| push((run - 11) << 1, 8));
    push(0b11, 2);
    push((28 - 11) << 1, 8);
    (0..3).for_each(|_| push(0b01, 2));
    // The byte, 10; copies, 0 and 0; the end, 11. Codes are written from their first bit.
    push(0b01, 2);
    (0..n_copies).for_each(|_| push(0, 2));
    push(0b11, 2);
    let bytes = bits.chunks(8).map(|bits| bits.iter().rev().fold(0u8, |byte, bit| byte << 1 | *bit));
    // The checksum (Adler-32) of zeros has 1 as its lower half and their number as its upper half.
    let checksum = ((1 + 258 * n_copies) % 65_521) << 16 | 1;
    [0x78, 0x9c].into_iter().chain(bytes).chain((checksum as u32).to_be_bytes()).collect()
}

/// The checksum of PNG (ISO 3309), bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let shifted = |crc: u32, _: u32| (crc >> 1) ^ (0xedb8_8320 * (crc & 1));
    !bytes.iter().fold(!0, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), shifted))
}

#[test]
fn transparent_pixels_lose_their_colours() {
    let mut photo = image::RgbaImage::from_pixel(4, 2, image::Rgba([9, 8, 7, 255]));
    photo.put_pixel(1, 0, image::Rgba([200, 200, 200, 127]));
    let (colours, opaque) = colours(photo.into());
    assert_eq!(opaque.expect("one is hidden"), [0, 1, 2, 3, 4, 5, 6, 7].map(|at| at != 1));
    assert_eq!((colours.get_pixel(1, 0).0, colours.get_pixel(2, 0).0), ([0; 3], [9, 8, 7]));
    assert_eq!(super::colours(DynamicImage::new_rgba8(2, 1)).1, Some(vec![false; 2]));
    assert_eq!(super::colours(DynamicImage::new_rgb8(2, 1)).1, None);
}
