//! Inputs and outputs of SAM's two files, matched by name, type and shape.

use ort::value::TensorElementType::{Float32, Int64};

use crate::ModelError;
use crate::session::{Declared, Model, declared, listed, shapes_fit};

/// SAM's masks per prompt: subpart, part and whole, in that order.
pub const MASKS_PER_PROMPT: usize = 3;

#[derive(Debug)]
pub(super) struct Names {
    pub(super) pixels: String,
    /// Tensors that the decoder takes from the encoder.
    pub(super) embeddings: Vec<Link>,
    pub(super) points: String,
    pub(super) labels: String,
    /// Input for boxes, if there is one; it stays empty.
    pub(super) boxes: Option<String>,
    /// Whether the decoder takes one prompt a call.
    pub(super) is_one_by_one: bool,
    pub(super) scores: String,
    pub(super) masks: String,
    /// Output that scores the presence of an object, if there is one.
    pub(super) objects: Option<String>,
}

/// An output of the encoder and the input of the decoder that takes it.
#[derive(Debug)]
pub(super) struct Link {
    pub(super) output: String,
    pub(super) input: String,
}

#[derive(Default)]
struct Inputs {
    points: Vec<String>,
    labels: Vec<String>,
    boxes: Vec<String>,
    embeddings: Vec<Link>,
    others: Vec<String>,
    is_one_by_one: bool,
}

impl Inputs {
    /// Sorts the decoder's inputs; `offered`: the encoder's outputs.
    fn sort(decoder: &Model, offered: &[Declared]) -> Self {
        let mut inputs = Self::default();
        for (name, tensor) in declared(decoder.session.inputs()) {
            let given = offered.iter().find(|(output, _)| *output == name);
            match (given, tensor) {
                (Some((output, Some((Float32, _)))), Some((Float32, _))) => {
                    inputs.embeddings.push(Link { output: output.clone(), input: name });
                }
                (_, Some((Float32, shape))) if matches!(shape[..], [_, _, _, 2]) => {
                    inputs.is_one_by_one = shape[1] == 1;
                    inputs.points.push(name);
                }
                (_, Some((Float32, shape))) if matches!(shape[..], [_, _, 4]) => inputs.boxes.push(name),
                (_, Some((Int64, shape))) if shape.len() == 3 => inputs.labels.push(name),
                _ => inputs.others.push(name),
            }
        }
        // Some exports name a single embedding differently on both sides.
        if let ([_], [(output, Some((Float32, _)))], true) =
            (&inputs.others[..], offered, inputs.embeddings.is_empty())
        {
            let input = inputs.others.swap_remove(0);
            inputs.embeddings.push(Link { output: output.clone(), input });
        }
        inputs
    }
}

impl Names {
    pub(super) fn discover(encoder: &Model, decoder: &Model, size_px: i64) -> Result<Self, ModelError> {
        let pixels = match &declared(encoder.session.inputs())[..] {
            [(name, Some((Float32, shape)))] if matches!(shape[..], [_, 3 | -1, _, _]) => name.clone(),
            _ => {
                let expected = format!("an image encoder's only one, f32 [-1, 3, {size_px}, {size_px}]");
                let found = format!("its inputs are {}", listed(encoder.session.inputs()).join(", "));
                return Err(encoder.layout_error(&found, &expected));
            }
        };
        encoder.expect_input(pixels.as_str(), Float32, &[-1, 3, size_px, size_px])?;

        let offered = declared(encoder.session.outputs());
        let inputs = Inputs::sort(decoder, &offered);
        let ([points], [labels], [] | [_], [_, ..], []) = (
            &inputs.points[..],
            &inputs.labels[..],
            &inputs.boxes[..],
            &inputs.embeddings[..],
            &inputs.others[..],
        ) else {
            let names: Vec<&str> = offered.iter().map(|(name, _)| name.as_str()).collect();
            let expected = format!(
                "points f32 [-1, -1, -1, 2], their labels i64 [-1, -1, -1], the image encoder's {}, boxes \
                 f32 [-1, -1, 4] or none, and no others (no earlier masks)",
                names.join(", ")
            );
            let found = format!("its inputs are {}", listed(decoder.session.inputs()).join(", "));
            return Err(decoder.layout_error(&found, &expected));
        };
        let n_masks = MASKS_PER_PROMPT as i64;
        Ok(Self {
            pixels,
            points: points.clone(),
            labels: labels.clone(),
            boxes: inputs.boxes.first().cloned(),
            is_one_by_one: inputs.is_one_by_one,
            scores: output(decoder, "iou_scores", &[-1, -1, n_masks])?,
            masks: output(decoder, "pred_masks", &[-1, -1, n_masks, -1, -1])?,
            objects: output(decoder, "object_score_logits", &[-1, -1, 1]).ok(),
            embeddings: inputs.embeddings,
        })
    }
}

/// Finds the decoder's f32 output of shape `expected`: the one called `name`, else the first that fits.
fn output(decoder: &Model, name: &str, expected: &[i64]) -> Result<String, ModelError> {
    let outputs = declared(decoder.session.outputs());
    let fits =
        |declared: &&Declared| matches!(&declared.1, Some((Float32, shape)) if shapes_fit(shape, expected));
    let named = outputs.iter().filter(fits).find(|(found, _)| found == name);
    // Any output fits where sizes are not declared, so the object score is found by name only.
    let by_shape = || outputs.iter().find(|declared| expected.last() != Some(&1) && fits(declared));
    let found = named.or_else(by_shape);
    found.map(|(name, _)| name.clone()).ok_or_else(|| {
        let found = format!("its outputs are {}", listed(decoder.session.outputs()).join(", "));
        decoder.layout_error(&found, &format!("one of them f32 {expected:?}"))
    })
}
