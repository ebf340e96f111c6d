//! `format=ply`: the points are the Gaussians of the answers in JSON.

use std::collections::BTreeMap;

use super::*;

/// Two things, 20 m apart, each in two cells: in one every Gaussian matches, in the other every second.
fn two_things(has_packed_indices: bool) -> [BuiltShard; 2] {
    [(5u32, 0u16), (9, 2_000)].map(|(cell_id, x)| {
        let member = |i: u16| {
            let matches = cell_id == 5 || i.is_multiple_of(2);
            let embedding = if matches { vec![0.8, 0.6, 0.0] } else { vec![0.0, 0.0, 1.0] };
            Member { steps: [x + i % 10, i / 10, 3], embedding }
        };
        let (here, there): (Vec<Member>, Vec<Member>) =
            (0..60).map(member).partition(|m| m.embedding[0] > 0.0);
        let centroids = [here, there].into_iter().filter(|members| !members.is_empty()).collect();
        TestShard { cell_id, has_packed_indices, ..TestShard::new(centroids) }.build(false)
    })
}

type Point = BTreeMap<String, f64>;

/// Parses a PLY by its own header: comments and points.
fn points(bytes: &[u8]) -> (Vec<String>, Vec<Point>) {
    let end = bytes.windows(11).position(|w| w == b"end_header\n").expect("a header") + 11;
    let header = std::str::from_utf8(&bytes[..end]).expect("ASCII");
    let of = |key: &str| header.lines().filter_map(|line| line.strip_prefix(key)).collect::<Vec<_>>();
    assert!(header.starts_with("ply\nformat binary_little_endian 1.0\n"), "{header}");
    let n: usize = of("element vertex ")[0].parse().expect("a number");
    let properties: Vec<(&str, &str)> =
        of("property ").into_iter().map(|line| line.split_once(' ').expect("a type and a name")).collect();
    let mut at = &bytes[end..];
    let mut take = |kind: &str| {
        let (value, len) = match kind {
            "uint" => (f64::from(u32::from_le_bytes(at[..4].try_into().expect("4 bytes"))), 4),
            "float" => (f64::from(f32::from_le_bytes(at[..4].try_into().expect("4 bytes"))), 4),
            "double" => (f64::from_le_bytes(at[..8].try_into().expect("8 bytes")), 8),
            other => panic!("{other}"),
        };
        at = &at[len..];
        value
    };
    let points = (0..n)
        .map(|_| properties.iter().map(|(kind, name)| ((*name).to_owned(), take(kind))).collect())
        .collect();
    assert!(at.is_empty(), "{} bytes after the last point", at.len());
    (of("comment ").into_iter().map(str::to_owned).collect(), points)
}

async fn get_points(service: &Service, query: &str) -> (Vec<String>, Vec<Point>) {
    let response = service.send("GET", &format!("/query?{query}&format=ply")).await;
    let (status, kind) = (response.status(), response.headers()["content-type"].clone());
    let body = to_bytes(response.into_body(), 1 << 20).await.expect("a body");
    assert_eq!(status, StatusCode::OK, "{}", String::from_utf8_lossy(&body));
    assert_eq!(kind, "application/octet-stream");
    points(&body)
}

