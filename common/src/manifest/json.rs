//! Manifests as bytes.

use serde::Deserialize;

use super::records::{MAX_BYTES, MAX_TEXT_FILES, Manifest, VERSION};
use crate::frames::Aabb;
use crate::shard::MAX_DIM;

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ManifestError {
    #[error(
        "the manifest has {len_bytes} bytes, expected at most {MAX_BYTES}: this is not a slag manifest; check the address"
    )]
    TooLong { len_bytes: u64 },
    /// Written by another version.
    #[error(
        "the manifest has version {found}, expected {VERSION}; use a robot program and an encoder of matching versions"
    )]
    Version { found: u64 },
    /// Not JSON, or members are missing.
    #[error("the manifest is damaged: {what}; fetch again, or encode again where it is published")]
    Damaged { what: String },
    /// A member has another type or value than this version expects.
    #[error(
        "the text is not a manifest of version {VERSION}: {what}; use a robot program and an encoder of matching versions"
    )]
    Content { what: String },
}

impl Manifest {
    pub fn to_bytes(&self) -> Vec<u8> {
        serde_json::to_vec(self).expect("a manifest has no map with other keys than strings")
    }

    /// Reads the JSON text; its origin is proved by the signed metadata that lists it as a target.
    pub fn parse(bytes: &[u8]) -> Result<Self, ManifestError> {
        if bytes.len() as u64 > MAX_BYTES {
            return Err(ManifestError::TooLong { len_bytes: bytes.len() as u64 });
        }
        let manifest: Self = serde_json::from_slice(bytes).map_err(|e| refusal(bytes, &e))?;
        manifest.check_content()?;
        Ok(manifest)
    }

    /// Checks the content, because a publisher's program may be faulty too.
    fn check_content(&self) -> Result<(), ManifestError> {
        let refuse = |what: String| Err(ManifestError::Content { what });
        if self.version != VERSION {
            return Err(ManifestError::Version { found: self.version.into() });
        }
        if self.encoder.dim == 0 || self.encoder.dim as usize > MAX_DIM {
            return refuse(format!(
                "its embeddings have {} components, expected 1 to {MAX_DIM}",
                self.encoder.dim
            ));
        }
        let n_text_files = self.encoder.text_model.as_ref().map_or(0, |model| model.files.len());
        if n_text_files > MAX_TEXT_FILES {
            return refuse(format!(
                "its text model has {n_text_files} files, expected at most {MAX_TEXT_FILES}"
            ));
        }
        if self.cells.windows(2).any(|pair| pair[0].cell_id >= pair[1].cell_id) {
            return refuse("its cell ids do not ascend".into());
        }
        for cell in &self.cells {
            let Aabb { min, max } = cell.bounds;
            if !(min.is_finite() && max.is_finite() && min.cmple(max).all()) {
                return refuse(format!(
                    "the box {min}..{max} of cell {} is empty or not finite",
                    cell.cell_id
                ));
            }
        }
        Ok(())
    }
}

/// Returns why a text is not a manifest of this version.
fn refusal(bytes: &[u8], error: &serde_json::Error) -> ManifestError {
    #[derive(Deserialize)]
    struct Head {
        version: u64,
    }
    let what = error.to_string();
    match serde_json::from_slice::<Head>(bytes) {
        Ok(Head { version: found }) if found != u64::from(VERSION) => ManifestError::Version { found },
        Ok(_) if !what.starts_with("missing field") => ManifestError::Content { what },
        _ => ManifestError::Damaged { what },
    }
}
