//! Answers of every kind and length.

use arrow_array::cast::AsArray;
use arrow_array::types::{Float32Type, Float64Type, UInt32Type};
use arrow_ipc::reader::StreamReader;
use futures_util::TryStreamExt;

use super::*;

const ARROW: &str = "application/vnd.apache.arrow.stream";

/// 40,000 Gaussians of axis 0 and 20,000 between axes 0 and 1, in two cells.
fn many() -> [BuiltShard; 2] {
    let shard = |cell_id: u32, n: u16, embedding: [f32; 3]| {
        let member = |i: u16| Member { steps: [i, i % 7, 0], embedding: embedding.to_vec() };
        let rows = (0..4).map(|row| (row * (n / 4)..(row + 1) * (n / 4)).map(member).collect());
        let origin = DVec3::new(f64::from(cell_id) * 1e3, 0.0, 0.0);
        TestShard { cell_id, origin, ..TestShard::new(rows.collect()) }.build(false)
    };
    [shard(5, 40_000, [1.0, 0.0, 0.0]), shard(9, 20_000, [0.8, 0.6, 0.0])]
}

async fn pieces(response: Response) -> Result<Vec<Vec<u8>>, axum::Error> {
    let body = response.into_body().into_data_stream();
    soon(body.map_ok(|piece| piece.to_vec()).try_collect()).await
}

/// A long answer is streamed: JSON of 60,000 Gaussians in pieces of 64 KiB.
#[tokio::test]
async fn long_answers_come_in_small_pieces() {
    let service = Service::new(Some(&many()), Settings::default());
    let uri = "/query?text=0&kind=gaussians&limit=60000&near=0,0,0&threshold=0.5";
    let pieces = pieces(service.send("GET", uri).await).await.expect("a whole body");
    let total: usize = pieces.iter().map(Vec::len).sum();
    let longest = pieces.iter().map(Vec::len).max().expect("pieces");
    assert!(total > 6 << 20 && longest < 66 << 10, "{total} bytes, the longest piece {longest}");
    let body: Value = serde_json::from_slice(&pieces.concat()).expect("JSON");
    let answers = body["answers"].as_array().expect("a list");
    assert_eq!((answers.len(), &body["n_matching"]), (60_000, &60_000.into()));
    for (at, answer) in answers.iter().enumerate() {
        // The scores tie in each cell; the nearest to the origin come first.
        let (cell, index) = if at < 40_000 { (5, at) } else { (9, at - 40_000) };
        assert_eq!(answer["rank"], (at + 1));
        assert_eq!(answer["cell_id"], cell);
        assert_eq!(answer["index"], index);
    }
    assert_eq!(answers[40_000]["position_in_world"], json!([9000.0, 0.0, 0.0]));
    assert_eq!(service.app.permits.available_permits(), service.app.settings.max_queries);
}

#[tokio::test]
async fn columns_say_what_json_says() {
    let service = Service::new(Some(&many()), Settings::default());
    let query = "/query?kind=gaussians&limit=50000&threshold=0.5";
    let uri = format!("{query}&text=0&format=arrow");
    let response = service.send("GET", &uri).await;
    assert_eq!(response.headers()["content-type"], ARROW);
    let pieces = pieces(response).await.expect("a whole body");
    let longest = pieces.iter().map(Vec::len).max().expect("pieces");
    assert!(pieces.len() > 4 && longest < 600 << 10, "{} pieces, the longest {longest}", pieces.len());

    let bytes = pieces.concat();
    let reader = StreamReader::try_new(&bytes[..], None).expect("a stream");
    let schema = reader.schema();
    let names: Vec<&str> = schema.fields().iter().map(|field| field.name().as_str()).collect();
    assert_eq!(names, ["x", "y", "z", "score", "cell", "index"]);
    let meta = |name: &str| schema.metadata()[name].as_str();
    assert_eq!([meta("scene"), meta("generation"), meta("frame"), meta("unit")], ["yard", "1", "world", "m"]);
    assert_eq!([meta("threshold"), meta("score_kind")], ["0.5", "cosine"]);
    let (_, _, expected) = read_large(service.send("GET", &format!("{query}&text=0")).await).await;
    let questions: Value = serde_json::from_str(meta("questions")).expect("JSON");
    assert_eq!(questions[0]["n_matching"], expected["n_matching"]);
    assert_eq!(meta("score_error_bound"), expected["score_error_bound"].to_string());
    let mut rows = expected["answers"].as_array().expect("a list").iter();
    for batch in reader {
        let batch = batch.expect("a batch");
        let of = |name: &str| batch.column_by_name(name).expect("a column");
        for i in 0..batch.num_rows() {
            let row = rows.next().expect("as many rows");
            let at = ["x", "y", "z"].map(|axis| of(axis).as_primitive::<Float64Type>().value(i));
            assert_eq!(json!(at), row["position_in_world"]);
            let score = row["score"].as_f64().expect("a number") as f32;
            assert_eq!(of("score").as_primitive::<Float32Type>().value(i), score);
            assert_eq!(json!(of("cell").as_primitive::<UInt32Type>().value(i)), row["cell_id"]);
            assert_eq!(json!(of("index").as_primitive::<UInt32Type>().value(i)), row["index"]);
        }
    }
    assert!(rows.next().is_none());
}

