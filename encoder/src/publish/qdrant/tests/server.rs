//! A small Qdrant: the generated gRPC services over points in memory.

use super::*;
use std::collections::HashMap;
use std::sync::Mutex;

use ::qdrant_client::qdrant::collections_server::CollectionsServer;
use ::qdrant_client::qdrant::points_server::{Points, PointsServer};
use ::qdrant_client::qdrant::snapshots_server::SnapshotsServer;
use ::qdrant_client::qdrant::vector::Vector as Kind;
use ::qdrant_client::qdrant::*;
use ::qdrant_client::qdrant::{
    condition::ConditionOneOf, r#match::MatchValue, point_id::PointIdOptions, value,
};
use ::qdrant_client::qdrant::{points_selector::PointsSelectorOneOf, vectors::VectorsOptions};

#[derive(Clone, Debug)]
pub(super) struct Stored {
    pub(super) vector: Vec<f32>,
    pub(super) payload: HashMap<String, Value>,
}

#[derive(Clone, Default)]
pub(super) struct Held {
    pub(super) vectors: VectorParams,
    pub(super) indexed: Vec<String>,
    pub(super) points: BTreeMap<u64, Stored>,
    pub(super) snapshots: Vec<SnapshotDescription>,
}

impl Held {
    pub(super) fn new(vectors: VectorParams) -> Self {
        Self { vectors, ..Self::default() }
    }
}

#[derive(Default)]
pub(super) struct State {
    pub(super) collections: BTreeMap<String, Held>,
    /// Requests that create and update collections, in order.
    pub(super) created: Vec<CreateCollection>,
    pub(super) updated: Vec<UpdateCollection>,
    /// Snapshots to make before one is refused.
    pub(super) n_snapshots_allowed: Option<u32>,
    /// Requests for a payload index to refuse.
    pub(super) n_indexes_refused: u32,
    /// First id of every acknowledged batch, in order.
    pub(super) acknowledged: Vec<u64>,
    /// Batches to fail, by first id: how often, and whether after they took effect.
    pub(super) failures: HashMap<u64, (u32, bool)>,
    pub(super) n_failed: u32,
}

impl State {
    pub(super) fn held(&mut self, name: &str) -> Result<&mut Held, Status> {
        self.collections.get_mut(name).ok_or_else(|| Status::not_found(format!("no collection {name}")))
    }
}

/// Called with the number of acknowledged batches.
type Watcher = Arc<dyn Fn(usize) + Send + Sync>;

#[derive(Clone)]
pub(super) struct Server {
    pub(super) state: Arc<Mutex<State>>,
    pub(super) watcher: Arc<Mutex<Option<Watcher>>>,
    api_key: Option<&'static str>,
}

impl Server {
    pub(super) async fn start(api_key: Option<&'static str>) -> (Self, String) {
        let server = Self { state: Arc::default(), watcher: Arc::default(), api_key };
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let url = format!("http://{}", listener.local_addr().expect("bound"));
        let router = tonic::transport::Server::builder()
            .add_service(PointsServer::new(server.clone()))
            .add_service(CollectionsServer::new(server.clone()))
            .add_service(SnapshotsServer::new(server.clone()));
        tokio::spawn(router.serve_with_incoming(tokio_stream::wrappers::TcpListenerStream::new(listener)));
        (server, url)
    }

    pub(super) fn with<T>(&self, work: impl FnOnce(&mut State) -> T) -> T {
        work(&mut self.state.lock().expect("no test panics within"))
    }

    pub(super) fn admit<T>(&self, request: Request<T>) -> Result<T, Status> {
        let key = request.metadata().get("api-key").and_then(|key| key.to_str().ok());
        match self.api_key {
            Some(expected) if key != Some(expected) => Err(Status::unauthenticated("wrong or missing key")),
            _ => Ok(request.into_inner()),
        }
    }

    fn done(&self) -> Response<PointsOperationResponse> {
        let result = UpdateResult { status: UpdateStatus::Completed.into(), ..Default::default() };
        Response::new(PointsOperationResponse { result: Some(result), ..Default::default() })
    }

    fn upsert_now(&self, request: UpsertPoints) -> Result<(), Status> {
        assert_eq!(request.wait, Some(true), "acknowledged only when applied");
        let mut state = self.state.lock().expect("no test panics within");
        let points: Vec<(u64, Stored)> = request.points.into_iter().map(stored).collect::<Result<_, _>>()?;
        let first = points.first().ok_or_else(|| Status::invalid_argument("no points"))?.0;
        let dim = state.held(&request.collection_name)?.vectors.size;
        if points.iter().any(|(_, point)| point.vector.len() as u64 != dim) {
            return Err(Status::invalid_argument("wrong dimension"));
        }
        let failure = match state.failures.get_mut(&first) {
            Some((n_left, after)) if *n_left > 0 => {
                *n_left -= 1;
                Some(*after)
            }
            _ => None,
        };
        if failure != Some(false) {
            state.held(&request.collection_name)?.points.extend(points);
        }
        if failure.is_some() {
            state.n_failed += 1;
            return Err(Status::unavailable("shard is starting"));
        }
        state.acknowledged.push(first);
        let n_acknowledged = state.acknowledged.len();
        drop(state);
        if let Some(watcher) = self.watcher.lock().expect("no test panics within").as_ref() {
            watcher(n_acknowledged);
        }
        Ok(())
    }
}

