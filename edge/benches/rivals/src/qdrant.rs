//! qdrant-edge: Qdrant's segments in the process.

use std::path::Path;

use anyhow::{Result, bail};
use qdrant_edge::{
    Distance, EdgeConfig, EdgeConfigBuilder, EdgeShard, EdgeVectorParamsBuilder, HnswIndexConfig, NamedQuery,
    PointId, PointInsertOperations, PointOperations, PointStruct, QuantizationConfig,
    QuantizationSearchParams, QueryEnum, ScalarQuantizationConfig, ScalarType, SearchParams, SearchRequest,
    UpdateOperation, VectorInternal,
};

use crate::dump::Dump;
use crate::{Engine, Index};

/// Edges of a graph's node, and candidates during its construction.
const EDGES: usize = 16;
const CANDIDATES: usize = 100;
/// Points in one insert: 16 MB of vectors at 512 components.
const INSERT: usize = 8192;

pub struct Qdrant {
    shard: EdgeShard,
    engine: Engine,
}

impl Qdrant {
    pub fn build(dump: &Dump, work: &Path, engine: Engine) -> Result<Self> {
        let dim = dump.meta.dim;
        let shard = EdgeShard::new(work, config(dim, engine)?)?;
        for (at, block) in dump.vectors().chunks(INSERT * dim).enumerate() {
            let points = block.chunks_exact(dim).enumerate().map(|(i, vector)| {
                let id = PointId::NumId((at * INSERT + i) as u64);
                PointStruct::new(id, vector.to_vec(), serde_json::json!({})).into()
            });
            let points = PointInsertOperations::PointsList(points.collect());
            shard.update(UpdateOperation::PointOperation(PointOperations::UpsertPoints(points)))?;
        }
        // Moves the points into immutable segments, with graph and quantised vectors if configured.
        shard.optimize()?;
        shard.flush();
        Ok(Self { shard, engine })
    }
}

fn has_graph(engine: Engine) -> bool {
    matches!(engine, Engine::QdrantHnsw | Engine::QdrantHnswInt8 | Engine::QdrantHnswPq)
}

fn config(dim: usize, engine: Engine) -> Result<EdgeConfig> {
    let graph = HnswIndexConfig {
        // Without edges there is no graph: every search scans.
        m: if has_graph(engine) { EDGES } else { 0 },
        ef_construct: CANDIDATES,
        full_scan_threshold: if has_graph(engine) { 1 } else { usize::MAX / 1024 },
        max_indexing_threads: std::thread::available_parallelism().map_or(0, Into::into),
        on_disk: Some(false),
        payload_m: Some(0),
        inline_storage: None,
    };
    // Unit vectors: the dot product is the cosine, and normalising again is unnecessary.
    let mut vector =
        EdgeVectorParamsBuilder::new(dim, Distance::Dot).hnsw_config(graph.clone()).on_disk(false);
    vector = match engine {
        Engine::QdrantScanInt8 | Engine::QdrantHnswInt8 => {
            let r#type = ScalarType::Int8;
            let int8 = ScalarQuantizationConfig { r#type, quantile: Some(0.99), always_ram: Some(true) };
            vector.quantization_config(QuantizationConfig::from(int8))
        }
        Engine::QdrantHnswPq => {
            let product = serde_json::json!({ "product": { "compression": "x16", "always_ram": true } });
            vector.quantization_config(serde_json::from_value(product)?)
        }
        _ => vector,
    };
    Ok(EdgeConfigBuilder::new()
        .vector(qdrant_edge::DEFAULT_VECTOR_NAME, vector.build())
        .hnsw_config(graph)
        .build())
}

impl Index for Qdrant {
    fn search(&self, query: &[f32], limit: usize) -> Result<Vec<u32>> {
        let is_f32 = matches!(self.engine, Engine::QdrantScan | Engine::QdrantHnsw);
        let quantization =
            QuantizationSearchParams { ignore: is_f32, rescore: Some(false), oversampling: None };
        let found = self.shard.search(SearchRequest {
            query: QueryEnum::Nearest(NamedQuery {
                query: VectorInternal::Dense(query.to_vec()),
                using: None,
            }),
            filter: None,
            params: Some(SearchParams {
                exact: self.engine == Engine::QdrantScan,
                quantization: Some(quantization),
                ..SearchParams::default()
            }),
            limit,
            offset: 0,
            with_payload: None,
            with_vector: None,
            score_threshold: None,
        })?;
        let id = |id: &PointId| match id {
            PointId::NumId(id) => Ok(u32::try_from(*id)?),
            PointId::Uuid(_) => bail!("a point has an id that was never given"),
        };
        found.iter().map(|point| id(&point.id)).collect()
    }
}
