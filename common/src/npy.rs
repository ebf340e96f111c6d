//! NumPy arrays (`.npy` version 1.0), written.

use std::io::{self, Write};
use std::path::Path;

use bytemuck::NoUninit;

use crate::durable;

pub trait Element: NoUninit {
    /// Its NumPy description: byte order, kind and size.
    const DESCRIPTION: &str;
}

impl Element for u8 {
    const DESCRIPTION: &str = "|u1";
}

impl Element for u16 {
    const DESCRIPTION: &str = "<u2";
}

impl Element for f32 {
    const DESCRIPTION: &str = "<f4";
}

pub fn write_file<T: Element>(path: &Path, shape: &[usize], values: &[T]) -> io::Result<()> {
    durable::write_result(path, |file| write(file, shape, values))
}

/// Writes an array, row-major and little-endian.
pub fn write<T: Element>(mut out: impl Write, shape: &[usize], values: &[T]) -> io::Result<()> {
    assert_eq!(values.len(), shape.iter().product::<usize>(), "values of an array of {shape:?}");
    // Python writes a trailing comma in a tuple of one element.
    let shape = match shape {
        [n] => format!("({n},)"),
        shape => format!("({})", shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")),
    };
    let mut header = format!("{{'descr': '{}', 'fortran_order': False, 'shape': {shape}, }}", T::DESCRIPTION);
    // Magic, version and length take 10 bytes; the total is a multiple of 64 and ends in a newline.
    let padding = 63 - (10 + header.len()) % 64;
    header.extend(std::iter::repeat_n(' ', padding));
    header.push('\n');
    out.write_all(b"\x93NUMPY\x01\x00")?;
    out.write_all(&(header.len() as u16).to_le_bytes())?;
    out.write_all(header.as_bytes())?;
    out.write_all(bytemuck::cast_slice(values))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written<T: Element>(shape: &[usize], values: &[T]) -> Vec<u8> {
        let mut bytes = Vec::new();
        write(&mut bytes, shape, values).expect("writes to memory");
        bytes
    }

    /// Oracle: NumPy's format specification, by hand.
    #[test]
    fn arrays_have_the_specified_bytes() {
        let cases = [
            (
                written(&[3], &[1.0f32, -2.0, 0.5]),
                "{'descr': '<f4', 'fortran_order': False, 'shape': (3,), }",
                &[0, 0, 128, 63, 0, 0, 0, 192, 0, 0, 0, 63][..],
            ),
            (
                written(&[2, 1, 2], &[1u16, 258, 3, 65535]),
                "{'descr': '<u2', 'fortran_order': False, 'shape': (2, 1, 2), }",
                &[1, 0, 2, 1, 3, 0, 255, 255],
            ),
            (written::<u8>(&[0], &[]), "{'descr': '|u1', 'fortran_order': False, 'shape': (0,), }", &[]),
            (written(&[], &[7u8]), "{'descr': '|u1', 'fortran_order': False, 'shape': (), }", &[7]),
        ];
        for (bytes, header, data) in cases {
            // 10 bytes, 117 of header and padding, and the newline.
            assert_eq!(&bytes[..10], b"\x93NUMPY\x01\x00\x76\x00", "{header}");
            assert_eq!(String::from_utf8_lossy(&bytes[10..128]), format!("{header:<117}\n"));
            assert_eq!(&bytes[128..], data, "{header}");
        }
    }

    /// Data begins at a multiple of 64 bytes, however long the header.
    #[test]
    fn data_are_aligned() {
        for n_axes in 1..40 {
            let bytes = written(&vec![1; n_axes], &[9u8]);
            assert_eq!((bytes.len() % 64, bytes.last(), bytes[bytes.len() - 2]), (1, Some(&9), b'\n'));
        }
    }
}
