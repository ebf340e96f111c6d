//! The description for programs matches this program.

use std::collections::BTreeSet;

use slag_service::openapi::document;
use slag_service::routes::Route;

use super::problem::Members;
use super::router::{ABOUT, described};
use super::*;

pub(super) fn description() -> Value {
    let (_, table) = described();
    serde_json::from_str(&document::<Members>(&ABOUT, &table)).expect("JSON")
}

fn names<'a>(names: impl IntoIterator<Item = &'a str>) -> BTreeSet<&'a str> {
    names.into_iter().collect()
}

/// Checks a value against a schema: types, names (none undescribed, no required one missing), enums.
pub(super) fn check(schema: &Value, value: &Value, at: &str) -> Result<(), String> {
    if let Some(name) = schema["$ref"].as_str() {
        let schema = description().pointer(name.trim_start_matches('#')).cloned();
        return check(&schema.ok_or(format!("{at}: no {name}"))?, value, at);
    }
    if let Some(kinds) = schema["anyOf"].as_array().or(schema["oneOf"].as_array()) {
        let errors: Vec<String> = kinds.iter().filter_map(|kind| check(kind, value, at).err()).collect();
        let fits = kinds.len() - errors.len();
        return if fits == 1 { Ok(()) } else { Err(format!("{at}: fits {fits} kinds: {errors:?}")) };
    }
    let is = |kind: &Value| match kind.as_str() {
        Some("integer") => value.as_u64().is_some(),
        Some("number") => value.is_number(),
        Some("string") => value.is_string(),
        Some("boolean") => value.is_boolean(),
        Some("null") => value.is_null(),
        Some("array") => value.is_array(),
        Some("object") => value.is_object(),
        _ => false,
    };
    let kinds = schema["type"].as_array().cloned().unwrap_or_else(|| vec![schema["type"].clone()]);
    if !kinds.iter().any(is) {
        return Err(format!("{at}: {value} is not of {}", schema["type"]));
    }
    if schema["enum"].as_array().is_some_and(|known| !known.contains(value)) {
        return Err(format!("{at}: {value} is not in {}", schema["enum"]));
    }
    for (i, item) in value.as_array().into_iter().flatten().enumerate() {
        check(&schema["items"], item, &format!("{at}[{i}]"))?;
    }
    if let (Some(members), Some(described)) = (value.as_object(), schema["properties"].as_object()) {
        assert_eq!(schema["additionalProperties"], false, "{at}: a client may not rely on other members");
        let required = schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str);
        if let Some(missing) = required.into_iter().find(|name| !members.contains_key(*name)) {
            return Err(format!("{at}: {missing} is missing"));
        }
        for (name, member) in members {
            let schema = described.get(name).ok_or(format!("{at}: {name} is not described"))?;
            check(schema, member, &format!("{at}.{name}"))?;
        }
    }
    Ok(())
}

#[tokio::test]
async fn every_route_and_parameter_is_described() {
    let service = Service::with_chair();
    let (status, headers, served) = service.get("/openapi.json").await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(headers["content-type"], "application/json");
    let api = description();
    assert_eq!(served, api);
    assert_eq!(api["info"]["version"], env!("CARGO_PKG_VERSION"));
    let (_, table) = described();
    // Events end when the service stops.
    service.app.stopping.send_replace(true);
    let paths = api["paths"].as_object().expect("paths");
    assert_eq!(names(paths.keys().map(String::as_str)), names(table.iter().map(|route| route.path)));
    for route in &table {
        let (path, method) = (route.path, route.method.as_str().to_lowercase());
        assert!(api["paths"][path][&method].is_object(), "{path}");
        let uri = path.replace("{id}", "x");
        assert_ne!(service.get(&uri).await.0, StatusCode::NOT_FOUND, "{path} is described, not served");
        let described = api["paths"][path][&method]["parameters"].as_array().cloned().unwrap_or_default();
        let of_path = described.iter().filter(|p| p["in"] == "path").count();
        assert_eq!(of_path, path.matches('{').count(), "{path}");
        // Unknown parameters are refused.
        if !described.iter().any(|parameter| parameter["in"] == "query") {
            let refused = read(service.send(route.method.as_str(), &format!("{uri}?x=1")).await).await;
            assert_eq!(refused.0.as_u16(), 400, "{path}");
            assert_eq!(refused.2["parameter"], "query string", "{path}");
        }
    }
    let described = api["paths"]["/query"]["get"]["parameters"].as_array().expect("parameters");
    let known: Vec<&str> = described.iter().filter_map(|parameter| parameter["name"].as_str()).collect();
    // By hand.
    let expected = "box format heading_rad kind limit min_count min_score near near_lat_lon negative negatives \
                    offset polygon polygon_lat_lon precision radius relations text threshold time_budget_ms voxel";
    assert_eq!(names(known.iter().copied()), names(expected.split_whitespace()));
    // Values and defaults, by hand too.
    let schema = |name: &str| {
        let parameter = described.iter().find(|p| p["name"] == name).expect("described");
        (parameter["required"].clone(), parameter["schema"]["default"].clone())
    };
    let named = |name: &str| api["components"]["schemas"][name]["enum"].clone();
    assert_eq!(named("AnswerKind"), json!(["objects", "clusters", "gaussians"]));
    assert_eq!(named("Precision"), json!(["centroids", "measured", "exact"]));
    assert_eq!(named("Format").as_array().map(Vec::len), Some(if cfg!(feature = "arrow") { 3 } else { 2 }));
    for (name, is_required, default) in [
        ("text", true, Value::Null),
        ("limit", false, json!(10)),
        ("min_count", false, json!(10)),
        ("precision", false, json!("exact")),
        ("format", false, json!("json")),
        ("relations", false, json!("on")),
    ] {
        assert_eq!(schema(name), (json!(is_required), default), "{name}");
    }
    // The help text has them too.
    let help = service.get("/").await.2;
    let help = help.as_str().expect("text");
    assert!(known.iter().all(|name| help.contains(&format!("    {name}="))), "{help}");
    assert!(help.contains(" Default: 10.\n"), "{help}");
    let listed = |route: &Route| help.contains(&format!("\n{} {} ", route.method, route.path));
    assert!(table.iter().all(listed), "{help}");
}

