use slag_common::Hash32;
use slag_test_support::assert_error;

use super::*;
use crate::cells::CellLimits;
use crate::encode::EncodeSettings;

fn plan() -> RunPlan {
    let settings = EncodeSettings::new("a".into(), "b".into(), "c".into(), true);
    RunPlan {
        program: documents::own_version(),
        coordinator: 1,
        engines: "none".into(),
        of_scene: Hash32([1; 32]),
        scene: Hash32([2; 32]),
        settings: settings.view,
        limits: CellLimits::by_count(5),
        data_set: None,
        views: Vec::new(),
    }
}

/// A second coordinator supersedes the first, which can no longer publish; a published run is followed instead.
#[test]
fn one_put_decides_who_publishes() {
    let dir = tempfile::tempdir().expect("a folder");
    let bucket = Bucket::open(dir.path().to_str().expect("UTF-8"), []).expect("opens");
    assert!(Run::open(&bucket).expect("reads").is_none());
    let first = Run::begin(&bucket, &plan()).expect("begins");
    assert_eq!(Run::open(&bucket).expect("reads").map(|(run, _)| run), Some(first));
    assert!(first.is_open(&bucket).expect("reads"));
    let second = Run::begin(&bucket, &plan()).expect("begins");
    first.check(&bucket).expect_err("superseded");
    assert_error(first.publish(&bucket), &["run 1 was superseded"]);
    assert!(second.is_open(&bucket).expect("reads") && !first.is_open(&bucket).expect("reads"));
    second.views_are_done(&bucket).expect("puts");
    assert!(Run::open(&bucket).expect("reads").is_none(), "workers have nothing to do");
    second.check(&bucket).expect("it is still the newest");
    second.publish(&bucket).expect("publishes");
    assert!(Run::open(&bucket).expect("reads").is_none());
    assert_eq!(Run::begin(&bucket, &plan()).expect("begins"), Run(3));
}

#[test]
fn a_plan_of_another_version_is_refused() {
    let dir = tempfile::tempdir().expect("a folder");
    let bucket = Bucket::open(dir.path().to_str().expect("UTF-8"), []).expect("opens");
    bucket.put("jobs/00000001/plan.json", r#"{"program": "7.0.0", "news": 1}"#).expect("puts");
    assert_error(Run::open(&bucket), &["7.0.0", env!("CARGO_PKG_VERSION")]);
}
