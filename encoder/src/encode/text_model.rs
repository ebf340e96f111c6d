//! The text side of the models, as objects of the store: robots then fetch it with the scene.

use std::io;

use slag_common::manifest::{ObjectRecord, TextModelRecord};
use slag_models::ModelDir;

use super::error::EncodeError;
use crate::store::Store;

/// Writes the text side of models into a store; what is there already is kept.
///
/// # Errors
/// [`EncodeError::TextModel`], [`EncodeError::Store`].
pub(super) fn carry(store: &Store, models: &ModelDir) -> Result<TextModelRecord, EncodeError> {
    let text_side = models.text_side()?;
    let mut files = Vec::new();
    for file in text_side.files() {
        let copied = store.put_object(|out| io::copy(&mut file.reader()?, out).map(drop));
        let (hash, len_bytes) = copied?;
        files.push(ObjectRecord { hash, len_bytes });
    }
    let names: Vec<_> = files.iter().map(|file| file.hash).collect();
    let (hash, len_bytes) = store.put_bytes(&text_side.description(&names)?)?;
    Ok(TextModelRecord { description: ObjectRecord { hash, len_bytes }, files })
}