#[tokio::test]
async fn points_are_the_gaussians_of_the_answers() {
    let service = Service::new(Some(&two_things(true)), Settings::default());
    let (comments, points) = get_points(&service, "text=0&threshold=0.5").await;
    assert_eq!(comments, ["text 0", "scene yard", "generation 1", "unit m"]);
    let (_, _, json) = service.get("/query?text=0&threshold=0.5").await;
    let answers = json["answers"].as_array().expect("a list");
    assert_eq!((answers.len(), points.len(), &json["n_matching"]), (2, 90, &json!(90)));
    for (rank, answer) in (1..).zip(answers) {
        let of: Vec<&Point> = points.iter().filter(|point| point["answer"] == f64::from(rank)).collect();
        assert_eq!(of.len() as u64, answer["n_gaussians"].as_u64().expect("a number"));
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            let (low, high) = (&answer["box_min_in_world"][axis], &answer["box_max_in_world"][axis]);
            // The box excludes two percent at either end.
            let inside = |p: &&&Point| Some(p[name]) >= low.as_f64() && Some(p[name]) <= high.as_f64();
            assert!(of.iter().filter(inside).count() >= of.len() * 9 / 10, "{name}");
        }
        // Test shards number their Gaussians 1, 4, 7 and so on.
        assert!(of.iter().all(|point| point["input_index"] == 3.0 * point["index"] + 1.0));
        assert!(of.iter().all(|point| (point["score"] - 0.8).abs() < 0.01));
    }
    let indices = |cell: f64| points.iter().filter(move |p| p["cell"] == cell).map(|p| p["index"] as usize);
    assert_eq!(indices(5.0).collect::<Vec<_>>(), (0..60).collect::<Vec<_>>());
    assert_eq!(indices(9.0).collect::<Vec<_>>(), (0..30).collect::<Vec<_>>());

    // Gaussians, one by one, as JSON lists them; a region cuts a run.
    let query = "text=0&kind=gaussians&limit=1000&threshold=0.5&box=0,0.02,0,0.05,0.04,1";
    let (_, points) = get_points(&service, query).await;
    let (_, _, json) = service.get(&format!("/query?{query}")).await;
    let found = json["answers"].as_array().expect("a list");
    // x within 0 to 0.05 and y within 0.02 to 0.04, both ends included, on a grid of 0.01.
    assert_eq!((points.len(), found.len()), (6 * 3, 6 * 3));
    for (point, gaussian) in points.iter().zip(found) {
        let names =
            [("cell", "cell_id"), ("index", "index"), ("input_index", "input_index"), ("answer", "rank")];
        assert!(names.iter().all(|(a, b)| Some(point[*a]) == gaussian[b].as_f64()), "{point:?} {gaussian}");
        assert_eq!(json!([point["x"], point["y"], point["z"]]), gaussian["position_in_world"]);
    }

    // Several texts: one without an answer, one that the thirty other Gaussians of the second cell match.
    let (comments, points) =
        get_points(&service, "text=1&text=2%0Aelement&text=0&threshold=0.7&negatives=none").await;
    assert_eq!(comments[1], "text 2\\nelement");
    let n_of = |question: f64| points.iter().filter(|point| point["question"] == question).count();
    assert_eq!([n_of(0.0), n_of(1.0), n_of(2.0), points.len()], [0, 30, 90, 120]);
    assert_eq!(get_points(&service, "text=1&threshold=0.9").await.1, Vec::<Point>::new());
}

#[tokio::test]
async fn shards_without_indices_have_points_without() {
    let service = Service::new(Some(&two_things(false)), Settings::default());
    let (_, points) = get_points(&service, "text=0&threshold=0.5").await;
    assert!(points.len() == 90 && points.iter().all(|point| !point.contains_key("input_index")));
}

/// An object's points are its runs in the region, not only matching Gaussians.
#[tokio::test]
async fn objects_have_their_own_gaussians() {
    let [first, _] = two_things(true);
    let object =
        TestObject { id: 5, vectors: vec![1.0, 0.0, 0.0], runs: vec![2..8, 14..20], n_gaussians: 40 };
    let service = Service::new(Some(&[first.with_objects(&[object], CALIBRATION)]), Settings::default());
    let (_, points) = get_points(&service, "text=0&threshold=0.5").await;
    let indices: Vec<f64> = points.iter().map(|point| point["index"]).collect();
    let expected: Vec<f64> = (2..8).chain(14..20).map(f64::from).collect();
    assert_eq!(indices, expected);
    // Indices 3 to 7 and 14 to 19 of rows of ten: x from 0.03 on, and 0.04 on.
    let (_, points) = get_points(&service, "text=0&threshold=0.5&min_count=1&box=0.035,0,0,9,9,9").await;
    let indices: Vec<f64> = points.iter().map(|point| point["index"]).collect();
    assert_eq!(indices, (4..8).chain(14..20).map(f64::from).collect::<Vec<_>>());
}
