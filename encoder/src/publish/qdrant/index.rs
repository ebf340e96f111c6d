//! Index settings of a collection: graph, quantisation, placement.
//!
//! A collection is created with them, and an existing one is updated where it differs. Settings that are not
//! given are not sent: a new collection has the database's defaults, an existing one keeps its own.
#![expect(deprecated, reason = "`memory`, which replaces these fields, is unknown to servers before 1.19")]

use qdrant_client::qdrant::{
    BinaryQuantization, BinaryQuantizationEncoding, CollectionConfig, CollectionParamsDiff, CompressionRatio,
    CreateCollection, CreateCollectionBuilder, Disabled, Distance, HnswConfigDiff, Memory,
    PayloadStorageParams, ProductQuantization, QuantizationConfig, QuantizationConfigDiff, QuantizationType,
    ScalarQuantization, UpdateCollection, VectorParams, VectorParamsBuilder, VectorParamsDiff,
    VectorsConfigDiff, quantization_config::Quantization as Stored,
    quantization_config_diff::Quantization as Diff, vectors_config, vectors_config_diff,
};
use serde::Serialize;

/// Index settings; the default leaves all to the database.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct IndexSettings {
    /// Edges of a node of the HNSW graph; 0: no graph, searches scan.
    pub hnsw_m: Option<u64>,
    /// Neighbours considered per node while the graph is built.
    pub hnsw_ef_construct: Option<u64>,
    /// Compressed copies of the vectors, kept in memory.
    pub quantisation: Option<Quantisation>,
    /// Vectors, graph and payload are read from disk.
    pub on_disk: bool,
}

/// Compressed copies of vectors; quantised ones stay in memory wherever the vectors are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantisation {
    /// None.
    None,
    /// Scalar: a byte a component.
    Int8,
    /// Binary: a bit a component.
    Binary,
    /// Product: a byte for four components.
    Product,
}

/// An update of an existing collection.
#[derive(Debug)]
pub(super) struct Update {
    pub(super) request: UpdateCollection,
    pub(super) changes: Vec<SettingChange>,
}

/// An index setting of an existing collection that differed from the one asked for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct SettingChange {
    /// The collection.
    pub collection: String,
    /// Which setting.
    pub setting: &'static str,
    /// Its former value.
    pub before: String,
    /// Its value now.
    pub after: String,
}

impl IndexSettings {
    /// Returns the request that creates a collection for vectors of `dim` components.
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

    /// Returns the update that gives a collection these settings, if it has others.
    ///
    /// `config`: the collection as the database describes it. Settings of its vectors override those of the
    /// collection, and `memory` overrides the older flags; an update changes each where it is in force.
    pub(super) fn update(&self, name: &str, config: &CollectionConfig) -> Option<Update> {
        let found = Found::new(config);
        let changes = self.changes(name, &found);
        if changes.is_empty() {
            return None;
        }
        let cold = |memory: Option<i32>| memory.filter(|_| self.on_disk).map(|_| Memory::Cold.into());
        let hnsw = |stored: &HnswConfigDiff| {
            self.hnsw().map(|wanted| HnswConfigDiff { memory: cold(stored.memory), ..wanted })
        };
        let quantisation =
            self.quantisation.map(|wanted| QuantizationConfigDiff { quantization: Some(wanted.diff()) });
        let vectors = VectorParamsDiff {
            hnsw_config: found.vectors.hnsw_config.as_ref().and_then(hnsw),
            quantization_config: quantisation.filter(|_| found.vectors.quantization_config.is_some()),
            on_disk: self.on_disk.then_some(true),
            memory: cold(found.vectors.memory),
        };
        let vectors = (vectors != VectorParamsDiff::default())
            .then_some(VectorsConfigDiff { config: Some(vectors_config_diff::Config::Params(vectors)) });
        let params = self.on_disk.then(|| CollectionParamsDiff {
            on_disk_payload: Some(true),
            payload: cold(found.payload_memory).map(|memory| PayloadStorageParams { memory: Some(memory) }),
            ..Default::default()
        });
        let request = UpdateCollection {
            collection_name: name.to_owned(),
            params,
            hnsw_config: hnsw(&found.hnsw),
            vectors_config: vectors,
            quantization_config: quantisation,
            ..Default::default()
        };
        Some(Update { request, changes })
    }

