//! From questions to their answers.

use std::collections::BTreeMap;
use std::sync::Arc;

use slag_service::params::RequestError;

use super::answer::{Answering, answer};
use super::answers::{Answers, Reply};
use super::ask::Ask;
use super::engine::{Engine, OnBoard, QueryError};
use super::relations;
use super::request::{Asked, QueryRequest, unit_vector};
use super::scene::Scene;
use crate::score::{Budget, Question};

/// Memory for the candidates of a thing: 256 of 1 kB.
const CANDIDATES_BYTES: usize = 256 << 10;

impl Engine {
    /// Answers questions from the loaded generation. Blocks for milliseconds of computing, within the budget's time.
    pub fn ask(&self, ask: Ask, budget: &Budget) -> Result<Reply, QueryError> {
        let on_board = self.on_board()?;
        on_board.check()?;
        let request = ask.in_world(&on_board.snapshot.manifest)?;
        on_board.answer(request, budget)
    }
}

impl OnBoard {
    /// As [`Engine::ask`], for a request in the world frame.
    pub fn answer(&self, mut request: QueryRequest, budget: &Budget) -> Result<Reply, QueryError> {
        self.check()?;
        let snapshot = &self.snapshot;
        request.understand(snapshot)?;
        request.check()?;
        let negatives = self.encode_negatives(&request)?;
        let question = |vector: Arc<[f32]>| Question { vector, negatives: negatives.clone() };
        let scene = Scene::of(snapshot);
        let answering = Answering { scene: &scene, request: &request, budget };
        let mut all: Vec<Option<Answers>> = request.asked.iter().map(|_| None).collect();
        let (mut places, mut labels, mut plain) = (Vec::new(), Vec::new(), Vec::new());
        for (at, asked) in request.asked.iter().enumerate() {
            let vector = match asked {
                Asked::Text(text) => self.encode(text)?,
                Asked::Vector { vector, .. } => vector_of(vector, snapshot.manifest.encoder.dim)?,
                Asked::Phrase { phrase, .. } => {
                    let things = phrase.things().into_iter();
                    let questions = things.map(|thing| Ok(question(self.encode(thing)?)));
                    let questions = questions.collect::<Result<Vec<_>, QueryError>>()?;
                    let of_thing = snapshot.objects.len() * size_of::<f32>() + CANDIDATES_BYTES;
                    budget.take(questions.len() * of_thing);
                    budget.check()?;
                    all[at] = Some(answering.related(asked.label(), phrase, &questions)?);
                    budget.check()?;
                    continue;
                }
            };
            places.push(at);
            labels.push(asked.label());
            plain.push(question(vector));
        }
        if !plain.is_empty() {
            let answers = answer(&scene, (labels.as_slice(), plain.as_slice()), &request, budget)?;
            places.into_iter().zip(answers).for_each(|(at, answers)| all[at] = Some(answers));
        }
        let mut answers: Vec<Answers> = all.into_iter().flatten().collect();
        for (answers, asked) in answers.iter_mut().zip(&request.asked) {
            answers.asked_as = self.asked_as(asked, &request);
        }
        Ok(Reply { request, answers, snapshot: Arc::clone(snapshot) })
    }

    /// Returns the texts that replace things and negatives with words unknown to the model.
    fn asked_as(&self, asked: &Asked, request: &QueryRequest) -> BTreeMap<String, String> {
        let things: Vec<String> = match asked {
            Asked::Text(text) => vec![relations::asked_thing(text).unwrap_or_else(|| text.clone())],
            Asked::Phrase { phrase, .. } => phrase.things().into_iter().map(str::to_owned).collect(),
            Asked::Vector { .. } => Vec::new(),
        };
        let negatives = request.negatives.0.iter().cloned();
        let asked_as = |thing: String| self.text.asked_as(&thing).map(|asked| (thing, asked));
        things.into_iter().chain(negatives).filter_map(asked_as).collect()
    }
}

/// Returns the vector of a vector question, at unit length.
fn vector_of(vector: &[f32], dim: u32) -> Result<Arc<[f32]>, QueryError> {
    if vector.len() != dim as usize {
        let found = format!("{} components", vector.len());
        let expected = format!("{dim}, as the scene's embeddings have");
        return Err(RequestError::new("vectors", &found, expected).into());
    }
    Ok(unit_vector(vector).unwrap_or_default().into())
}
