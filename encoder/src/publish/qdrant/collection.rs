//! The collection: its shape, its payload indexes, its points.

use std::collections::HashMap;

use qdrant_client::qdrant::vectors_config::Config;
use qdrant_client::qdrant::{
    CollectionConfig, Condition, CountPointsBuilder, CreateCollectionBuilder,
    CreateFieldIndexCollectionBuilder, DeletePointsBuilder, Distance, FieldType, Filter, PayloadSchemaInfo,
    PointStruct, UpsertPointsBuilder, VectorParams, VectorParamsBuilder,
};
use slag_common::manifest::Manifest;

use super::database::Database;
use super::error::PushError;

/// A collection that is to hold a scene.
pub(super) struct Collection<'a> {
    pub(super) database: &'a Database<'a>,
    pub(super) name: &'a str,
    pub(super) manifest: &'a Manifest,
}

impl Collection<'_> {
    /// Creates the collection, or checks that the existing one can take this scene; then creates the payload
    /// indexes that it lacks. Returns whether it created the collection.
    pub(super) async fn ensure(&self) -> Result<bool, PushError> {
        let exists = self
            .database
            .attempt("look for the collection", || self.database.client.collection_exists(self.name))
            .await?;
        if !exists {
            let dim = u64::from(self.manifest.encoder.dim);
            let create = || {
                let vectors = VectorParamsBuilder::new(dim, Distance::Cosine);
                let request = CreateCollectionBuilder::new(self.name).vectors_config(vectors);
                self.database.client.create_collection(request)
            };
            self.database.attempt("create the collection", create).await?;
            self.ensure_indexes(&HashMap::new()).await?;
            return Ok(true);
        }
        let describe = || self.database.client.collection_info(self.name);
        let info = self.database.attempt("describe the collection", describe).await?;
        let info = info.result.unwrap_or_default();
        self.check_vectors(info.config)?;
        let scene = self.manifest.scene.clone();
        let others = Filter::must_not([Condition::matches("scene", scene.clone())]);
        match self.count(Some(others)).await? {
            0 => self.ensure_indexes(&info.payload_schema).await.map(|()| false),
            n_points => Err(PushError::OtherScene { collection: self.name.to_owned(), scene, n_points }),
        }
    }

    /// Creates the payload indexes that are not in `existing`: an earlier push may have been cut off between
    /// the collection and its indexes, or may not have been geo-referenced.
    async fn ensure_indexes(&self, existing: &HashMap<String, PayloadSchemaInfo>) -> Result<(), PushError> {
        let place = self.manifest.geo_reference.map(|_| ("location", FieldType::Geo));
        let fields = [("scene", FieldType::Keyword), ("generation", FieldType::Integer)];
        for (field, kind) in fields.into_iter().chain(place) {
            if existing.contains_key(field) {
                continue;
            }
            let index = || {
                let request = CreateFieldIndexCollectionBuilder::new(self.name, field, kind).wait(true);
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
        Err(PushError::Collection { collection: self.name.to_owned(), found, expected })
    }

    pub(super) async fn upsert(&self, batch: Vec<PointStruct>) -> Result<(), PushError> {
        let request = UpsertPointsBuilder::new(self.name, batch).wait(true).build();
        let upsert = || self.database.client.upsert_points(request.clone());
        self.database.attempt("upsert points", upsert).await.map(drop)
    }

    /// Deletes the points of Gaussians that `generation` no longer has.
    pub(super) async fn remove_other_generations(&self, generation: i64) -> Result<(), PushError> {
        let delete = || {
            let others = Filter::must_not([Condition::matches("generation", generation)]);
            let request = DeletePointsBuilder::new(self.name).points(others).wait(true);
            self.database.client.delete_points(request)
        };
        self.database.attempt("delete points of earlier generations", delete).await.map(drop)
    }

    /// Counts the points that pass a filter.
    pub(super) async fn count(&self, filter: Option<Filter>) -> Result<u64, PushError> {
        let count = || {
            let request = CountPointsBuilder::new(self.name).exact(true);
            self.database.client.count(match filter.clone() {
                Some(filter) => request.filter(filter),
                None => request,
            })
        };
        let counted = self.database.attempt("count points", count).await?;
        Ok(counted.result.map_or(0, |result| result.count))
    }
}
