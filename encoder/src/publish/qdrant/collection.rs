//! The collection: its shape, its payload indexes, its points.

use std::collections::HashMap;

use qdrant_client::qdrant::vectors_config::Config;
use qdrant_client::qdrant::{
    CollectionConfig, CollectionInfo, Condition, CountPointsBuilder, CreateFieldIndexCollectionBuilder,
    DeletePointsBuilder, Distance, FieldType, Filter, PayloadSchemaInfo, PointStruct, UpdateCollection,
    UpsertPointsBuilder, VectorParams,
};
use slag_common::manifest::Manifest;

use super::database::Database;
use super::error::PushError;
use super::index::IndexSettings;

/// A collection that is to hold a scene, or a cell of it.
pub(super) struct Collection<'a> {
    pub(super) database: &'a Database<'a>,
    pub(super) name: String,
    pub(super) manifest: &'a Manifest,
}

impl Collection<'_> {
    /// Returns the collection as it is, if it exists; fails if it cannot take this scene. Changes nothing.
    pub(super) async fn existing(&self) -> Result<Option<CollectionInfo>, PushError> {
        let exists = || self.database.client.collection_exists(self.name.as_str());
        if !self.database.attempt("look for the collection", exists).await? {
            return Ok(None);
        }
        let info = self.describe().await?;
        self.check_vectors(info.config.clone())?;
        match self.count_others().await? {
            0 => Ok(Some(info)),
            n_points => {
                let scene = self.manifest.scene.clone();
                Err(PushError::OtherScene { collection: self.name.clone(), scene, n_points })
            }
        }
    }

    /// Returns the collection's settings and payload indexes.
    pub(super) async fn describe(&self) -> Result<CollectionInfo, PushError> {
        let describe = || self.database.client.collection_info(self.name.as_str());
        let info = self.database.attempt("describe the collection", describe).await?;
        Ok(info.result.unwrap_or_default())
    }

    /// Creates the collection, without payload indexes.
    pub(super) async fn create(&self, index: &IndexSettings) -> Result<(), PushError> {
        let request = index.create(&self.name, self.manifest.encoder.dim.into());
        let create = || self.database.client.create_collection(request.clone());
        self.database.attempt("create the collection", create).await.map(drop)
    }

    /// Changes settings of the collection.
    pub(super) async fn update(&self, request: UpdateCollection) -> Result<(), PushError> {
        let update = || self.database.client.update_collection(request.clone());
        self.database.attempt("change the collection's settings", update).await.map(drop)
    }

    /// Deletes the collection.
    pub(super) async fn delete(&self) -> Result<(), PushError> {
        let delete = || self.database.client.delete_collection(self.name.as_str());
        self.database.attempt("delete the collection", delete).await.map(drop)
    }

    /// Creates the payload indexes that are not in `existing`: an earlier push may have been cut off between
    /// the collection and its indexes, or may not have been geo-referenced.
    pub(super) async fn ensure_indexes(
        &self,
        existing: &HashMap<String, PayloadSchemaInfo>,
    ) -> Result<(), PushError> {
        let place = self.manifest.geo_reference.map(|_| ("location", FieldType::Geo));
        let fields = [("scene", FieldType::Keyword), ("generation", FieldType::Integer)];
        for (field, kind) in fields.into_iter().chain(place) {
            if existing.contains_key(field) {
                continue;
            }
            let index = || {
                let request = CreateFieldIndexCollectionBuilder::new(&self.name, field, kind).wait(true);
                self.database.client.create_field_index(request)
            };
            self.database.attempt("index a payload field", index).await?;
        }
        Ok(())
    }

    fn check_vectors(&self, config: Option<CollectionConfig>) -> Result<(), PushError> {
        let config = config.and_then(|c| c.params).and_then(|p| p.vectors_config).and_then(|c| c.config);
        let describe = |size: u64, distance: i32| {
            let distance = Distance::try_from(distance).unwrap_or(Distance::UnknownDistance);
            format!("vectors of {size} components, distance {}", distance.as_str_name())
        };
        let found = match config {
            Some(Config::Params(VectorParams { size, distance, multivector_config: None, .. })) => {
                describe(size, distance)
            }
            Some(Config::Params(_)) => "multivectors".to_owned(),
            Some(Config::ParamsMap(map)) => {
                let mut names: Vec<String> = map.map.into_keys().collect();
                names.sort_unstable();
                format!("named vectors {names:?}")
            }
            None => "no vectors".to_owned(),
        };
        let expected = describe(self.manifest.encoder.dim.into(), Distance::Cosine.into());
        if found == expected {
            return Ok(());
        }
        Err(PushError::Collection { collection: self.name.clone(), found, expected })
    }

    pub(super) async fn upsert(&self, batch: Vec<PointStruct>) -> Result<(), PushError> {
        let request = UpsertPointsBuilder::new(&self.name, batch).wait(true).build();
        let upsert = || self.database.client.upsert_points(request.clone());
        self.database.attempt("upsert points", upsert).await.map(drop)
    }

    /// Deletes the points of Gaussians that `generation` no longer has.
    pub(super) async fn remove_other_generations(&self, generation: i64) -> Result<(), PushError> {
        let delete = || {
            let others = Filter::must_not([Condition::matches("generation", generation)]);
            let request = DeletePointsBuilder::new(&self.name).points(others).wait(true);
            self.database.client.delete_points(request)
        };
        self.database.attempt("delete points of earlier generations", delete).await.map(drop)
    }

    /// Counts the points of other scenes.
    pub(super) async fn count_others(&self) -> Result<u64, PushError> {
        self.count(Some(Filter::must_not([Condition::matches("scene", self.manifest.scene.clone())]))).await
    }

    /// Counts the points that pass a filter.
    pub(super) async fn count(&self, filter: Option<Filter>) -> Result<u64, PushError> {
        let count = || {
            let request = CountPointsBuilder::new(&self.name).exact(true);
            self.database.client.count(match filter.clone() {
                Some(filter) => request.filter(filter),
                None => request,
            })
        };
        let counted = self.database.attempt("count points", count).await?;
        Ok(counted.result.map_or(0, |result| result.count))
    }
}
