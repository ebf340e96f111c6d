//! Encoders with the variations of CLIP and SigLIP exports: element types, masks, padding, unnamed outputs,
//! batches. The models are generated here; the expected vectors are computed from their tables in f64.

use super::*;
use crate::common::made::{
    DESCRIPTION, DIM, SIZE_PX, TextKind, VOCABULARY, WEIGHTS, image_graph, row, text_graph, tokenizer, write,
};
use crate::common::onnx::{Element, model, value};
use slag_models::Provider;

fn made(description: &str, text: TextKind, image: (Element, i64, bool)) -> TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    write(folder.path(), description, &text_graph(text), &image_graph(image.0, image.1, image.2));
    folder
}

/// The mean of the rows of `ids`, of unit length.
fn mean_of(ids: &[u32]) -> Vec<f64> {
    let sum: Vec<f32> = (0..DIM).map(|k| ids.iter().map(|&id| row(id)[k]).sum()).collect();
    unit(&sum)
}

#[test]
fn ids_masks_and_floats_may_be_of_any_kind() {
    let options = options();
    for ids in [Element::I64, Element::I32] {
        for floats in [Element::F32, Element::F16] {
            for has_mask in [false, true] {
                let mask = "input_ids = \"input_ids\"\nattention_mask = \"attention_mask\"";
                let description = match has_mask {
                    true => DESCRIPTION.replace("input_ids = \"input_ids\"", mask),
                    false => DESCRIPTION.to_owned(),
                };
                let kind = TextKind { ids, floats, has_mask, n_tokens: -1 };
                let folder = made(&description, kind, (floats, -1, false));
                let model = ModelDir::open(folder.path()).expect("it opens");
                let found = model.text_encoder(&options).unwrap().encode("A red chair").unwrap();
                let tolerance = if floats == Element::F16 { 2e-3 } else { 1e-6 };
                let holds = max_difference(&found, &mean_of(&[3, 4, 5, 1])) < tolerance;
                assert!(holds, "{ids:?} {floats:?} {has_mask}");

                let mut encoder = model.image_encoder(&options).expect("it loads");
                let colour = [200u8, 40, 90];
                let crop = Crop::whole(RgbImage::from_pixel(SIZE_PX, SIZE_PX, Rgb(colour)));
                let found = encoder.encode(&[crop]).expect("it runs");
                let value = |c: usize| (f64::from(colour[c]) / 255.0 - 0.5) / 0.5;
                let expected: Vec<f32> = (0..DIM)
                    .map(|k| (0..3).map(|c| value(c) * f64::from(WEIGHTS[c * DIM + k])).sum::<f64>() as f32)
                    .collect();
                assert!(max_difference(&found, &unit(&expected)) < tolerance, "{floats:?}");
            }
        }
    }
}

#[test]
fn siglip_texts_are_padded_and_its_scores_are_probabilities() {
    let options = options();
    let padded = DESCRIPTION.replace("prompt =", "padding = { n_tokens = 64, token_id = 1 }\nprompt =")
        + "\n[score]\nlogit_scale = 117.330765\nlogit_bias = -12.932437\n";
    for n_tokens in [-1, 64] {
        let folder = made(&padded, TextKind { n_tokens, ..TextKind::default() }, (Element::F32, -1, false));
        let model = ModelDir::open(folder.path()).expect("it opens");
        // Where 117.330765 x - 12.932437 = 0.
        assert!((model.threshold().expect("derived") - 0.110_222_04).abs() < 1e-7, "{:?}", model.threshold());
        let mut encoder = model.text_encoder(&options).expect("it loads");
        // Lower case, no punctuation, "chairs" in two pieces, the end token, and the same again as filler.
        let mut ids = vec![4, 5, 7, 1];
        ids.resize(64, 1);
        assert!(max_difference(&encoder.encode("Red chairs!").expect("it runs"), &mean_of(&ids)) < 1e-6);
        // Cut to 8 tokens with the end token as the last, then filled.
        let mut ids = vec![4; 7];
        ids.resize(64, 1);
        let found = encoder.encode(&"red ".repeat(20)).expect("it runs");
        assert!(max_difference(&found, &mean_of(&ids)) < 1e-6);
    }
    // With a mask, the vector is the sum over the unmasked tokens.
    let masked = padded.replace(
        "input_ids = \"input_ids\"",
        "input_ids = \"input_ids\"\nattention_mask = \"attention_mask\"",
    );
    let folder = made(&masked, TextKind { has_mask: true, ..TextKind::default() }, (Element::F32, -1, false));
    let mut encoder = ModelDir::open(folder.path()).unwrap().text_encoder(&options).unwrap();
    assert!(max_difference(&encoder.encode("red").expect("it runs"), &mean_of(&[4, 1])) < 1e-6);
}