async fn read_large(response: Response) -> (StatusCode, HeaderMap, Value) {
    let (head, body) = response.into_parts();
    let bytes = to_bytes(body, 64 << 20).await.expect("a body");
    (head.status, head.headers, serde_json::from_slice(&bytes).expect("JSON"))
}

#[tokio::test]
async fn several_texts_make_a_batch() {
    let service = Service::new(Some(&many()), Settings::default());
    for rest in ["&limit=3", "&kind=gaussians&limit=3000&threshold=0.5", "&kind=gaussians&negatives=2%20x"] {
        let (_, _, batch) =
            read_large(service.send("GET", &format!("/query?text=1&text=0&text=2{rest}")).await).await;
        let batch = batch["batch"].as_array().expect("a batch");
        assert_eq!(batch.len(), 3);
        for (text, together) in ["1", "0", "2"].iter().zip(batch) {
            let (_, _, alone) =
                read_large(service.send("GET", &format!("/query?text={text}{rest}")).await).await;
            assert_eq!(together, &alone, "{text}{rest}");
        }
    }
    let uri = "/query?text=1&text=0&kind=gaussians&limit=20000&threshold=0.5&format=arrow";
    let bytes = pieces(service.send("GET", uri).await).await.expect("a whole body").concat();
    let mut counts = [0; 2];
    for batch in StreamReader::try_new(&bytes[..], None).expect("a stream") {
        let batch = batch.expect("a batch");
        let question = batch.column_by_name("question").expect("a column").as_primitive::<UInt32Type>();
        question.values().iter().for_each(|question| counts[*question as usize] += 1);
    }
    assert_eq!(counts, [20_000, 20_000]);
}

/// `format` or `Accept` asks for columns, the default is JSON; an empty answer has columns without rows.
#[tokio::test]
async fn formats_are_negotiated() {
    let service = Service::with_chair();
    let get = |uri: &str, accept: &str| {
        let request = Request::builder().uri(uri).header("accept", accept).body(Body::empty()).unwrap();
        let router = router(Arc::clone(&service.app));
        async move {
            let response = router.oneshot(request).await.expect("infallible");
            response.headers()["content-type"].to_str().expect("text").to_owned()
        }
    };
    assert_eq!(get("/query?text=0&kind=gaussians", &format!("text/html, {ARROW};q=0.9")).await, ARROW);
    assert_eq!(get("/query?text=0&kind=gaussians", "*/*").await, "application/json");
    assert_eq!(get("/query?text=0&kind=gaussians&format=json", ARROW).await, "application/json");
    assert_eq!(get("/query?text=0", ARROW).await, "application/problem+json");
    let uri = "/query?text=1&kind=gaussians&format=arrow";
    let bytes = pieces(service.send("GET", uri).await).await.expect("a whole body").concat();
    let mut reader = StreamReader::try_new(&bytes[..], None).expect("a stream");
    let questions: Value = serde_json::from_str(&reader.schema().metadata()["questions"]).expect("JSON");
    assert_eq!(questions[0]["reason"]["kind"], "below-threshold");
    assert!(reader.next().is_none());
}

/// A client that does not read holds no permit; its answer is visibly cut off and releases its memory.
#[tokio::test]
async fn answers_that_nobody_reads_stop_nobody() {
    let settings = Settings { max_queries: 1, stream_timeout: Duration::from_secs(1), ..Settings::default() };
    let service = Service::new(Some(&many()), settings);
    let uri = "/query?text=0&kind=gaussians&limit=60000&threshold=0.5";
    let response = service.send("GET", uri).await;
    assert_eq!(response.status(), StatusCode::OK);
    drop(soon(service.app.permits.acquire()).await.expect("the answer is computed"));
    assert_eq!(service.get("/query?text=0").await.0, StatusCode::OK);
    tokio::time::sleep(Duration::from_millis(1200)).await;
    assert!(soon(pieces(response)).await.is_err(), "the end must be an error");
}