fn stored(point: PointStruct) -> Result<(u64, Stored), Status> {
    let Some(PointIdOptions::Num(id)) = point.id.and_then(|id| id.point_id_options) else {
        return Err(Status::invalid_argument("no numeric id"));
    };
    match point.vectors.and_then(|v| v.vectors_options) {
        Some(VectorsOptions::Vector(Vector { vector: Some(Kind::Dense(dense)), .. })) => {
            Ok((id, Stored { vector: dense.data, payload: point.payload }))
        }
        _ => Err(Status::invalid_argument("no dense vector")),
    }
}

fn passes(payload: &HashMap<String, Value>, filter: &Filter) -> Result<bool, Status> {
    let holds = |condition: &Condition| {
        let Some(ConditionOneOf::Field(field)) = &condition.condition_one_of else {
            return Err(Status::unimplemented("a condition that is no field match"));
        };
        let found = payload.get(&field.key).and_then(|value| value.kind.as_ref());
        match (field.r#match.as_ref().and_then(|m| m.match_value.as_ref()), found) {
            (Some(MatchValue::Keyword(expected)), Some(value::Kind::StringValue(found))) => {
                Ok(expected == found)
            }
            (Some(MatchValue::Integer(expected)), Some(value::Kind::IntegerValue(found))) => {
                Ok(expected == found)
            }
            (Some(MatchValue::Keyword(_) | MatchValue::Integer(_)), _) => Ok(false),
            _ => Err(Status::unimplemented("a match that is no equality")),
        }
    };
    assert!(filter.must.is_empty() && filter.should.is_empty());
    for condition in &filter.must_not {
        if holds(condition)? {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Implements a service by the given functions and refuses the others.
macro_rules! service {
    ($service:ident { $($given:item)* } refused { $($name:ident: $request:ty => $response:ty;)* }) => {
        #[tonic::async_trait]
        impl $service for Server {
            $($given)*
            $(async fn $name(&self, _: Request<$request>) -> Result<Response<$response>, Status> {
                Err(Status::unimplemented(stringify!($name)))
            })*
        }
    };
}

pub(super) use service;

service!(Points {
    async fn upsert(&self, request: Request<UpsertPoints>) -> Result<Response<PointsOperationResponse>, Status> {
        self.upsert_now(self.admit(request)?)?;
        Ok(self.done())
    }

    async fn delete(&self, request: Request<DeletePoints>) -> Result<Response<PointsOperationResponse>, Status> {
        let request = self.admit(request)?;
        let selector = request.points.and_then(|points| points.points_selector_one_of);
        let Some(PointsSelectorOneOf::Filter(filter)) = selector else {
            return Err(Status::unimplemented("only by filter"));
        };
        self.with(|state| {
            let held = state.held(&request.collection_name)?;
            let mut kept = BTreeMap::new();
            for (id, point) in std::mem::take(&mut held.points) {
                if !passes(&point.payload, &filter)? {
                    kept.insert(id, point);
                }
            }
            held.points = kept;
            Ok(self.done())
        })
    }

    async fn count(&self, request: Request<CountPoints>) -> Result<Response<CountResponse>, Status> {
        let request = self.admit(request)?;
        assert_eq!(request.exact, Some(true));
        let filter = request.filter.unwrap_or_default();
        self.with(|state| {
            let points = &state.held(&request.collection_name)?.points;
            let passed: Result<Vec<bool>, Status> =
                points.values().map(|point| passes(&point.payload, &filter)).collect();
            let count = passed?.into_iter().filter(|passed| *passed).count() as u64;
            Ok(Response::new(CountResponse { result: Some(CountResult { count }), ..Default::default() }))
        })
    }

    async fn create_field_index(&self, request: Request<CreateFieldIndexCollection>) -> Result<Response<PointsOperationResponse>, Status> {
        let request = self.admit(request)?;
        self.with(|state| {
            if state.n_indexes_refused > 0 {
                state.n_indexes_refused -= 1;
                return Err(Status::permission_denied("indexes are refused"));
            }
            state.held(&request.collection_name)?.indexed.push(request.field_name);
            Ok(self.done())
        })
    }
} refused {
    get: GetPoints => GetResponse;
    search: SearchPoints => SearchResponse;
    update_vectors: UpdatePointVectors => PointsOperationResponse;
    delete_vectors: DeletePointVectors => PointsOperationResponse;
    set_payload: SetPayloadPoints => PointsOperationResponse;
    overwrite_payload: SetPayloadPoints => PointsOperationResponse;
    delete_payload: DeletePayloadPoints => PointsOperationResponse;
    clear_payload: ClearPayloadPoints => PointsOperationResponse;
    delete_field_index: DeleteFieldIndexCollection => PointsOperationResponse;
    create_vector_name: CreateVectorNameRequest => PointsOperationResponse;
    delete_vector_name: DeleteVectorNameRequest => PointsOperationResponse;
    search_batch: SearchBatchPoints => SearchBatchResponse;
    search_groups: SearchPointGroups => SearchGroupsResponse;
    scroll: ScrollPoints => ScrollResponse;
    recommend: RecommendPoints => RecommendResponse;
    recommend_batch: RecommendBatchPoints => RecommendBatchResponse;
    recommend_groups: RecommendPointGroups => RecommendGroupsResponse;
    discover: DiscoverPoints => DiscoverResponse;
    discover_batch: DiscoverBatchPoints => DiscoverBatchResponse;
    update_batch: UpdateBatchPoints => UpdateBatchResponse;
    query: QueryPoints => QueryResponse;
    query_batch: QueryBatchPoints => QueryBatchResponse;
    query_groups: QueryPointGroups => QueryGroupsResponse;
    facet: FacetCounts => FacetResponse;
    search_matrix_pairs: SearchMatrixPoints => SearchMatrixPairsResponse;
    search_matrix_offsets: SearchMatrixPoints => SearchMatrixOffsetsResponse;
});