/// Descriptions come from doc comments: they must make sense to clients.
#[test]
fn descriptions_are_for_clients() {
    fn walk(value: &Value, at: &str, found: &mut impl FnMut(&str, &str, &Value)) {
        for (key, member) in value.as_object().into_iter().flatten() {
            found(at, key, member);
            walk(member, &format!("{at}/{key}"), found);
        }
        value.as_array().into_iter().flatten().for_each(|item| walk(item, at, found));
    }
    let api = description();
    let mut n_refs = 0;
    walk(&api, "", &mut |at, key, member| match (key, member) {
        ("description" | "summary", Value::String(text)) => {
            assert!(text.ends_with('.') || text.ends_with(')'), "{at}: {text}");
            assert!(!text.contains("[`") && !text.contains("::"), "{at}: {text}");
        }
        ("$ref", Value::String(to)) => {
            n_refs += 1;
            assert!(api.pointer(to.trim_start_matches('#')).is_some_and(Value::is_object), "{at}: {to}");
        }
        ("properties", Value::Object(properties))
            if !at.ends_with("/properties") && !at.ends_with("/oneOf") =>
        {
            for (name, property) in properties {
                let is_described = property["description"].is_string() || property["$ref"].is_string();
                assert!(is_described, "{at}: {name} has no description");
            }
        }
        _ => {}
    });
    assert!(n_refs > 50, "{n_refs}");
    assert_eq!(api, description(), "the same bytes each time");
}

#[tokio::test]
async fn every_answer_is_as_described() {
    let exact = {
        let member = |i: u16| Member { steps: [i, 0, 0], embedding: vec![1.0, 0.0, 0.0] };
        [TestShard::new(vec![(0..20).map(member).collect()]).build(true)]
    };
    let service = Service::new(Some(&exact), Settings::default());
    let response_schema = |path: &str, status: StatusCode, kind: &str| {
        let api = description();
        let response = api["paths"][path]["get"]["responses"][status.as_str()].clone();
        assert!(response.is_object(), "{path}: {status} is not described");
        response["content"][kind]["schema"].clone()
    };
    let cases = [
        (
            "/query",
            "text=0&near=0,0,0&radius=9 text=0&kind=gaussians&near=0,0,0 text=0&kind=gaussians&precision=centroids \
             text=0&text=1&negatives=2,1 text=1 text=0&min_count=21 text=0&box=900,900,900,901,901,901 text=0&limit=0 \
             text=sofa text=0&negatives=sofa",
        ),
        ("/status", ""),
    ];
    let is_described = async |service: &Service, path: &str, query: &str| {
        let uri = if path.contains('{') { path.replace("{id}", query) } else { format!("{path}?{query}") };
        let (status, headers, body) = service.get(&uri).await;
        let kind = headers["content-type"].to_str().expect("text");
        assert_eq!(check(&response_schema(path, status, kind), &body, ""), Ok(()), "{uri}: {body:#}");
        body
    };
    let each_query =
        |(path, queries): (&'static str, &'static str)| queries.split(' ').map(move |query| (path, query));
    for (path, query) in cases.into_iter().flat_map(each_query) {
        is_described(&service, path, query).await;
    }
    // Objects come first where there are any.
    let object = TestObject { id: 5, vectors: vec![1.0, 0.0, 0.0], runs: vec![2..8, 8..14], n_gaussians: 40 };
    let service = Service::new(Some(&[exact[0].with_objects(&[object], CALIBRATION)]), Settings::default());
    for (query, kind, n) in
        [("text=0", "objects", 1), ("text=1", "objects", 0), ("text=0&kind=clusters", "clusters", 1)]
    {
        let body = is_described(&service, "/query", &format!("{query}&near=0,0,0")).await;
        assert_eq!(body["kind"], kind, "{body:#}");
        assert_eq!(body["answers"].as_array().map(Vec::len), Some(n), "{body:#}");
    }
    let cases = [
        (
            "/v1/query",
            "text=0&text=1&near=0,0,0 text=0%20near%20the%201&min_score=-1 text=nearest%200&near=0,0,0 \
             text=0%20on%20the%201 text=0&kind=gaussians&negative=1 text=1&kind=clusters text=sofa text=0&limit=0",
        ),
        ("/v1/objects", "limit=1 limit=x sort=name&box=-9,-9,-9,9,9,9 format=geojson"),
        ("/v1/map", ""),
        ("/v1/changes", "text=0&text=1 from=9 to=9 text=sofa"),
        ("/v1/view", ""),
        ("/v1/view/scores", "text=0&limit=1"),
        ("/v1/view/cells/{id}", "4294967295"),
        ("/v1/goal", "text=0&near=0,0,0 near=0,0,0 text=sofa"),
        ("/v1/floor", "radius_m=9 "),
        ("/v1/objects/{id}", "o0000000000000005 o0000000000000006 5"),
    ];
    for (path, query) in cases.into_iter().flat_map(each_query) {
        is_described(&service, path, query).await;
    }
    is_described(&Service::new(None, Settings::default()), "/status", "").await;
}
