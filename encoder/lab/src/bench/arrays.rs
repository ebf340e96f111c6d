//! Reads arrays from a NumPy archive.

use std::io;
use std::path::{Path, PathBuf};

use npyz::{DType, Deserialize, NpyFile};
use slag_common::npz::Npz;

/// Error of reading a recorded scene.
#[derive(Debug, thiserror::Error)]
pub enum FixtureError {
    /// The file cannot be read, or is not a NumPy archive.
    #[error("{}: {source}; expected a NumPy archive (.npz)", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: io::Error,
    },
    /// An array is missing.
    #[error("{}: no array {array:?}; add it to the archive", path.display())]
    Missing {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        array: &'static str,
    },
    /// An array has the wrong type or size.
    #[error("{}: array {array:?} is {found}, expected {expected}; write the archive again", path.display())]
    Array {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        array: &'static str,
        /// Its type or size.
        found: String,
        /// The type or size that it should have.
        expected: String,
    },
}

/// An open archive.
pub struct Arrays {
    path: PathBuf,
    archive: Npz,
}

impl Arrays {
    /// Opens an archive.
    ///
    /// # Errors
    /// [`FixtureError::Io`].
    pub fn open(path: &Path) -> Result<Self, FixtureError> {
        let io = |source| FixtureError::Io { path: path.to_owned(), source };
        let archive = Npz::open(path).map_err(io)?;
        Ok(Self { path: path.to_owned(), archive })
    }

    /// Returns an array as rows of `N` numbers. There must be `n_rows` of them, or at least one where that is `None`.
    ///
    /// # Errors
    /// [`FixtureError`].
    pub fn rows<const N: usize>(
        &mut self,
        array: &'static str,
        n_rows: Option<usize>,
    ) -> Result<Vec<[f64; N]>, FixtureError> {
        let values = self.values(array)?;
        let (rows, rest) = values.as_chunks::<N>();
        if !rest.is_empty() || n_rows.map_or(rows.is_empty(), |n| rows.len() != n) {
            let expected = n_rows.map_or_else(|| "some".into(), |n| n.to_string());
            return Err(FixtureError::Array {
                path: self.path.clone(),
                array,
                found: format!("{} numbers", values.len()),
                expected: format!("{expected} rows of {N}"),
            });
        }
        Ok(rows.to_vec())
    }

    /// Returns a number of pixels.
    ///
    /// # Errors
    /// [`FixtureError`].
    pub fn size_px(&mut self, array: &'static str) -> Result<u32, FixtureError> {
        let [value] = self.rows::<1>(array, Some(1))?[0];
        let is_size = value.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&value);
        is_size.then_some(value as u32).ok_or_else(|| FixtureError::Array {
            path: self.path.clone(),
            array,
            found: value.to_string(),
            expected: "a number of pixels".into(),
        })
    }

    fn values(&mut self, array: &'static str) -> Result<Vec<f64>, FixtureError> {
        let Self { path, archive } = self;
        let io = |source| FixtureError::Io { path: path.clone(), source };
        let Some(member) = archive.array(array).map_err(io)? else {
            return Err(FixtureError::Missing { path: path.clone(), array });
        };
        let file = NpyFile::new(member).map_err(io)?;
        let kind = match file.dtype() {
            DType::Plain(kind) => kind.to_string(),
            other => other.descr(),
        };
        match kind.trim_start_matches(['<', '>', '|']) {
            "f4" => numbers::<f32>(file, f64::from),
            "f8" => numbers::<f64>(file, |v| v),
            "i4" => numbers::<i32>(file, f64::from),
            "i8" => numbers::<i64>(file, |v| v as f64),
            _ => {
                return Err(FixtureError::Array {
                    path: path.clone(),
                    array,
                    found: kind,
                    expected: "f4, f8, i4 or i8".into(),
                });
            }
        }
        .map_err(io)
    }
}

/// Reads values one by one, so that a false count in the header reserves no memory.
fn numbers<T: Deserialize>(file: NpyFile<impl io::Read>, to_f64: fn(T) -> f64) -> io::Result<Vec<f64>> {
    let mut values = Vec::new();
    for value in file.data::<T>().map_err(io::Error::other)? {
        values.push(to_f64(value?));
    }
    Ok(values)
}