#[test]
fn a_probability_becomes_the_cosine_where_the_sigmoid_reaches_it() {
    let no_runtime = SessionOptions::new("no-such-library.so".into());
    for (score, expected) in [
        ("logit_scale = 100.0\nlogit_bias = -10.0", Some(0.1)),
        // 1 / (1 + exp(-(100 x - 10))) = 0.9 at x = (10 + ln 9) / 100.
        ("logit_scale = 100.0\nlogit_bias = -10.0\nprobability = 0.9", Some(0.121_972_25)),
        ("threshold = 0.3", Some(0.3)),
        ("", None),
        ("threshold = 0.3\nlogit_scale = 100.0\nlogit_bias = -10.0", None),
        ("logit_scale = 100.0", None),
        ("logit_scale = 0.0\nlogit_bias = -10.0", None),
        ("logit_scale = 10.0\nlogit_bias = -100.0", None),
        ("logit_scale = 100.0\nlogit_bias = -10.0\nprobability = 1.0", None),
        ("threshold = 1.5", None),
    ] {
        let description = format!("{DESCRIPTION}\n[score]\n{score}\n");
        let folder = made(&description, TextKind::default(), (Element::F32, -1, false));
        match (ModelDir::open(folder.path()), expected) {
            (Ok(model), Some(expected)) => {
                let found = model.threshold().expect("stated");
                assert!((found - expected).abs() < 1e-6, "{score}: {found}");
                assert!(model.text_encoder(&no_runtime).is_err());
            }
            (Err(error), None) => assert!(error.to_string().contains("score is {"), "{error}"),
            (other, _) => panic!("{score}: {other:?}"),
        }
    }
}

#[test]
fn outputs_are_named_or_the_only_ones_that_fit() {
    let options = options();
    // "rows" has three dimensions, so "text_embeds" is the only one; with a twin it is not.
    let mut twins = text_graph(TextKind::default());
    twins.nodes.push(crate::common::onnx::node("Identity", &["text_embeds"], "pooled", &[]));
    twins.outputs.push(value("pooled", Element::F32, &[1, DIM as i64]));
    let folder = tempfile::tempdir().expect("a folder");
    let image = image_graph(Element::F32, -1, false);
    write(folder.path(), DESCRIPTION, &twins, &image);
    let error = ModelDir::open(folder.path()).unwrap().text_encoder(&options).err().unwrap();
    for part in ["text.onnx", "rows f32", "text_embeds f32", "pooled f32", "name it in the description"] {
        assert!(error.to_string().contains(part), "{error}");
    }
    let named = DESCRIPTION.replace("max_tokens", "output = \"pooled\"\nmax_tokens");
    write(folder.path(), &named, &twins, &image);
    let mut encoder = ModelDir::open(folder.path()).unwrap().text_encoder(&options).unwrap();
    assert!(max_difference(&encoder.encode("a").expect("it runs"), &mean_of(&[3, 1])) < 1e-6);
}