    fn changes(&self, name: &str, found: &Found) -> Vec<SettingChange> {
        let number = |n: Option<u64>| n.map_or_else(|| "the default".to_owned(), |n| n.to_string());
        let place = |on_disk: bool| if on_disk { "on disk" } else { "in memory" }.to_owned();
        let vectors = &found.vectors;
        let graph = vectors.hnsw_config.unwrap_or_default();
        let m = graph.m.or(found.hnsw.m);
        let ef_construct = graph.ef_construct.or(found.hnsw.ef_construct);
        let placed = |memory: Option<i32>, on_disk: Option<bool>| {
            place(memory.map_or(on_disk == Some(true), |memory| memory == i32::from(Memory::Cold)))
        };
        let graph_place = match (graph.memory, graph.on_disk) {
            (None, None) => placed(found.hnsw.memory, found.hnsw.on_disk),
            (memory, on_disk) => placed(memory, on_disk),
        };
        let on_disk = self.on_disk.then(|| place(true));
        let settings = [
            ("hnsw-m", self.hnsw_m.map(|m| number(Some(m))), number(m)),
            ("hnsw-ef-construct", self.hnsw_ef_construct.map(|ef| number(Some(ef))), number(ef_construct)),
            (
                "quantisation",
                self.quantisation.map(|wanted| describe(wanted.stored())),
                describe(vectors.quantization_config.or(found.quantisation).and_then(|q| q.quantization)),
            ),
            ("vectors", on_disk.clone(), placed(vectors.memory, vectors.on_disk)),
            ("graph", on_disk.clone(), graph_place),
            ("payload", on_disk, placed(found.payload_memory, Some(found.payload_on_disk))),
        ];
        let differing = settings.into_iter().filter_map(|(setting, wanted, before)| {
            let after = wanted.filter(|wanted| *wanted != before)?;
            Some(SettingChange { collection: name.to_owned(), setting, before, after })
        });
        differing.collect()
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

/// Settings of an existing collection, and of its vectors.
struct Found {
    vectors: VectorParams,
    hnsw: HnswConfigDiff,
    quantisation: Option<QuantizationConfig>,
    payload_on_disk: bool,
    payload_memory: Option<i32>,
}

impl Found {
    fn new(config: &CollectionConfig) -> Self {
        let params = config.params.clone().unwrap_or_default();
        let vectors = match params.vectors_config.and_then(|vectors| vectors.config) {
            Some(vectors_config::Config::Params(vectors)) => vectors,
            _ => VectorParams::default(),
        };
        Self {
            vectors,
            hnsw: config.hnsw_config.unwrap_or_default(),
            quantisation: config.quantization_config,
            payload_on_disk: params.on_disk_payload,
            payload_memory: params.payload.and_then(|payload| payload.memory),
        }
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
                // Of 32-bit components: one byte for four of them.
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

/// Returns a quantisation in words; two that are equal in force have the same words.
fn describe(quantisation: Option<Stored>) -> String {
    let (kind, always_ram, memory) = match quantisation {
        None => return "none".to_owned(),
        Some(Stored::Scalar(q)) => ("int8".to_owned(), q.always_ram, q.memory),
        Some(Stored::Binary(q)) => {
            let encoding = BinaryQuantizationEncoding::try_from(q.encoding.unwrap_or_default());
            let kind = match encoding {
                Ok(BinaryQuantizationEncoding::OneBit) => "binary".to_owned(),
                Ok(other) => format!("binary ({})", other.as_str_name()),
                Err(_) => "binary (of an unknown encoding)".to_owned(),
            };
            (kind, q.always_ram, q.memory)
        }
        Some(Stored::Product(q)) => {
            let ratio = CompressionRatio::try_from(q.compression).map_or("x?", |ratio| ratio.as_str_name());
            (format!("product ({ratio})"), q.always_ram, q.memory)
        }
        Some(Stored::Turboquant(q)) => ("turbo".to_owned(), q.always_ram, q.memory),
    };
    let in_memory = memory.map_or(always_ram == Some(true), |memory| memory == i32::from(Memory::Pinned));
    if in_memory { kind } else { format!("{kind}, not kept in memory") }
}
