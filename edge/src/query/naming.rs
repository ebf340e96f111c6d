//! The names of the generation on board: made on first request, then only read.

use std::sync::{Arc, PoisonError};
use std::time::Duration;

use super::engine::{Engine, OnBoard, QueryError};
use super::names::{Names, Words};
use super::scene::Scene;
use crate::score::Budget;
use crate::text::TextService;

/// Longest wait of a request for the words.
pub(crate) const NAMES_WAIT: Duration = Duration::from_millis(500);

impl Engine {
    /// Returns the names of the things on board, waiting at most `wait` for the words; `None` if the text model is
    /// still encoding them, has stopped, or is not the scene's.
    pub(crate) fn names<'a>(
        &self,
        on_board: &'a OnBoard,
        wait: Duration,
        budget: &Budget,
    ) -> Result<Option<&'a Names>, QueryError> {
        if let Some(names) = on_board.names.get() {
            return Ok(Some(names));
        }
        if on_board.check().is_err() {
            return Ok(None);
        }
        let Some(words) = self.words(&on_board.text).wait(wait) else { return Ok(None) };
        let used_bytes = budget.used_bytes();
        let made = Names::new(words, &Scene::of(&on_board.snapshot), budget);
        budget.give_back_to(used_bytes, 0);
        let made = made?;
        Ok(Some(on_board.names.get_or_init(|| made)))
    }

    pub(crate) fn begin_names(&self) {
        if let Ok(on_board) = self.on_board()
            && on_board.check().is_ok()
        {
            self.words(&on_board.text);
        }
    }

    /// Returns a text model's words; first starts their encoding.
    fn words(&self, text: &Arc<TextService>) -> Arc<Words> {
        let encoder_id = text.info().id;
        let mut kept = self.words.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(words) = kept.as_ref().filter(|words| words.are_of(encoder_id)) {
            return Arc::clone(words);
        }
        let begun = Words::begin(self.cache(), text);
        Arc::clone(kept.insert(begun))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::Ordering;

    use super::*;
    use crate::store::EdgeCache;
    use crate::testing::{
        CALIBRATION, Gate, Member, TestObject, TestShard, axes_service, open_gate, write_cache,
    };

    /// No names while the text model answers a question; then each word is encoded once, for all callers.
    #[test]
    fn names_come_once_the_words_are_encoded() {
        let dir = tempfile::tempdir().expect("a folder");
        let members = (0..9).map(|i| Member { steps: [i, 0, 0], embedding: vec![0.0, 1.0, 0.0] }).collect();
        let object = TestObject {
            id: 4,
            vectors: vec![0.0, 1.0, 0.0],
            runs: std::iter::once(0..9).collect(),
            n_gaussians: 9,
        };
        let shard = TestShard::new(vec![members]).build(false).with_objects(&[object], CALIBRATION);
        write_cache(dir.path(), &[shard], 1);
        let gate = Gate::default();
        let (text, n_encoded) = axes_service(3, Arc::clone(&gate));
        let engine = Engine::new(EdgeCache::open(dir.path()), text);
        engine.reload().expect("a scene");
        let on_board = engine.on_board().expect("a scene");
        let budget = Budget::default();
        std::thread::scope(|threads| {
            threads.spawn(|| on_board.text.run("wait".to_owned()).expect("answers"));
            while n_encoded.load(Ordering::SeqCst) == 0 {
                std::thread::yield_now();
            }
            let early = engine.names(&on_board, Duration::from_millis(20), &budget).expect("no error");
            open_gate(&gate);
            assert!(early.is_none());
        });
        for _ in 0..2 {
            let names = engine.names(&on_board, Duration::from_secs(20), &budget).expect("no error");
            let names = names.expect("the words are encoded");
            assert_eq!((names.len(), names.describe(0)[0].name.as_str()), (1, "1"));
        }
        assert_eq!(n_encoded.load(Ordering::SeqCst), 1 + 3);
    }
}
