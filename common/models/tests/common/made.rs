//! A generated model directory; tests can compute its vectors themselves.

use std::path::Path;

use super::onnx::{Element, Graph, constant, model, node, value};

pub const DIM: usize = 4;
/// Tokens that the text model knows; the tokenizer has [`VOCABULARY`].
pub const N_TOKENS: usize = 8;
pub const SIZE_PX: u32 = 8;
/// The tokenizer's vocabulary, by id; 1 ends a text, as in SigLIP's.
pub const VOCABULARY: [&str; 8] = ["<pad>", "</s>", "<unk>", "▁a", "▁red", "▁chair", "▁", "s"];

/// The text model's vector of a token.
pub fn row(id: u32) -> [f32; DIM] {
    // Exact in f16.
    std::array::from_fn(|k| ((id as i64 * 7 + k as i64 * 3) % 11 - 5) as f32 / 4.0)
}

/// The image model's weights, `[3][DIM]`.
pub const WEIGHTS: [f32; 3 * DIM] = [1.0, 0.5, -0.25, 0.0, 0.0, 1.0, 0.5, -0.5, 0.25, 0.0, 1.0, 1.0];

#[derive(Clone, Copy)]
pub struct TextKind {
    pub ids: Element,
    pub floats: Element,
    pub has_mask: bool,
    /// -1: any.
    pub n_tokens: i64,
}

impl Default for TextKind {
    fn default() -> Self {
        Self { ids: Element::I64, floats: Element::F32, has_mask: false, n_tokens: -1 }
    }
}

/// The mean of the tokens' rows; with a mask, the sum of the unmasked ones.
pub fn text_graph(kind: TextKind) -> Graph {
    let table: Vec<f32> = (0..N_TOKENS as u32).flat_map(row).collect();
    let shape = [N_TOKENS as i64, DIM as i64];
    let mut nodes = vec![
        node("Cast", &["input_ids"], "ids", &[("to", &[Element::I64.code()])]),
        node("Gather", &["table", "ids"], "rows", &[("axis", &[0])]),
    ];
    let mut inputs = vec![value("input_ids", kind.ids, &[1, kind.n_tokens])];
    if kind.has_mask {
        inputs.push(value("attention_mask", kind.ids, &[1, kind.n_tokens]));
        nodes.extend([
            node("Cast", &["attention_mask"], "weights", &[("to", &[kind.floats.code()])]),
            node("Unsqueeze", &["weights"], "line", &[("axes", &[1])]),
            node("MatMul", &["line", "rows"], "contributions", &[]),
            node("Squeeze", &["contributions"], "text_embeds", &[("axes", &[1])]),
        ]);
    } else {
        let attributes: &[(&str, &[i64])] = &[("axes", &[1]), ("keepdims", &[0])];
        nodes.push(node("ReduceMean", &["rows"], "text_embeds", attributes));
    }
    Graph {
        nodes,
        constants: vec![constant("table", kind.floats, &shape, &table)],
        inputs,
        outputs: vec![
            value("rows", kind.floats, &[1, -1, DIM as i64]),
            value("text_embeds", kind.floats, &[1, DIM as i64]),
        ],
    }
}

/// The mean colour times [`WEIGHTS`]; `divides` by the largest value of the batch, so that vectors vary with it.
pub fn image_graph(floats: Element, batch: i64, divides: bool) -> Graph {
    let size = i64::from(SIZE_PX);
    let last = if divides { "undivided" } else { "image_embeds" };
    let mut nodes = vec![
        node("ReduceMean", &["pixel_values"], "colour", &[("axes", &[2, 3]), ("keepdims", &[0])]),
        node("MatMul", &["colour", "weights"], last, &[]),
    ];
    if divides {
        let attributes: [(&str, &[i64]); 2] = [("axes", &[0, 1, 2, 3]), ("keepdims", &[0])];
        nodes.push(node("ReduceMax", &["pixel_values"], "largest", &attributes));
        nodes.push(node("Div", &["undivided", "largest"], "image_embeds", &[]));
    }
    Graph {
        nodes,
        constants: vec![constant("weights", floats, &[3, DIM as i64], &WEIGHTS)],
        inputs: vec![value("pixel_values", floats, &[batch, 3, size, size])],
        outputs: vec![value("image_embeds", floats, &[batch, DIM as i64])],
    }
}

/// A tokenizer of SigLIP's kind: lower case, no punctuation, pieces of words with their likelihood, an end token.
pub fn tokenizer(vocabulary: &[&str]) -> String {
    let pieces: Vec<String> =
        vocabulary.iter().map(|piece| format!("[{piece:?}, {}]", -(piece.len() as f64).recip())).collect();
    format!(
        r#"{{"version":"1.0","added_tokens":[{{"id":1,"content":"</s>","single_word":false,"lstrip":false,"rstrip":false,
        "normalized":false,"special":true}}],
        "normalizer":{{"type":"Sequence","normalizers":[{{"type":"Lowercase"}},
            {{"type":"Replace","pattern":{{"Regex":"[!-/:-@\\[-`{{-~]"}},"content":""}}]}},
        "pre_tokenizer":{{"type":"Metaspace","replacement":"▁","prepend_scheme":"always","split":true}},
        "post_processor":{{"type":"TemplateProcessing","single":[{{"Sequence":{{"id":"A","type_id":0}}}},
            {{"SpecialToken":{{"id":"</s>","type_id":0}}}}],"pair":[{{"Sequence":{{"id":"A","type_id":0}}}}],
            "special_tokens":{{"</s>":{{"id":"</s>","ids":[1],"tokens":["</s>"]}}}}}},
        "decoder":null,"model":{{"type":"Unigram","unk_id":2,"vocab":[{}]}}}}"#,
        pieces.join(",")
    )
}

/// A description of the made models; tests change it by replacing.
pub const DESCRIPTION: &str = r#"
name = "made"
dim = 4
licence = "none"

[image]
file = { path = "vision.onnx" }
input = "pixel_values"
size_px = 8
resize = "stretch"
mean = [0.5, 0.5, 0.5]
std = [0.5, 0.5, 0.5]
normalise = true

[text]
kind = "onnx"
file = { path = "text.onnx" }
tokenizer = { path = "tokenizer.json" }
input_ids = "input_ids"
max_tokens = 8
end_token_id = 1
prompt = "{}"
"#;

/// Writes the files of a model directory.
pub fn write(folder: &Path, description: &str, text: &Graph, image: &Graph) {
    for (name, bytes) in [
        ("model.toml", description.as_bytes()),
        ("text.onnx", &model(text)),
        ("vision.onnx", &model(image)),
        ("tokenizer.json", tokenizer(&VOCABULARY).as_bytes()),
    ] {
        fs_err::write(folder.join(name), bytes).expect("it is writable");
    }
}
