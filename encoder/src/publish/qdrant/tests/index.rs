//! Index settings: what is sent at creation, and to collections that exist.
#![expect(deprecated, reason = "older servers know no other field than the deprecated ones")]

use qdrant_client::qdrant::quantization_config::Quantization as Stored;
use qdrant_client::qdrant::quantization_config_diff::Quantization as Diff;
use qdrant_client::qdrant::{
    BinaryQuantization, CollectionParamsDiff, CompressionRatio, CreateCollection, CreateCollectionBuilder,
    Disabled, HnswConfigDiff, ProductQuantization, QuantizationConfig, QuantizationConfigDiff,
    QuantizationType, ScalarQuantization, UpdateCollection, VectorParamsDiff, VectorsConfigDiff,
    vectors_config_diff,
};

use super::*;
use crate::publish::qdrant::settings::Quantisation;

/// Vectors and distance alone.
fn plain() -> CreateCollection {
    let vectors = VectorParamsBuilder::new(DIM as u64, Distance::Cosine);
    CreateCollectionBuilder::new("yard").vectors_config(vectors).build()
}

fn with_quantization(quantization: Stored) -> CreateCollection {
    let quantization_config = Some(QuantizationConfig { quantization: Some(quantization) });
    CreateCollection { quantization_config, ..plain() }
}

fn scalar() -> ScalarQuantization {
    let r#type = QuantizationType::Int8.into();
    ScalarQuantization { r#type, always_ram: Some(true), ..Default::default() }
}

fn graph() -> HnswConfigDiff {
    HnswConfigDiff { m: Some(32), ef_construct: Some(200), on_disk: Some(true), ..Default::default() }
}

const ALL: IndexSettings = IndexSettings {
    hnsw_m: Some(32),
    hnsw_ef_construct: Some(200),
    quantisation: Some(Quantisation::Int8),
    on_disk: true,
};

#[tokio::test]
async fn a_collection_is_created_with_the_settings_given_and_no_others() {
    let none = IndexSettings::default();
    let hnsw = |hnsw| CreateCollection { hnsw_config: Some(hnsw), ..plain() };
    let binary = BinaryQuantization { always_ram: Some(true), ..Default::default() };
    let compression = CompressionRatio::X16.into();
    let product = ProductQuantization { compression, always_ram: Some(true), memory: None };
    let quantised = |quantisation| IndexSettings { quantisation: Some(quantisation), ..none };
    let cases = [
        (none, plain()),
        (
            IndexSettings { hnsw_m: Some(0), ..none },
            hnsw(HnswConfigDiff { m: Some(0), ..Default::default() }),
        ),
        (
            IndexSettings { hnsw_ef_construct: Some(64), ..none },
            hnsw(HnswConfigDiff { ef_construct: Some(64), ..Default::default() }),
        ),
        (quantised(Quantisation::None), plain()),
        (quantised(Quantisation::Int8), with_quantization(Stored::Scalar(scalar()))),
        (quantised(Quantisation::Binary), with_quantization(Stored::Binary(binary))),
        (quantised(Quantisation::Product), with_quantization(Stored::Product(product))),
        (IndexSettings { on_disk: true, ..none }, {
            let vectors = VectorParamsBuilder::new(DIM as u64, Distance::Cosine).on_disk(true);
            CreateCollection {
                hnsw_config: Some(HnswConfigDiff { on_disk: Some(true), ..Default::default() }),
                ..CreateCollectionBuilder::new("yard").vectors_config(vectors).on_disk_payload(true).build()
            }
        }),
    ];
    let fixture = fixture();
    for (index, expected) in cases {
        let (server, url) = Server::start(None).await;
        let options = PushOptions { index, ..options(&url) };
        fixture.push(&options).await.expect("pushes");
        assert_eq!(server.with(|state| state.created.clone()), [expected], "{index:?}");
        assert_eq!(server.with(|state| state.updated.clone()), [], "{index:?}");
        fixture.assert_arrived(&server, 1);
    }
}

#[tokio::test]
async fn a_collection_of_other_settings_is_changed_only_where_asked() {
    let (fixture, server, url) = started().await;
    fixture.push(&options(&url)).await.expect("pushes");
    let options = PushOptions { index: ALL, ..options(&url) };
    let report = fixture.push(&options).await.expect("changes");
    assert_eq!((report.n_points, report.n_sent), (N_POINTS, 0));
    let vectors = VectorParamsDiff { on_disk: Some(true), ..Default::default() };
    let request = UpdateCollection {
        collection_name: "yard".into(),
        params: Some(CollectionParamsDiff { on_disk_payload: Some(true), ..Default::default() }),
        hnsw_config: Some(graph()),
        vectors_config: Some(VectorsConfigDiff {
            config: Some(vectors_config_diff::Config::Params(vectors)),
        }),
        quantization_config: Some(QuantizationConfigDiff { quantization: Some(Diff::Scalar(scalar())) }),
        ..Default::default()
    };
    assert_eq!(server.with(|state| state.updated.clone()), [request]);

    // A single setting: the request has no others.
    let index = IndexSettings { hnsw_m: Some(0), ..IndexSettings::default() };
    fixture.push(&PushOptions { index, ..options.clone() }).await.expect("changes");
    let index = IndexSettings { quantisation: Some(Quantisation::None), ..IndexSettings::default() };
    fixture.push(&PushOptions { index, ..options }).await.expect("changes");
    let updated = server.with(|state| state.updated.clone());
    let disabled = QuantizationConfigDiff { quantization: Some(Diff::Disabled(Disabled {})) };
    let graph = HnswConfigDiff { m: Some(0), ..Default::default() };
    let name = || UpdateCollection { collection_name: "yard".into(), ..Default::default() };
    assert_eq!(
        updated[1..],
        [
            UpdateCollection { hnsw_config: Some(graph), ..name() },
            UpdateCollection { quantization_config: Some(disabled), ..name() },
        ]
    );
    fixture.assert_arrived(&server, 1);
}