#[test]
fn batches_are_measured_unless_vectors_vary_with_them() {
    let options = options();
    let crops: Vec<Crop> = (0..40u8)
        .map(|i| Crop::whole(RgbImage::from_fn(13, 9, |x, y| Rgb([i * 6, (x * 19) as u8, (y * 28) as u8]))))
        .collect();
    let open = |description: &str, image: (Element, i64, bool)| {
        let folder = made(description, TextKind::default(), image);
        ModelDir::open(folder.path()).expect("it opens").image_encoder(&options).expect("it loads")
    };
    let mut measured = open(DESCRIPTION, (Element::F32, -1, false));
    assert!([1, 2, 4, 8, 16, 32].contains(&measured.preferred_batch()), "{}", measured.preferred_batch());
    let stated = DESCRIPTION.replace("normalise = true", "normalise = true\nbatch = 3");
    let mut stated = open(&stated, (Element::F32, -1, false));
    assert_eq!(stated.preferred_batch(), 3);
    assert_eq!(measured.encode(&crops).expect("it runs"), stated.encode(&crops).expect("it runs"));

    assert_eq!(open(DESCRIPTION, (Element::F32, -1, true)).preferred_batch(), 16);
    let mut single = open(DESCRIPTION, (Element::F32, 1, false));
    assert_eq!(single.preferred_batch(), 1);
    assert_eq!(single.encode(&crops).expect("it runs"), stated.encode(&crops).expect("it runs"));
}

#[test]
fn what_really_runs_is_told() {
    let options = options();
    let folder = made(DESCRIPTION, TextKind::default(), (Element::F32, -1, false));
    let model = ModelDir::open(folder.path()).expect("it opens");
    let plain = model.text_encoder(&options).expect("it loads");
    assert_eq!(plain.placement().expect("it is run").to_string(), "cpu");
    // The library has none of these; the CPU runs all nodes and reports them.
    let providers = vec![Provider::TensorRt, Provider::Cuda, Provider::Cpu, Provider::CoreMl];
    let asked = SessionOptions { providers, ..options.clone() };
    let (text, image) = (model.text_encoder(&asked).unwrap(), model.image_encoder(&asked).unwrap());
    for placement in [text.placement(), image.placement()] {
        let placement = placement.expect("it is run");
        assert_eq!(placement.provider(), Provider::Cpu);
        // Two nodes each, whatever the runtime makes of them.
        let holds = [1, 2, 3].map(|n| format!("cpu ({n} nodes)")).contains(&placement.to_string());
        assert!(holds, "{placement}");
    }
    for provider in [Provider::Cuda, Provider::TensorRt, Provider::CoreMl, Provider::DirectMl] {
        let alone = SessionOptions { providers: vec![provider], ..options.clone() };
        assert_error(model.text_encoder(&alone), &[&format!("cannot use {provider}:"), ",cpu"]);
    }
}

