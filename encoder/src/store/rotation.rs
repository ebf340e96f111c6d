//! The two steps that change a store's key; see [`super::keys`].

use ed25519_dalek::SigningKey;
use slag_common::Hash32;
use slag_common::manifest::Manifest;

use super::error::StoreError;
use super::keys::{NEXT_PUBLIC, NEXT_SECRET, PublicKeys, make, public, write_public};
use super::writer::Store;

impl Store {
    /// Makes the next key, unless there is one, and has the published scene name it.
    ///
    /// # Errors
    /// [`StoreError`]; done again, it goes on where it ended.
    pub fn begin_rotation(&mut self, now_unix_secs: u64) -> Result<PublicKeys, StoreError> {
        if self.keys.next.is_none() {
            self.keys.next = Some(make(&self.dir, NEXT_SECRET)?);
        }
        let next = self.keys.next.as_ref().map(public);
        if let Some(next) = next {
            write_public(&self.dir, NEXT_PUBLIC, next)?;
        }
        if self.published_next_key()?.is_some_and(|named| named != next) {
            self.publish_again(&self.keys.present, next, now_unix_secs)?;
        }
        PublicKeys::read(&self.dir)
    }

    /// Has the next key sign the published scene, and makes it the store's key.
    ///
    /// # Errors
    /// [`StoreError::Rotation`] unless [`Store::begin_rotation`] came before; [`StoreError`] otherwise.
    pub fn finish_rotation(&mut self, now_unix_secs: u64) -> Result<PublicKeys, StoreError> {
        let refuse = |what| Err(StoreError::Rotation { store: self.dir.clone(), what });
        let Some(next) = &self.keys.next else { return refuse("no next key was made") };
        match self.published_next_key()? {
            Some(named) if named != Some(public(next)) => {
                return refuse("the published manifest does not name the next key");
            }
            Some(_) => drop(self.publish_again(next, None, now_unix_secs)?),
            None => {}
        }
        self.keys.promote(&self.dir)?;
        PublicKeys::read(&self.dir)
    }

    /// Returns the next key that the published manifest names; `None` if nothing is published.
    fn published_next_key(&self) -> Result<Option<Option<Hash32>>, StoreError> {
        match self.reader() {
            Ok(reader) => Ok(Some(reader.manifest().next_key)),
            Err(StoreError::NotPublished { .. }) => Ok(None),
            Err(e) => Err(e),
        }
    }

    /// Publishes the current scene as the next generation, with other keys.
    fn publish_again(
        &self,
        signer: &SigningKey,
        next_key: Option<Hash32>,
        created_unix_secs: u64,
    ) -> Result<Hash32, StoreError> {
        let current = self.reader()?.current().clone();
        let generation = self.next_generation()?;
        let manifest = Manifest { generation, created_unix_secs, next_key, ..current.manifest };
        self.publish_as(signer, &manifest, &current.extras)
    }
}
