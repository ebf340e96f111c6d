//! The collections and snapshots of the small Qdrant.

use super::*;
use ::qdrant_client::qdrant::collections_server::Collections;
use ::qdrant_client::qdrant::snapshots_server::Snapshots;
use ::qdrant_client::qdrant::*;

use super::server::service;

fn done() -> Response<CollectionOperationResponse> {
    Response::new(CollectionOperationResponse { result: true, ..Default::default() })
}

service!(Collections {
    async fn collection_exists(&self, request: Request<CollectionExistsRequest>) -> Result<Response<CollectionExistsResponse>, Status> {
        let name = self.admit(request)?.collection_name;
        let exists = self.with(|state| state.collections.contains_key(&name));
        Ok(Response::new(CollectionExistsResponse { result: Some(CollectionExists { exists }), ..Default::default() }))
    }

    async fn create(&self, request: Request<CreateCollection>) -> Result<Response<CollectionOperationResponse>, Status> {
        let request = self.admit(request)?;
        self.with(|state| {
            state.created.push(request.clone());
            let config = request.vectors_config.and_then(|config| config.config);
            let Some(vectors_config::Config::Params(vectors)) = config else {
                return Err(Status::unimplemented("only one unnamed vector"));
            };
            match state.collections.insert(request.collection_name, Held::new(vectors)) {
                None => Ok(done()),
                Some(_) => Err(Status::already_exists("exists")),
            }
        })
    }

    async fn get(&self, request: Request<GetCollectionInfoRequest>) -> Result<Response<GetCollectionInfoResponse>, Status> {
        let name = self.admit(request)?.collection_name;
        let Held { vectors, indexed, .. } = self.with(|state| state.held(&name).cloned())?;
        let vectors_config = Some(VectorsConfig { config: Some(vectors_config::Config::Params(vectors)) });
        let params = Some(CollectionParams { vectors_config, ..Default::default() });
        let config = CollectionConfig { params, ..Default::default() };
        let payload_schema = indexed.into_iter().map(|field| (field, PayloadSchemaInfo::default())).collect();
        let result = Some(CollectionInfo { config: Some(config), payload_schema, ..Default::default() });
        Ok(Response::new(GetCollectionInfoResponse { result, ..Default::default() }))
    }

    async fn list(&self, request: Request<ListCollectionsRequest>) -> Result<Response<ListCollectionsResponse>, Status> {
        self.admit(request)?;
        let names = self.with(|state| state.collections.keys().cloned().collect::<Vec<_>>());
        let collections = names.into_iter().map(|name| CollectionDescription { name }).collect();
        Ok(Response::new(ListCollectionsResponse { collections, ..Default::default() }))
    }

    async fn update(&self, request: Request<UpdateCollection>) -> Result<Response<CollectionOperationResponse>, Status> {
        let request = self.admit(request)?;
        self.with(|state| {
            state.held(&request.collection_name)?;
            state.updated.push(request);
            Ok(done())
        })
    }

    async fn delete(&self, request: Request<DeleteCollection>) -> Result<Response<CollectionOperationResponse>, Status> {
        let name = self.admit(request)?.collection_name;
        self.with(|state| {
            state.held(&name)?;
            state.collections.remove(&name);
            Ok(done())
        })
    }
} refused {
    update_aliases: ChangeAliases => CollectionOperationResponse;
    list_collection_aliases: ListCollectionAliasesRequest => ListAliasesResponse;
    list_aliases: ListAliasesRequest => ListAliasesResponse;
    collection_cluster_info: CollectionClusterInfoRequest => CollectionClusterInfoResponse;
    update_collection_cluster_setup: UpdateCollectionClusterSetupRequest => UpdateCollectionClusterSetupResponse;
    create_shard_key: CreateShardKeyRequest => CreateShardKeyResponse;
    delete_shard_key: DeleteShardKeyRequest => DeleteShardKeyResponse;
    list_shard_keys: ListShardKeysRequest => ListShardKeysResponse;
});

service!(Snapshots {
    /// A snapshot has a new name, the number of points as its size, and a checksum from the collection's name.
    async fn create(&self, request: Request<CreateSnapshotRequest>) -> Result<Response<CreateSnapshotResponse>, Status> {
        let name = self.admit(request)?.collection_name;
        self.with(|state| {
            if let Some(n_left) = &mut state.n_snapshots_allowed {
                *n_left = n_left.checked_sub(1).ok_or_else(|| Status::permission_denied("the disk is full"))?;
            }
            let held = state.held(&name)?;
            let snapshot = SnapshotDescription {
                name: format!("{name}-{}.snapshot", held.snapshots.len() + 1),
                creation_time: None,
                size: held.points.len() as i64 + 1000,
                checksum: Some(format!("sha256 of {name}")),
            };
            held.snapshots.push(snapshot.clone());
            let snapshot_description = Some(snapshot);
            Ok(Response::new(CreateSnapshotResponse { snapshot_description, ..Default::default() }))
        })
    }
} refused {
    list: ListSnapshotsRequest => ListSnapshotsResponse;
    delete: DeleteSnapshotRequest => DeleteSnapshotResponse;
    create_full: CreateFullSnapshotRequest => CreateSnapshotResponse;
    list_full: ListFullSnapshotsRequest => ListSnapshotsResponse;
    delete_full: DeleteFullSnapshotRequest => DeleteSnapshotResponse;
});