#[test]
fn models_that_do_not_fit_say_so_when_opened() {
    let options = options();
    let opened = |folder: &TempDir| {
        let model = ModelDir::open(folder.path()).expect("it opens");
        let opened = model.image_encoder(&options).and_then(|_| model.text_encoder(&options));
        opened.err().expect("it does not fit").to_string()
    };
    let (text, f32s) = (TextKind::default(), (Element::F32, -1, false));
    let folder = made(DESCRIPTION, TextKind { n_tokens: 77, ..text }, f32s);
    assert!(opened(&folder).contains("padding = { n_tokens = 77"), "{}", opened(&folder));
    let folder = made(DESCRIPTION, TextKind { ids: Element::F32, ..text }, f32s);
    assert!(opened(&folder).contains("expected i64"), "{}", opened(&folder));
    let folder = made(DESCRIPTION, text, (Element::F32, 2, false));
    assert!(
        opened(&folder).contains("is f32 [2, 3, 8, 8], expected f32 [1, 3, 8, 8]"),
        "{}",
        opened(&folder)
    );

    // Another model's tokenizer, with more tokens than this one's table.
    let folder = made(DESCRIPTION, text, f32s);
    let more: Vec<&str> = VOCABULARY.iter().copied().chain(["▁table", "▁lamp"]).collect();
    fs_err::write(folder.path().join("tokenizer.json"), tokenizer(&more)).expect("it is writable");
    let message = opened(&folder);
    for part in ["tokenizer.json", "ids up to 9", "use the model's own tokenizer"] {
        assert!(message.contains(part), "{message}");
    }

    // Versions that no runtime supports.
    for (ir_version, opset) in [(7, 999), (99, 12)] {
        let bytes = crate::common::onnx::versioned(&text_graph(text), ir_version, opset);
        fs_err::write(folder.path().join("text.onnx"), bytes).expect("it is writable");
        let message = opened(&folder);
        for part in ["text.onnx", "give a newer libonnxruntime, or export the model for an older opset"] {
            assert!(message.contains(part), "{message}");
        }
    }
    // An operator that no runtime has, and a file that is something else.
    let mut unknown = text_graph(text);
    unknown.nodes.push(crate::common::onnx::node("Telepathy", &["text_embeds"], "thought", &[]));
    for bytes in [model(&unknown), b"<!DOCTYPE html><html>404</html>".to_vec()] {
        fs_err::write(folder.path().join("text.onnx"), bytes).expect("it is writable");
        let message = opened(&folder);
        assert!(message.contains("text.onnx") && message.contains("fetch the model file again"), "{message}");
    }
}

/// Returns the indented lines of docs/models.md that follow a line with `start`.
fn documented(start: &str) -> Vec<String> {
    let text = fs_err::read_to_string(slag_test_support::workspace_root().join("docs/models.md"))
        .expect("it is readable");
    let after = text.lines().skip_while(|line| !line.contains(start));
    let indented = after.skip_while(|line| !line.starts_with("    "));
    indented.map_while(|line| Some(line.strip_prefix("    ")?.to_owned())).collect()
}

#[test]
fn the_documented_descriptions_are_valid() {
    let clip = documented("A folder with ONNX files");
    let siglip = documented("SigLIP differs in these fields");
    // The second example is the first with some lines instead of others, section by section.
    let mut merged: Vec<(String, String)> = Vec::new();
    let mut section = String::new();
    for line in clip.iter().chain(&siglip) {
        if line.starts_with('[') {
            line.split(' ').next().expect("a word").clone_into(&mut section);
            continue;
        }
        let key = |line: &str| line.split(" = ").next().expect("a key").to_owned();
        merged.retain(|(other, before)| (other, key(before)) != (&section, key(line)));
        merged.push((section.clone(), line.clone()));
    }
    let mut sections: Vec<&String> = merged.iter().map(|(section, _)| section).collect();
    sections.sort();
    sections.dedup();
    let mut text = String::new();
    for section in sections {
        text += &format!("{section}\n");
        merged
            .iter()
            .filter(|(other, _)| other == section)
            .for_each(|(_, line)| text += &format!("{line}\n"));
    }
    let no_runtime = SessionOptions::new("no-such-library.so".into());
    for (description, threshold) in [(clip.join("\n"), None), (text, Some(0.077_052_4))] {
        let folder = made(&description, TextKind::default(), (Element::F32, -1, false));
        fs_err::rename(folder.path().join("text.onnx"), folder.path().join("text_model.onnx"))
            .expect("renamed");
        fs_err::rename(folder.path().join("vision.onnx"), folder.path().join("vision_model.onnx"))
            .expect("renamed");
        let model = ModelDir::open(folder.path()).unwrap_or_else(|e| panic!("{e}\n{description}"));
        assert_eq!(model.threshold().map(|t| (t * 1e5).round()), threshold.map(|t: f32| (t * 1e5).round()));
        assert!(model.text_encoder(&no_runtime).is_err());
    }
}
