use std::time::Duration;

use super::*;
use crate::score::{OverBudget, Pool, ScoreError};

/// A request gets its answer or an error that names the budget, and releases its memory in both cases.
#[test]
fn a_budget_is_enough_or_is_named() {
    let yard = yard();
    let questions = [Question::new([1.0, 0.0]), Question::new([0.6, 0.8])];
    let pool = Pool::new(u64::MAX);
    for kind in [AnswerKind::Clusters, AnswerKind::Gaussians] {
        let request = QueryRequest {
            asked: ["thing", "other"].map(|text| Asked::Text(text.into())).to_vec(),
            kind: Some(kind),
            threshold: Some(-1.0),
            voxel: Some(1e-9),
            min_count: 1,
            limit: Some(1),
            ..QueryRequest::new("thing")
        };
        let ask = |budget: Budget| {
            let labels = ["thing", "other"];
            on_scene(&yard, |scene| answer(scene, (&labels, &questions), &request, &budget))
        };
        let expected = ask(Budget::default()).expect("without bounds");
        let (mut n_refused, mut is_answered) = (0, false);
        for bytes in (0..22).map(|power| 1u64 << power) {
            let answers = ask(Budget::new(bytes, Duration::from_secs(3600), &pool));
            match answers {
                Ok(answers) => {
                    assert_eq!(answers, expected, "{bytes}");
                    is_answered = true;
                }
                Err(error) => {
                    assert_eq!(error, ScoreError::OverBudget(OverBudget::Bytes { bytes }));
                    assert!(!is_answered && error.to_string().contains(&bytes.to_string()), "{error}");
                    n_refused += 1;
                }
            }
            assert_eq!(pool.used_bytes(), 0);
        }
        assert!(is_answered && n_refused > 4, "{kind:?}: {n_refused}");
        let error = ask(Budget::new(u64::MAX, Duration::ZERO, &pool)).expect_err("no time");
        assert_eq!(error, ScoreError::OverBudget(OverBudget::Time { time: Duration::ZERO }));
    }
}
