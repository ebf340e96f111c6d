//! Errors and output files of generation.

use std::path::PathBuf;

use slag_common::splat::SplatError;

use super::grammar::GrammarError;

/// Error of writing generated data.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// A file cannot be written.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The splat cannot be written.
    #[error(transparent)]
    Splat(#[from] SplatError),
    /// The object files cannot be used.
    #[error(transparent)]
    Grammar(#[from] GrammarError),
    /// A folder is not a scene to copy.
    #[error("{}: {what}", path.display())]
    Source {
        /// The folder.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// A picture cannot be written.
    #[error("{}: {source}", path.display())]
    Image {
        /// The picture.
        path: PathBuf,
        /// The reason.
        source: image::ImageError,
    },
}

#[cfg(test)]
mod tests {
    use slag_common::npy;

    /// Oracle: another program's reader of the format.
    #[test]
    fn arrays_are_read_by_another_reader() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("array.npy");
        let values: Vec<u16> = (0..30).map(|i| i * 2003).collect();
        npy::write_file(&path, &[5, 2, 3], &values).expect("writes");
        let bytes = fs_err::read(&path).expect("reads");
        let array = npyz::NpyFile::new(&bytes[..]).expect("an array");
        assert_eq!(array.shape(), [5, 2, 3]);
        assert_eq!(array.into_vec::<u16>().expect("u16"), values);
        for n in [0usize, 1, 70, 1000] {
            let values: Vec<f32> = (0..n).map(|i| i as f32 * 0.5).collect();
            let mut bytes = Vec::new();
            npy::write(&mut bytes, &[n], &values).expect("writes to memory");
            let array = npyz::NpyFile::new(&bytes[..]).expect("an array");
            assert_eq!(array.shape(), [n as u64]);
            assert_eq!(array.into_vec::<f32>().expect("f32"), values);
        }
    }
}
