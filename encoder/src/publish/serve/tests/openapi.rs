//! The description for programs matches this program. `tests/schemathesis.rs` holds its answers against it.

use std::collections::BTreeSet;

use super::*;

#[tokio::test]
async fn every_route_and_parameter_is_described() {
    let router = fixture().router();
    let served = get_with(&router, "/openapi.json", &[]).await;
    assert_eq!((served.status, served.header(header::CONTENT_TYPE)), (StatusCode::OK, "application/json"));
    let api = served.json();
    assert_eq!(api["info"]["version"], env!("CARGO_PKG_VERSION"));
    let (_, table) = router::described();
    let of_table: BTreeSet<_> = table.iter().map(|route| route.path).collect();
    assert_eq!(
        api["paths"].as_object().expect("paths").keys().map(String::as_str).collect::<BTreeSet<_>>(),
        of_table
    );
    for route in &table {
        let operation = &api["paths"][route.path][route.method.as_str().to_lowercase()];
        assert!(operation.is_object(), "{}", route.path);
        let described = operation["parameters"].as_array().into_iter().flatten();
        let of_query = described.filter(|parameter| parameter["in"] == "query");
        let of_query: BTreeSet<_> = of_query.filter_map(|parameter| parameter["name"].as_str()).collect();
        assert_eq!(of_query, route.query().map(|parameter| parameter.name).collect(), "{}", route.path);
    }
}
