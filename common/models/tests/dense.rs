//! Vectors of patches against tensors recorded with PyTorch (`tests/models/dense_tiny/export.py`), and texts
//! without an end token.

use super::*;
use crate::common::made;

#[test]
fn patches_and_crops_equal_the_recorded_ones() {
    let golden = model_dir("dense_tiny").join("golden.npz");
    let model = ModelDir::open(&model_dir("dense_tiny")).expect("it opens");
    assert_eq!(model.patches_per_side(), Some(4));
    let mut encoder = model.image_encoder(&options()).expect("it loads");
    assert_eq!(encoder.patches_per_side(), Some(4));
    let photo = image(&golden, "image");
    let vectors = encoder.encode_patches(&photo).expect("it runs").expect("it has patches");
    let (shape, recorded) = array::<f32>(&golden, "patch_embeddings");
    assert_eq!((shape, vectors.len()), (vec![16, 16], 16 * 16));
    assert_recorded(&vectors, &recorded, 16, 1e-5);
    // Neighbouring patches differ, so their order matters.
    assert!(max_difference(&vectors[..16], &unit(&recorded[16..32])) > 0.01);
    let (_, recorded) = array::<f32>(&golden, "image_embeds");
    let found = encoder.encode(&[Crop::whole(photo)]).expect("it runs");
    assert!(max_difference(&found, &unit(&recorded)) < 1e-5);
}

#[test]
fn wrong_patches_are_named() {
    let description = fs_err::read_to_string(model_dir("dense_tiny").join("model.toml")).unwrap();
    let message = |from: &str, to: &str| {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["vision.onnx", "phrases.txt", "vectors.safetensors"] {
            fs_err::copy(model_dir("dense_tiny").join(name), folder.path().join(name)).expect("it copies");
        }
        assert!(description.contains(from));
        fs_err::write(folder.path().join("model.toml"), description.replace(from, to))
            .expect("it is writable");
        let opened = ModelDir::open(folder.path()).and_then(|model| model.image_encoder(&options()));
        opened.err().expect("it must be refused").to_string()
    };
    for (to, expected) in [
        ("patch_px = 13", "image.patches.patch_px is 13, expected a divisor"),
        ("patch_px = 0", "image.patches.patch_px is 0"),
    ] {
        let message = message("patch_px = 14", to);
        assert!(message.contains(expected), "{message}");
    }
    let message = message("\"patch_embeddings\"", "\"patches\"");
    assert!(message.contains("patches") && message.contains("patch_embeddings"), "{message}");
}

/// The made tokenizer ends texts with token 1; without `end_token_id`, ids stay as they are. Lower case is optional.
#[test]
fn texts_need_no_end_token_and_may_be_lowered() {
    let tokenizer = made::tokenizer(&made::VOCABULARY).replace(r#"{"type":"Lowercase"},"#, "");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("tokenizer.json");
    fs_err::write(&path, tokenizer).expect("it is writable");
    let file = (&path).into();
    let tokens = slag_models::text::Tokens::open(&file, 4, None).expect("it opens");
    let ids = |text: &str| tokens.ids(text).expect("it tokenises");
    let capital = ids("RED");
    assert_ne!(capital, ids("red"), "this tokenizer keeps case");
    assert!(ids("red").contains(&4) && ids("a red chair a red chair").len() <= 4);

    let write = |description: &str| {
        let text = made::text_graph(made::TextKind::default());
        let image = made::image_graph(crate::common::onnx::Element::F32, -1, false);
        made::write(folder.path(), description, &text, &image);
        let kept = made::tokenizer(&made::VOCABULARY).replace(r#"{"type":"Lowercase"},"#, "");
        fs_err::write(&path, kept).expect("it is writable");
        let model = ModelDir::open(folder.path()).expect("it opens");
        model.text_encoder(&options()).expect("it loads")
    };
    let (small, capital) = ("red chair", "RED chair");
    let mut keeps = write(made::DESCRIPTION);
    assert_ne!(keeps.encode(small).expect("it runs"), keeps.encode(capital).expect("it runs"));
    let mut lowers =
        write(&made::DESCRIPTION.replace("prompt = \"{}\"", "prompt = \"{}\"\nlowercase = true"));
    assert_eq!(lowers.encode(small).expect("it runs"), keeps.encode(small).expect("it runs"));
    assert_eq!(lowers.encode(capital).expect("it runs"), keeps.encode(small).expect("it runs"));
}
