//! Object files: parsing, errors, and the built-in files.

use slag_models::{ModelDir, SessionOptions};

use super::*;

fn parse(text: &str) -> Result<Noun, String> {
    Noun::parse("small stool".into(), text)
}

const STOOL: &str = "words: stool, seat  # a comment\nis: furniture, something to sit on\n\
    found: room floor, yard wall\npaint main: wood | red, blue\npaint legs: metal | same\n\
    let w = 0.4\nbox main: 0, 0, 0.5 | w, w, 0.1\n\
    cylinder legs: x*w/2, y*w/2, 0.225 | 0.02, 0.45 | for x -1, 1 | for y -1, 1 | turn 0, 0, 45\n\
    box main: 0, 0, 9 | 1, 1, 1 | if w - 1\ntop: 0.55 | w, w\n";

#[test]
fn a_file_makes_its_parts() {
    let noun = parse(STOOL).expect("parses");
    assert_eq!((noun.name.as_str(), noun.words.len(), noun.kinds.len()), ("small stool", 2, 2));
    assert_eq!(noun.found, [(SceneKind::Room, Place::Floor), (SceneKind::Yard, Place::Wall)]);
    let object = noun.make(&mut Xorshift::new(3), |colour| colour == Colour::Blue);
    assert_eq!(object.colours, [Colour::Blue]);
    assert_eq!(object.top, Some(Top { z_m: 0.55, size_m: [0.4, 0.4] }));
    let centres: Vec<[f64; 3]> =
        object.parts.iter().map(|part| part.object_from_part.translation.to_array()).collect();
    let legs = [[-0.2, -0.2], [-0.2, 0.2], [0.2, -0.2], [0.2, 0.2]].map(|[x, y]| [x, y, 0.225]);
    assert_eq!(centres[0], [0.0, 0.0, 0.5]);
    assert_eq!(centres[1..], legs);
    assert!(object.parts.iter().all(|part| part.paint == object.parts[0].paint), "legs in the same paint");
}

#[test]
fn mistakes_are_named_with_their_line() {
    for (line, mistake) in [
        (1, "word: a"),
        (5, "words: a\nis: b\nfound: room floor\npaint m: wood | red\nbox n: 0, 0, 0 | 1, 1, 1"),
        (1, "paint m: cheese | red"),
        (1, "paint m: wood | same"),
        (2, "paint m: wood | red\nbox m: 0, 0 | 1, 1, 1"),
        (2, "paint m: wood | red\ncylinder m: 0, 0, 0 | 1, 1, 1"),
        (2, "paint m: wood | red\nbox m: 0, 0, z | 1, 1, 1"),
        (2, "paint m: wood | red\nbox m: 0, 0, 0 | 1, 1, 1 | spin 3"),
        (1, "found: room ceiling"),
        (1, "let a 3"),
        (1, "paint m: wood | red"),
    ] {
        let message = parse(mistake).expect_err(mistake);
        assert!(message.starts_with(&format!("{line}: ")), "{mistake}: {message}");
    }
}

/// Every built-in noun has kinds, stands on the ground, and has a sensible size.
#[test]
fn built_in_objects_are_sound() {
    assert!(NOUNS.len() >= 40, "{} nouns", NOUNS.len());
    for noun in NOUNS.iter() {
        assert!(!noun.kinds.is_empty(), "{}: no kinds", noun.name);
        let shell = noun.found.iter().any(|(_, place)| *place == Place::Shell);
        for seed in 0..50 {
            let object = noun.make(&mut Xorshift::new(seed), |_| true);
            if shell {
                continue;
            }
            let surfels: Vec<DVec3> =
                object.parts.iter().flat_map(|part| part.surfels(0.05)).map(|s| s.position).collect();
            let low = surfels.iter().copied().fold(DVec3::INFINITY, DVec3::min);
            let size = surfels.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max) - low;
            let hung = noun.found.iter().any(|(_, place)| *place == Place::Hung);
            assert!(hung || low.z.abs() < 0.06, "{} {seed}: lowest at {}", noun.name, low.z);
            assert!(size.max_element() < 13.0 && size.max_element() > 0.05, "{} {seed}: {size}", noun.name);
        }
    }
}

/// No word that the embedded model learnt is asked as one that means fewer things: `container` is no ship's.
#[test]
fn the_model_is_asked_with_words_that_mean_as_much() {
    let of = |word: &str| -> Vec<&str> {
        let is_called = |noun: &&Noun| {
            noun.name == word || [&noun.words, &noun.kinds].iter().any(|w| w.iter().any(|w| w == word))
        };
        NOUNS.iter().filter(is_called).map(|noun| noun.name.as_str()).collect()
    };
    let session = SessionOptions::new(slag_test_support::onnx_runtime());
    let encoder = ModelDir::embedded().expect("it reads").text_encoder(&session).expect("it opens");
    let known = encoder.known_phrases().expect("it knows some words");
    for word in NOUNS.iter().flat_map(|noun| noun.words.iter().chain(&noun.kinds)) {
        if let Some(asked) = known.asked_as(word) {
            assert!(of(word).iter().all(|noun| of(&asked).contains(noun)), "{word} is asked as {asked}");
        }
    }
}
