//! Settings of a collection: graph, quantisation, placement.
#![expect(deprecated, reason = "`memory`, which replaces these fields, is unknown to servers before 1.19")]

use clap::{Args, ValueEnum};
use qdrant_client::qdrant::{
    BinaryQuantization, CollectionParamsDiff, CompressionRatio, CreateCollection, CreateCollectionBuilder,
    Disabled, Distance, HnswConfigDiff, ProductQuantization, QuantizationConfig, QuantizationConfigDiff,
    QuantizationType, ScalarQuantization, UpdateCollection, VectorParams, VectorParamsBuilder,
    VectorParamsDiff, VectorsConfig, VectorsConfigDiff, quantization_config::Quantization as Stored,
    quantization_config_diff::Quantization as Diff, vectors_config, vectors_config_diff,
};

/// Settings of collections: new ones are created with them, existing ones are changed to them. What is not given
/// is not sent: a new collection has the database's defaults, an existing one keeps its own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Args)]
pub struct IndexSettings {
    /// Edges of each node of the HNSW graph: more are more accurate and take more memory; 0 builds no graph
    /// [default: Qdrant's, or the collection's own].
    #[arg(long, value_name = "N")]
    pub(crate) hnsw_m: Option<u64>,
    /// Neighbours considered per node while the graph is built: more are more accurate and take more time
    /// [default: Qdrant's, or the collection's own].
    #[arg(long, value_name = "N")]
    pub(crate) hnsw_ef_construct: Option<u64>,
    /// Compressed copies of the vectors, kept in memory [default: Qdrant's, or the collection's own].
    #[arg(long, value_enum)]
    pub(crate) quantisation: Option<Quantisation>,
    /// Leaves vectors, graph and payload on disk, for scenes larger than the server's memory.
    #[arg(long)]
    pub(crate) on_disk: bool,
}

/// Compressed copies of vectors; they stay in memory wherever the vectors are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Quantisation {
    /// None.
    None,
    /// Scalar: a byte a component, a quarter of the vectors' size.
    Int8,
    /// Binary: a bit a component, 1/32 of the size.
    Binary,
    /// Product: a byte for four components, 1/16 of the size.
    Product,
}

impl IndexSettings {
    pub(super) fn create(&self, name: &str, dim: u64) -> CreateCollection {
        let mut vectors = VectorParamsBuilder::new(dim, Distance::Cosine).build();
        vectors.on_disk = self.on_disk.then_some(true);
        let mut request = CreateCollectionBuilder::new(name).vectors_config(vectors).build();
        request.hnsw_config = self.hnsw();
        request.quantization_config = self
            .quantisation
            .and_then(Quantisation::stored)
            .map(|quantization| QuantizationConfig { quantization: Some(quantization) });
        request.on_disk_payload = self.on_disk.then_some(true);
        request
    }

    /// Applies these settings to an existing collection; `None` if none is given.
    pub(super) fn update(&self, name: &str) -> Option<UpdateCollection> {
        let vectors = VectorParamsDiff { on_disk: Some(true), ..Default::default() };
        let vectors = VectorsConfigDiff { config: Some(vectors_config_diff::Config::Params(vectors)) };
        let params = CollectionParamsDiff { on_disk_payload: Some(true), ..Default::default() };
        let quantisation =
            |wanted: Quantisation| QuantizationConfigDiff { quantization: Some(wanted.diff()) };
        (*self != Self::default()).then(|| UpdateCollection {
            collection_name: name.to_owned(),
            params: self.on_disk.then_some(params),
            hnsw_config: self.hnsw(),
            vectors_config: self.on_disk.then_some(vectors),
            quantization_config: self.quantisation.map(quantisation),
            ..Default::default()
        })
    }

    fn hnsw(&self) -> Option<HnswConfigDiff> {
        let hnsw = HnswConfigDiff {
            m: self.hnsw_m,
            ef_construct: self.hnsw_ef_construct,
            on_disk: self.on_disk.then_some(true),
            ..Default::default()
        };
        (hnsw != HnswConfigDiff::default()).then_some(hnsw)
    }
}

impl Quantisation {
    fn stored(self) -> Option<Stored> {
        let always_ram = Some(true);
        match self {
            Self::None => None,
            Self::Int8 => {
                let r#type = QuantizationType::Int8.into();
                Some(Stored::Scalar(ScalarQuantization { r#type, always_ram, ..Default::default() }))
            }
            Self::Binary => Some(Stored::Binary(BinaryQuantization { always_ram, ..Default::default() })),
            Self::Product => {
                // Of 32-bit components: one byte for four.
                let compression = CompressionRatio::X16.into();
                Some(Stored::Product(ProductQuantization { compression, always_ram, memory: None }))
            }
        }
    }

    fn diff(self) -> Diff {
        match self.stored() {
            None => Diff::Disabled(Disabled {}),
            Some(Stored::Scalar(scalar)) => Diff::Scalar(scalar),
            Some(Stored::Product(product)) => Diff::Product(product),
            Some(Stored::Binary(binary)) => Diff::Binary(binary),
            Some(Stored::Turboquant(turbo)) => Diff::Turboquant(turbo),
        }
    }
}

/// Settings of a collection's only vector; `None` if it has several or none.
pub(super) fn vectors_of(config: Option<VectorsConfig>) -> Option<VectorParams> {
    match config?.config? {
        vectors_config::Config::Params(vectors) => Some(vectors),
        vectors_config::Config::ParamsMap(_) => None,
    }
}
